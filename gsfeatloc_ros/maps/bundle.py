"""Map bundles: a folder with a map, what is made of it, and a manifest that says what lies in it and how it is read.

manifest.json                   format, version, what made it, parameters map.*, size and SHA-256 of each file
map/NAME                        the map's file, or its files; beside it the prepared map and the index of views
alignment.yaml                  what `gsfeatloc align` wrote, if there was an alignment
inspection.json, .html          what `gsfeatloc inspect` says of the map
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsfeatloc_ros.common.json_file import read_json
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.maps.files import content_of, map_files
from gsfeatloc_ros.maps.gaussian_map import MapError

MANIFEST, ALIGNMENT = "manifest.json", "alignment.yaml"
MAP_FOLDER = "map"
INSPECTION = ("inspection.json", "inspection.html")

_FORMAT, _VERSION = "gsfeatloc_ros map bundle", 1
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MAKE_ANEW = "make the bundle anew, or copy it again"

# Size in bytes and SHA-256 of a file, as of `content_of`.
Content = list[Any]


@dataclass(frozen=True)
class Bundle:
    """What a manifest says.

    Attributes:
        folder: of the bundle.
        map_name: what tells what the map is, as of `find_map`: its path in the folder.
        files: content of what stays as it is, by its path in the folder.
        derived: the same of what is made of it, and made again where it does not fit: it is not held to this.
        parameters: the node's parameters map.*, where they are said; of any type yet.
        made_by: what made the bundle, for people.
    """

    folder: Path
    map_name: str
    files: Mapping[str, Content]
    derived: Mapping[str, Content] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    made_by: Mapping[str, Any] = field(default_factory=dict)

    @property
    def map(self) -> Path:
        """Path of the map."""
        return self.folder / self.map_name

    @property
    def map_content(self) -> list[Content]:
        """What the files of the map hold, in the order of `map_files`."""
        return [self.files[name] for name in self._map_names()]

    def check_map(self, content: Sequence[Content] | None = None) -> None:
        """Raise MapError unless the map's files are those of the manifest.

        Args:
            content: of `map_files(self.map)`; None to read them.
        """
        found = [file.relative_to(self.folder).as_posix() for file in map_files(self.map)]
        for name in self._map_names():
            if name not in found:
                raise MapError(f"{self.folder / name}: is missing, though {MANIFEST} names it: {_MAKE_ANEW}")
        for name in found:
            if name not in self.files:
                raise MapError(f"{self.folder / name}: is not in {MANIFEST}: take it out of the bundle")
        content = [content_of(self.folder / name) for name in found] if content is None else content
        for name, holds in zip(found, content, strict=True):
            self._check(name, holds)

    def check_alignment(self) -> None:
        """Raise MapError where the alignment was changed, which would have no effect."""
        if ALIGNMENT in self.files:
            self._check(ALIGNMENT, content_of(self.folder / ALIGNMENT))

    def write(self) -> None:
        """Write the manifest, in one step; raise OSError where that fails."""
        about = {"format": _FORMAT, "version": _VERSION, "made_by": self.made_by, "map": self.map_name}
        about |= {"parameters": self.parameters}
        for group in ("files", "derived"):
            items = getattr(self, group).items()
            about[group] = {name: {"bytes": size, "sha256": digest} for name, (size, digest) in items}
        with replaced_file(self.folder / MANIFEST) as stream:
            stream.write(json.dumps(about, indent=2).encode() + b"\n")

    def _map_names(self) -> list[str]:
        """Return the paths in the folder of the map's files, as `map_files` sorts them."""
        return sorted((name for name in self.files if name.startswith(f"{MAP_FOLDER}/")), key=Path)

    def _check(self, name: str, content: Content) -> None:
        if list(content) != list(self.files[name]):
            raise MapError(
                f"{self.folder / name}: is not what {MANIFEST} says ({content[0]} bytes of {self.files[name][0]}, or "
                f"others): it was cut or changed: {_MAKE_ANEW}"
            )


def read_bundle(path: str | Path) -> Bundle | None:
    """Read the manifest of a map bundle; None where the path is of none. The files in it are not looked at yet.

    Raises:
        MapError: the manifest is damaged, foreign or of a later version, or names what is not in the folder.
    """
    folder = Path(path)
    manifest = folder / MANIFEST
    try:
        if not manifest.is_file():
            return None
        about = read_json(manifest)
    except OSError as error:
        raise MapError(f"{manifest}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise MapError(f"{manifest}: is damaged, no JSON: {error}: {_MAKE_ANEW}") from error
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise MapError(f"{manifest}: is not of a map bundle: name the map's file in this folder, not the folder")
    if about.get("version") != _VERSION:
        raise MapError(f"{manifest}: is of version {about.get('version')!r}, not {_VERSION}: make the bundle anew")
    files, derived = (_contents(manifest, about.get(group)) for group in ("files", "derived"))
    map_name, parameters, made_by = about.get("map"), about.get("parameters"), about.get("made_by")
    if not isinstance(map_name, str) or map_name not in files or not map_name.startswith(f"{MAP_FOLDER}/"):
        raise MapError(f"{manifest}: is damaged: its map is none of the files in {MAP_FOLDER}/: {_MAKE_ANEW}")
    if not isinstance(parameters, dict) or not isinstance(made_by, dict):
        raise MapError(f"{manifest}: is damaged: it has no parameters, or does not say what made it: {_MAKE_ANEW}")
    return Bundle(folder, map_name, files, derived, parameters, made_by)


def map_in(path: str | Path) -> Path:
    """Return the path of the map in a bundle; what is none as it is; raise MapError as `read_bundle`."""
    bundle = read_bundle(path)
    return Path(path) if bundle is None else bundle.map


def _contents(manifest: Path, group: Any) -> dict[str, Content]:
    """Return the contents of a group of files by their path in the folder."""
    if not isinstance(group, dict):
        raise MapError(f"{manifest}: is damaged: it lists no files: {_MAKE_ANEW}")
    contents = {}
    for name, about in group.items():
        _check_inside(manifest, name)
        size, digest = (about.get("bytes"), about.get("sha256")) if isinstance(about, dict) else (None, None)
        if type(size) is not int or size < 0 or not isinstance(digest, str) or not _SHA256.fullmatch(digest):
            raise MapError(f"{manifest}: is damaged: it has no size and SHA-256 of {name!r}: {_MAKE_ANEW}")
        contents[name] = [size, digest]
    return contents


def _check_inside(manifest: Path, name: str) -> None:
    """Raise MapError for a path that is not in the folder, by its words or by a link."""
    try:
        inside = (manifest.parent / name).resolve().is_relative_to(manifest.parent.resolve())
    except (ValueError, OSError, RuntimeError):  # a zero in it, too long, a circle of links
        inside = False
    if not inside or ".." in Path(name).parts or Path(name).as_posix() != name:
        raise MapError(f"{manifest}: names {name!r}, which is not a file in the bundle: take no bundle that does")
