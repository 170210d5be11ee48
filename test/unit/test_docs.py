"""The documents and the repository say the same: what documents name is there."""

from __future__ import annotations

import argparse
import ast
import functools
import importlib
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from gsfeatloc_ros.match import MATCHERS

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "gsfeatloc_ros"
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLDERS = ["gsfeatloc_ros", "test", "docs", "config", "deploy", "scripts", "launch", "interfaces", "examples", ".ci"]
# Rooms of the package may be named without it: `render/blend.py`.
ROOMS = sorted(path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__")
# Names that stand for others, and files of other programs.
NO_FILES = {
    *("gsfeatloc_ros/match/NAME.py", "gsfeatloc_ros/maps/NAME.py", "replay.launch.py", "localizer.launch.py"),
    *("navigation_launch.py", "localization_launch.py"),  # nav2_bringup's
    *("simple_trainer.py", "train.py"),  # gsplat's, INRIA's
}
each_document = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)


def code_of(document: Path) -> list[str]:
    """Return what a document has in backticks, and the lines of its code blocks."""
    text = document.read_text(encoding="utf-8")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    rest = re.sub(r"^```\w*\n.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^ {4,}(\S.*)$", rest, re.MULTILINE)
    spans = [" ".join(span.split()) for part in rest.split("\n\n") for span in re.findall(r"`([^`]+)`", part)]
    return [line for block in fenced for line in block.splitlines()] + indented + spans


def words_of(document: Path) -> set[str]:
    """Return the words of a document's code that may be paths."""
    return {word.strip("\"'.,;:") for code in code_of(document) for word in re.split(r"[\s()\[\]=,|]+", code)}


@each_document
def test_paths_lead_to_files(document: Path) -> None:
    for word in words_of(document) - NO_FILES:
        first, slash, _ = word.partition("/")
        if slash and first in FOLDERS and "*" not in word and "..." not in word:
            assert (ROOT / word).exists(), word
        elif slash and first in ROOMS and "*" not in word:
            assert (PACKAGE / word).exists(), word
        elif re.fullmatch(r"[\w/]+\.py", word):
            assert not slash, word
            assert (ROOT / word).exists() or any(PACKAGE.rglob(word)) or any((ROOT / "test").rglob(word)), word


