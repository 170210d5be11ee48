#!/usr/bin/env python3
"""Compare two result files query by query, bit for bit: whether a change of the code changed an answer.

    python scripts/compare_answers.py before.json after.json
    python scripts/compare_answers.py before/answers.csv after/answers.csv

The files are what `evaluate --json`, `negatives --json` or `replay` (answers.csv) wrote. Every value of a query in the
first file (errors, NEES, evidence, status, reason, ...) must be the same in the second, but for times; the second may
have more. Fields that were renamed count as the same. Exits with 0 where all queries are identical, with 1 where one
differs or is in one file only, with 2 where a file cannot be used. It needs nothing but Python.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# New names by old ones, of version 0.1.0.
_RENAMED = {
    "without": "ablation",
    "spoil": "corruption",
    "agreement": "correlation",
    "reprojection_error": "reprojection_error_px",
    "min_agreement": "min_correlation",
}
# What tells a query from the others; in files of one kind, not all are there. What is not there is as if it were "".
_IDENTITY = (
    *("scene", "protocol", "method", "matcher", "sigma", "seed", "options"),
    *("ablation", "corruption", "degradation", "negative", "kind"),
)
_QUERY_IDENTITY = ("photo", "step", "bag_time")
_TIMES = ("milliseconds", "cpu_milliseconds", "stage_milliseconds", "cpu_seconds", "ms")
# Queries that differ are listed up to this number.
_MAX_LISTED = 50

# Of a query, what tells it from the others, and its values by name.
Identity = tuple[tuple[str, str], ...]
Query = dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="results of the code before the change")
    parser.add_argument("after", type=Path, help="results of the code after it")
    options = parser.parse_args(arguments)
    try:
        before, after = read_queries(options.before), read_queries(options.after)
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"compare_answers: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    reports = list(differences(before, after))
    for report in reports[:_MAX_LISTED]:
        print(report)
    if len(reports) > _MAX_LISTED:
        print(f"... and {len(reports) - _MAX_LISTED} more")
    values = sum(map(len, before.values()))
    total = len(before.keys() | after.keys())
    print(f"{total - len(reports)} of {total} queries are identical ({values} values compared)")
    return 1 if reports else 0


def read_queries(path: Path) -> dict[Identity, Query]:
    """Read the queries of a file, under the new names.

    Raises:
        OSError: the file cannot be read.
        ValueError, KeyError, TypeError: it is not what one of the tools wrote, or holds no query or one query twice.
    """
    queries: dict[Identity, Query] = {}
    for row in _rows(path):
        names = [name for name in (*_IDENTITY, *_QUERY_IDENTITY) if row.get(name, "") != ""]
        identity = tuple((name, _bits(row[name])) for name in names)
        if identity in queries:
            raise ValueError(f"{path}: holds {_words(identity)} twice")
        queries[identity] = {name: value for name, value in row.items() if name not in (*_IDENTITY, *_TIMES)}
    if not queries:
        raise ValueError(f"{path}: holds no query")
    return queries


def differences(before: dict[Identity, Query], after: dict[Identity, Query]) -> Iterator[str]:
    """Yield a line for each query that is not the same in both."""
    for identity in before.keys() - after.keys():
        yield f"{_words(identity)}: only before"
    for identity in after.keys() - before.keys():
        yield f"{_words(identity)}: only after"
    for identity, old in before.items():
        new = after.get(identity)
        if new is None:
            continue
        changed = [name for name in old if name not in new or _bits(old[name]) != _bits(new[name])]
        if changed:
            values = "; ".join(f"{name} {old[name]!r} -> {new.get(name, 'missing')!r}" for name in changed)
            yield f"{_words(identity)}: {values}"


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    """Yield a flat row for each query, with the settings of its run."""
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as file:
            yield from map(_renamed, csv.DictReader(file))
        return
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict | list):
        raise ValueError(f"{path}: holds no results")
    if isinstance(content, list):
        yield from map(_renamed, content)
        return
    for run in map(_renamed, content.get("runs", [content])):
        settings = {name: run[name] for name in _IDENTITY if name in run}
        for query in run["per_query"]:
            evidence = query.get("evidence", {})
            yield settings | _renamed(query | evidence)


def _renamed(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row, and the settings of its options, under the new names, without the evidence that was flattened."""
    new = {_RENAMED.get(name, name): value for name, value in row.items() if name != "evidence"}
    if isinstance(new.get("options"), dict):
        new["options"] = {_RENAMED.get(name, name): value for name, value in new["options"].items()}
    return new


def _bits(value: Any) -> str:
    """Return a text that two values have in common only where they are identical; 1 and 1.0 are."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {_bits(value[name])}" for name in sorted(value)) + "}"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value).hex()
    return repr(value)


def _words(identity: Identity) -> str:
    return ", ".join(f"{name} {value}" for name, value in identity)


if __name__ == "__main__":
    sys.exit(main())
