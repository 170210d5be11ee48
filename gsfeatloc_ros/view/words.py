"""Texts from elsewhere on the page: the browser takes what it is given for Markdown with HTML."""

from __future__ import annotations

import html
import re

from gsfeatloc_ros.common.words import shortened

# What Markdown means something by.
_MARKS = re.compile(r"([\\`*_{}\[\]()#+\-.!|~:$@/])")


def plain(text: str) -> str:
    """Return a text so that it is shown as it is, in one line, whatever it holds."""
    return html.escape(_MARKS.sub(r"\\\1", shortened(" ".join(text.split()))))
