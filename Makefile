# Every target does its own set-up (scripts/setup.sh).
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help demo docs test nightly unit node real gpu gsplat fuzz lint build setup lock sbom audit clean

help:
	@echo "make demo   localize a camera in a made-up room, from start to end"
	@echo "make docs   the documents as a site, in site/"
	@echo "make test   lint, build, run all tests"
	@echo "make nightly  the tests that make test leaves out: they cost much and rarely tell something"
	@echo "make unit   the quick tests that need no ROS and no data: under a minute"
	@echo "make node   test the installed node over real DDS"
	@echo "make real   test with real maps and scenes, where they are (test/real/README.md)"
	@echo "make gpu    test the code for GPUs; without a GPU, on a simulated one"
	@echo "make gsplat test the GPU renderer with gsplat's own kernels, compiled for the CPU"
	@echo "make fuzz   feed damaged files and messages to what reads them, and to the node: twelve minutes"
	@echo "make lint   check the style and the types of the code"
	@echo "make build  build with colcon, into install/"
	@echo "make lock   make locks/ fit setup.py; with ARGS=--upgrade, to the newest versions"
	@echo "make sbom   list what is installed, in sbom/"
	@echo "make audit  ask what is known against what is in locks/"
	@echo "make clean  remove what the others made, but for .venv"

demo: build
	@. scripts/env.sh && python -m gsfeatloc_ros.tools.demo

# Not --quiet: it would pass over broken links.
docs: setup
	@. scripts/env.sh && NO_MKDOCS_2_WARNING=1 python -m mkdocs build && echo "docs: site/index.html; with its search: python3 -m http.server --directory site"

# Nodes that tests kill leave 70 MB of shared memory each.
CLEAN_UP := trap 'fastdds shm clean > /dev/null' EXIT

# -P: what is tested is what is installed, not the sources here. Tests of the node mostly wait: apart from those that
# compute, which would let them wait too long; and those that say in how many seconds it ends, alone. Who has no more to
# compute takes what others have left; a node serves all tests of its file.
test: lint build
	@. scripts/env.sh && $(CLEAN_UP) && tests="python -P -m pytest" && \
	$$tests -n 2 --dist worksteal test/unit test/gpu test/real && \
	$$tests -n 2 --dist loadfile test/node --ignore test/node/test_node_stop.py && \
	$$tests test/node/test_node_stop.py

# The option named last counts: the one of pyproject.toml comes before it.
nightly: build
	@. scripts/env.sh && $(CLEAN_UP) && python -P -m pytest -m nightly $(ARGS)

# These run the sources here. Name a test or an option of pytest by ARGS: make unit ARGS="-k camera -x"
unit: setup
	@. scripts/env.sh && python -m pytest test/unit -m "not slow and not nightly" $(ARGS)

real gpu: setup
	@. scripts/env.sh && python -m pytest test/$@ $(ARGS)

node: build
	@. scripts/env.sh && $(CLEAN_UP) && python -P -m pytest test/node $(ARGS)

# Apart from .venv, where the renderer would find it and look for a GPU in every test.
gsplat: build
	@. scripts/env.sh && python -m pip install --quiet --upgrade --no-deps --target .venv/gsplat gsplat==1.5.3 jaxtyping wadler-lindig
	@. scripts/env.sh && GSPLAT_ON_CPU=.venv/gsplat python -P -m pytest test/gpu/test_gpu.py

fuzz: build
	@. scripts/env.sh && python -P scripts/fuzz.py $(ARGS)
	@. scripts/env.sh && $(CLEAN_UP) && python -P scripts/fuzz_node.py

lint: setup
	@. scripts/env.sh && ruff check . && ruff format --check . && mypy

build: setup
	@scripts/build.sh

setup:
	@scripts/setup.sh

# Tools apart from .venv, which has only what is tested.
.tools: locks/tools.txt | setup
	@.venv/bin/python -m venv --clear .tools
	@.tools/bin/python -m pip --disable-pip-version-check install --quiet --no-deps --only-binary :all: --require-hashes --requirement locks/tools.txt
	@touch .tools

lock: .tools
	@scripts/lock.sh $(ARGS)

sbom: .tools
	@mkdir -p sbom
	.tools/bin/cyclonedx-py environment .venv --output-reproducible --output-file sbom/venv.json
	.tools/bin/cyclonedx-py requirements locks/container.txt --output-reproducible --output-file sbom/container.json

audit: .tools
	@.venv/bin/python scripts/audit.py

clean:
	rm -rf build install log demo_output sbom site .pytest_cache .ruff_cache .mypy_cache .hypothesis
