# PYTHON_ARGCOMPLETE_OK
"""One command over all tools: gsfeatloc TOOL ...

A tool is imported when it is called, or completed: they take up to two seconds, and --help of the command none.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from functools import partial

# Names of the tools, modules of this room with `main` and `make_parser`, and what they are for.
TOOLS = {
    "inspect": "say what is in a map, and what of it looks wrong for localization",
    "view": "fly through a map in the browser: answers in it, priors, floor and scale",
    "render": "draw a map from a pose or a path: pictures, depths, a video",
    "index": "make the index of a map's views, which finds images without a prior",
    "prepare": "put a map and all that a robot needs of it into one folder",
    "align": "find where a map's frame lies in the robot's: scale, rotation, translation",
    "warmup": "compile the kernels and fetch a matcher's weights ahead of use",
    "replay": "localize the images of a recorded bag as the node would, without ROS",
    "demo": "localize a camera in a made-up room, from start to end over ROS",
    "evaluate": "localize the test photos of scenes from wrong priors: how well",
    "negatives": "show a localizer photos that are not of its map",
    "benchmark": "measure time and memory of frames, queries and indices",
    "soak": "measure how the installed node bears minutes of a camera's stream",
    "parameters": "write the files that name the node's parameters anew",
}
_EPILOG = """\
gsfeatloc TOOL --help says more. The same tools without this command: ros2 run gsfeatloc_ros TOOL,
python -m gsfeatloc_ros.tools.TOOL. They end with 2 where something that was given cannot be used, and say what in one
line. Completion in bash and zsh: eval "$(register-python-argcomplete gsfeatloc)"
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool that the first argument names with the others; return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if "_ARGCOMPLETE" in os.environ:
        _complete()
    options = make_parser().parse_args(words[:1])
    return importlib.import_module(f"gsfeatloc_ros.tools.{options.tool}").main(words[1:])


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the first argument."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc",
        description="Localize a camera in a 3D Gaussian Splatting map: the tools.",
        epilog=_EPILOG,
        formatter_class=partial(argparse.RawDescriptionHelpFormatter, max_help_position=20),
    )
    tools = parser.add_subparsers(dest="tool", required=True, metavar="TOOL", title="tools")
    for name, purpose in TOOLS.items():
        tools.add_parser(name, help=purpose, add_help=False)
    return parser


def _complete() -> None:
    """Answer the shell, which asks by the environment what may come next, and end the process."""
    import argcomplete

    before = os.environ["COMP_LINE"].encode()[: int(os.environ["COMP_POINT"])].decode(errors="ignore")
    # The number of words before the first argument: to the tool's parser, the tool is the program.
    command = int(os.environ["_ARGCOMPLETE"])
    words = before.split()
    done = words if before.endswith(" ") else words[:-1]
    if len(done) > command and done[command] in TOOLS:
        os.environ["_ARGCOMPLETE"] = str(command + 1)
        argcomplete.autocomplete(importlib.import_module(f"gsfeatloc_ros.tools.{done[command]}").make_parser())
    argcomplete.autocomplete(make_parser())


if __name__ == "__main__":
    sys.exit(main())
