"""A hook of mkdocs: what the documents link to outside docs/ is in the site too.

README.md is its first page, CONTRIBUTING.md another, and files such as config/localizer.yaml are copied. A link to what
is not there leads nowhere in the site either: the build then fails.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

_ROOT = Path(__file__).resolve().parents[1]
_DOCS = _ROOT / "docs"
# Pages of the site that do not lie in docs/.
_PAGES = {
    _ROOT / "README.md": "index.md",
    _ROOT / "CONTRIBUTING.md": "CONTRIBUTING.md",
    _ROOT / "test/real/README.md": "real-data.md",
}
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages and files that lie elsewhere."""
    for source, name in _PAGES.items():
        files.append(File.generated(config, name, content=source.read_text(encoding="utf-8")))
    for source in [*_PAGES, *_DOCS.glob("*.md")]:
        for link in _LINK.findall(source.read_text(encoding="utf-8")):
            target = (source.parent / link).resolve()
            name = _place(target)
            if target.is_file() and files.get_file_from_path(name) is None:
                files.append(File.generated(config, name, abs_src_path=str(target)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let the links of a page lead to where things are in the site."""
    places = {name: source for source, name in _PAGES.items()}
    folder = places.get(page.file.src_uri, _DOCS / page.file.src_uri).parent

    def relink(link: re.Match[str]) -> str:
        return os.path.relpath(_place((folder / link[1]).resolve()), Path(page.file.src_uri).parent)

    return _LINK.sub(relink, markdown)


def _place(path: Path) -> str:
    """Return where in the site a file of the repository is."""
    if path in _PAGES:
        return _PAGES[path]
    return path.relative_to(_DOCS if path.is_relative_to(_DOCS) else _ROOT).as_posix()
