"""Lines of TUM files, ``NAME tx ty tz qx qy qz qw``: the name is a stamp, or whatever it is that has the pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence


def tum_fields(lines: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number, from 1, and the fields of each line that has some: what starts with # is a comment.

    Fields are told apart by spaces, or commas if you like.
    """
    for number, line in enumerate(lines, start=1):
        fields = line.partition("#")[0].replace(",", " ").split()
        if fields:
            yield number, fields
