"""The old name of the tool `negatives`, which works until the next release."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from gsfeatloc_ros.tools import negatives


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `negatives` with a notice; return its exit status."""
    print("tools.strangers is now tools.negatives; the old name works until the next release", file=sys.stderr)
    return negatives.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
