"""Ask what is known against the packages in locks/; needs make's .tools, and PyPI's advisories.

    make audit

The exit status is 1 if something is known, and 2 if not all packages could be asked about: silence is no acquittal.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

_AUDIT = [".tools/bin/pip-audit", "--disable-pip", "--progress-spinner", "off", "--format", "json"]


def audit(lock: Path) -> tuple[list[str], list[str]]:
    """Return what is known against packages of a lock, a line each, and of which packages nothing could be learned.

    Raises:
        RuntimeError: nothing could be learned at all.
    """
    # torch alone has no hashes.
    hashes = ["--no-deps"] if lock.name == "torch.txt" else ["--require-hashes"]
    finished = subprocess.run([*_AUDIT, *hashes, "--requirement", str(lock)], capture_output=True, text=True)
    try:
        packages = json.loads(finished.stdout)["dependencies"]
    except ValueError as error:
        raise RuntimeError((finished.stderr.strip() or "no output").splitlines()[-1]) from error
    known = [
        f"{package['name']} {package['version']}: {found['id']}, mended in {', '.join(found['fix_versions']) or 'none'}"
        for package in packages
        for found in package.get("vulns", [])
    ]
    return known, [package["name"] for package in packages if "skip_reason" in package]


def main() -> int:
    """Run the command line; return the exit status."""
    status = 0
    for lock in (Path("locks") / f"{name}.txt" for name in ("wheels", "ros", "container", "tools", "torch")):
        try:
            known, unknown = audit(lock)
        except RuntimeError as error:
            print(f"{lock}: NOT AUDITED, the advisories cannot be reached: {error}")
            status = status or 2
            continue
        print(f"{lock}: {len(known)} advisories", *known, sep="\n    ")
        if unknown:
            print(f"{lock}: NOT AUDITED: of {len(unknown)} packages PyPI did not answer, {unknown[0]} for one")
            status = status or 2
        if known:
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main())
