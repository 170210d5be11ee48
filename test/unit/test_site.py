"""The site of the documents: it is built, all of its links lead somewhere, and it needs nothing from elsewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

pytest.importorskip("mkdocs", reason="mkdocs-material is not installed: pip install -e .[docs]")

ROOT = Path(__file__).parents[2]


class Links(HTMLParser):
    """What a page links to, what it loads, and what it can be linked to by."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors = {""}
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        named = {name: value for name, value in attributes if value}
        self.anchors.update(named[name] for name in ("id", "name") if name in named)
        if "src" in named or (tag == "link" and named.get("rel") == "stylesheet"):
            self.loads.append(named.get("src") or named["href"])
        elif tag == "a" and "href" in named:
            self.links.append(named["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Built as by `make docs`, where a warning is an error: a broken link, an anchor or a page that is in no menu."""
    folder = tmp_path_factory.mktemp("site")
    # Not --quiet: it would not count warnings, and pass over them.
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Links]:
    return {path: Links(path) for path in site.rglob("*.html") if path.name != "404.html"}


def test_every_link_leads_to_a_file_and_an_anchor_of_the_site(site, pages):
    assert len(pages) > 10
    for page, found in pages.items():
        for link in found.links + found.loads:
            url = urlsplit(link)
            if url.scheme:
                continue
            target = (page.parent / unquote(url.path)).resolve() if url.path else page
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), f"{page.name}: {link}"
            if target in pages and url.fragment:
                assert unquote(url.fragment) in pages[target].anchors, f"{page.name}: {link}"


def test_pages_load_nothing_from_elsewhere(pages):
    for page, found in pages.items():
        assert not [load for load in found.loads if urlsplit(load).netloc], page.name


def test_no_markup_is_left_as_text(pages):
    """Lists and tables that GitHub shows as such, and Python-Markdown does not."""
    for page in pages:
        text = re.sub(r"<(pre|code|script)\b.*?</\1>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        left = re.findall(r"^(?:<p>)?(?:\|.*\||- .*|#+ .*|```.*|\*.*)$", text, re.MULTILINE)
        assert not left, f"{page.name}: {left[:3]}"