@each_document
def test_links_lead_somewhere(document: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", document.read_text(encoding="utf-8")):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def anchors(document: Path) -> set[str]:
    """Return what links to a document's headings end with, as GitHub makes it."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_anchors_are_githubs() -> None:
    assert "the-gpu-renderer-rendergpupy-renderdepth_binspy" in anchors(ROOT / "docs/renderer.md")


@each_document
def test_commands_name_modules_with_the_options_given(document: Path) -> None:
    for code in code_of(document):
        for module, rest in re.findall(r"(?:python3? -m (?=gsfeatloc_ros)|gsfeatloc )([\w.]+)([^#;)]*)", code):
            module = module if module.startswith("gsfeatloc_ros") else f"gsfeatloc_ros.tools.{module}"
            source = ROOT / (module.replace(".", "/") + ".py")
            assert source.is_file(), module
            named = set(re.findall(r"(?<=\s)--[a-z-]+", rest))
            assert not named or named <= options_of(importlib.import_module(module).make_parser()), module


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    """Return the options that a parser takes, those of its subcommands included."""
    options = set()
    for action in parser._actions:
        options |= set(action.option_strings)
        if isinstance(action, argparse._SubParsersAction):
            options |= {option for command in action.choices.values() for option in options_of(command)}
    return options


@each_document
def test_targets_are_in_the_makefile(document: Path) -> None:
    rules = re.findall(r"^([a-z ]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    targets = {target for rule in rules for target in rule.split()}
    named = {name for code in code_of(document) for name in re.findall(r"\bmake ([a-z]+)\b", code)}
    assert named <= targets


@each_document
def test_functions_and_tests_are_defined(document: Path) -> None:
    sources = [*PACKAGE.rglob("*.py"), *(ROOT / "test").rglob("*.py")]
    defined = set(re.findall(r"(?:def|class) (\w+)", "\n".join(path.read_text(encoding="utf-8") for path in sources)))
    for code in code_of(document):
        called = re.fullmatch(r"(?:\w+\.)?(\w+)\([\w, ]*\)", code)
        if called and "NAME" not in code:
            assert called[1] in defined, code
        if re.fullmatch(r"test_\w+", code) and code != "test_filenames":  # nerfstudio's
            assert code in defined, code


@each_document
def test_members_of_classes_are_there(document: Path) -> None:
    known = members()
    for code in code_of(document):
        named = re.fullmatch(r"([A-Z]\w+)\.(\w+)(?:\(.*\))?", code)
        if named and named[1] in known:
            assert named[2] in known[named[1]], code


@functools.cache
def members() -> dict[str, set[str]]:
    """Return the methods and attributes of the package's classes, by the class's name."""
    found: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(item, ast.ClassDef):
                names = found.setdefault(item.name, set())
                for part in ast.walk(item):
                    if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef):
                        names.add(part.name)
                    elif isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                        names.add(part.target.id)
                    elif isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
                        names.add(part.attr)
    return found


def test_rooms_are_in_the_order_of_their_imports() -> None:
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    rooms = re.findall(r"^\| `gsfeatloc_ros/(\w+)/` \|", text, re.MULTILINE)
    assert sorted(rooms) == ROOMS
    for room in rooms:
        for path in (PACKAGE / room).rglob("*.py"):
            for imported in re.findall(r"(?:from|import) gsfeatloc_ros\.(\w+)", path.read_text(encoding="utf-8")):
                assert rooms.index(imported) >= rooms.index(room), f"{path.name} imports {imported}"


@each_document
def test_parameters_are_those_of_the_node(document: Path) -> None:
    if document.name == "parameters.md":
        pytest.skip("it is generated from the settings, and names old ones")
    tree = yaml.safe_load((ROOT / "config/localizer.yaml").read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    groups = {group: set(names) for group, names in tree.items() if isinstance(names, dict)}
    for code in code_of(document):
        for group, name in re.findall(rf"(?<![\w./-])({'|'.join(groups)})\.(\w+)(?=:=|$|`)", code):
            if name not in ("ply", "md", "yaml", "csv", "png"):
                assert name in groups[group], f"{group}.{name}"


def test_matchers_are_those_of_the_code() -> None:
    text = (ROOT / "docs/matchers.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*)", text.split("\n## ")[0], re.MULTILINE)
    experimental = {
        name: "**experimental**" in row for row in rows for name in re.findall(r"`([a-z-]+)`", row.split(" | ")[0])
    }
    assert experimental == {name: entry.experimental for name, entry in MATCHERS.items()}


def test_readme_shows_the_example_as_it_is() -> None:
    (shown,) = re.findall(r"^```python\n(.*?)^```", DOCUMENTS[0].read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    example = (ROOT / "examples/localize_one_photo.py").read_text(encoding="utf-8")
    assert shown == example[re.search(r"^(import|from) ", example, re.MULTILINE).start() :]


def test_every_document_is_linked_from_the_readme() -> None:
    linked = {(ROOT / link).resolve() for link in re.findall(r"\]\(([^)#]+)[^)]*\)", DOCUMENTS[0].read_text("utf-8"))}
    assert set(DOCUMENTS[1:]) <= linked


def test_every_document_is_in_the_menu_of_the_site() -> None:
    menu = set(re.findall(r"^ +- .+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    assert {path.name for path in DOCUMENTS[1:]} <= menu


def test_the_maintainer_is_the_same_everywhere_and_no_example() -> None:
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    for manifest in ("package.xml", "interfaces/package.xml"):
        maintainer = ElementTree.parse(ROOT / manifest).getroot().find("maintainer")
        assert f'maintainer="{maintainer.text}"' in setup
        assert f'maintainer_email="{maintainer.get("email")}"' in setup
        assert "example" not in maintainer.get("email")


def test_the_changelog_has_the_version_and_what_comes() -> None:
    text = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    version = ElementTree.parse(ROOT / "package.xml").getroot().findtext("version")
    headings = re.findall(r"^(.+)\n-+$", text, re.MULTILINE)
    assert version in headings
    assert headings[0] in ("Forthcoming", version)
