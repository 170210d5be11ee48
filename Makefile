# Every target does its own set-up (scripts/setup.sh).
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help demo test gsplat lint build setup clean

help:
	@echo "make demo   localize a camera in a made-up room, from start to end"
	@echo "make test   lint, build, run the tests"
	@echo "make gsplat test the GPU renderer with gsplat's own kernels, compiled for the CPU"
	@echo "make lint   check the style of the code"
	@echo "make build  build with colcon, into install/"
	@echo "make clean  remove what the others made, but for .venv"

demo: build
	@. scripts/env.sh && python -m gsfeatloc_ros.tools.demo

# -P: what is tested is what is installed, not the sources here.
test: lint build
	@. scripts/env.sh && python -P -m pytest

# Apart from .venv, where the renderer would find it and look for a GPU in every test.
gsplat: build
	@. scripts/env.sh && python -m pip install --quiet --upgrade --no-deps --target .venv/gsplat gsplat==1.5.3 jaxtyping wadler-lindig
	@. scripts/env.sh && GSPLAT_ON_CPU=.venv/gsplat python -P -m pytest test/gpu/test_gpu.py

lint: setup
	@. scripts/env.sh && ruff check . && ruff format --check .

build: setup
	@scripts/build.sh

setup:
	@scripts/setup.sh

clean:
	rm -rf build install log demo_output .pytest_cache .ruff_cache .hypothesis
