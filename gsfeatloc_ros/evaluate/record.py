"""A file of results, a JSON line each, that an interrupted evaluation goes on from.

What results depend on, the settings, the code, the map, the photos and the priors, is kept with them as hashes: results
of anything else are not taken.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gsfeatloc_ros
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import open_regular, read_regular
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.metrics import QueryResult
from gsfeatloc_ros.evaluate.protocol import PhotoPrior
from gsfeatloc_ros.evaluate.run import Run

# Rooms of the package that no result depends on.
_NOT_MEASURED = (
    "align",
    "benchmark",
    "client",
    "inspect",
    "node",
    "replay",
    "simulate",
    "tools",
    "view",
    "evaluate/report",
)

# Of dataparser_transforms.json, which has 17 numbers.
_MAX_PLACED_BYTES = 100_000_000


@dataclass(frozen=True)
class Fingerprint:
    """What the results of a run depend on: its settings, and hashes of the rest."""

    settings: dict[str, Any]
    code: str
    map: str
    photos: str
    priors: str

    @property
    def id(self) -> str:
        """A hash of all."""
        return _digest([json.dumps(asdict(self), sort_keys=True).encode()])

    @property
    def version(self) -> str:
        """A hash of the files of the scene."""
        return self.map + self.photos


class Record:
    """The results in a file. It is written to after every result, so that nothing is lost when the program ends.

    Attributes:
        path: the file; None keeps nothing.
        notes: what a user should know of results that were dropped.
    """

    def __init__(self, path: Path | None) -> None:
        """Open a record; what is not a line of one, such as a last line cut short, is dropped.

        Raises:
            OSError: the file cannot be read.
        """
        self.path = path
        self.notes: list[str] = []
        self._fingerprints: dict[str, dict[str, Any]] = {}
        self._results: dict[str, dict[tuple[str, int], QueryResult]] = {}
        if path and path.exists():
            self._read(path)

    def __len__(self) -> int:
        """Number of results of all runs."""
        return sum(len(results) for results in self._results.values())

    def done(self, fingerprint: Fingerprint) -> dict[tuple[str, int], QueryResult]:
        """Return the results that are there of a run, by photo and step; those of its older versions are dropped."""
        current = asdict(fingerprint)
        for identity, other in list(self._fingerprints.items()):
            changed = [part for part in current if current[part] != other[part]]
            if changed and "settings" not in changed:
                dropped = len(self._results.pop(identity, {}))
                del self._fingerprints[identity]
                self._write()
                self.notes.append(f"{self.path}: {' and '.join(changed)} changed, {dropped} results start over")
        return dict(self._results.get(fingerprint.id, {}))

    def append(self, fingerprint: Fingerprint, result: QueryResult) -> None:
        """Add a result."""
        results = self._results.setdefault(fingerprint.id, {})
        lines = [] if fingerprint.id in self._fingerprints else [_header(fingerprint.id, asdict(fingerprint))]
        self._fingerprints[fingerprint.id] = asdict(fingerprint)
        results[result.photo, result.step] = result
        if self.path:
            with self.path.open("a", encoding="utf-8") as file:
                file.writelines([*lines, _line(fingerprint.id, result)])

    def _read(self, path: Path) -> None:
        with open_regular(path) as stream:
            text = stream.read().decode("utf-8", errors="replace")
        complete = text.endswith("\n") or not text
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                if "result" in entry:
                    result = QueryResult(**entry["result"])
                    self._results.setdefault(entry["run"], {})[result.photo, result.step] = result
                else:
                    fingerprint = Fingerprint(**entry["fingerprint"])
                    self._fingerprints[entry["run"]] = asdict(fingerprint)
            except (ValueError, TypeError, KeyError):
                complete = False
        if not complete:
            self._write()

    def _write(self) -> None:
        if self.path is None:
            return
        lines = []
        for identity, fingerprint in self._fingerprints.items():
            lines.append(_header(identity, fingerprint))
            lines += [_line(identity, result) for result in self._results.get(identity, {}).values()]
        with replaced_file(self.path) as file:
            file.write("".join(lines).encode())


@dataclass(frozen=True)
class SceneHash:
    """Hashes of the map, and of the photos with their cameras and poses."""

    map: str
    photos: str


def hash_scene(scene: Scene) -> SceneHash:
    """Return the hashes of a scene.

    Raises:
        OSError: the map or a photo cannot be read.
    """
    map_files = sorted(scene.map_path.rglob("*.*")) if scene.map_path.is_dir() else [scene.map_path]
    return SceneHash(_files(map_files), hash_photos(scene))


def hash_photos(scene: Scene) -> str:
    """Return the hash of a scene's photos with their cameras and poses; of the photos only the sizes are taken.

    Raises:
        OSError: a photo cannot be read.
    """
    photos = []
    for photo in scene.photos:
        camera = photo.camera
        photos += [photo.name.encode(), str(photo.path.stat().st_size).encode(), photo.T_map_camera.tobytes()]
        photos += [repr((camera.width, camera.height, camera.model)).encode()]
        photos += [camera.K.tobytes(), camera.distortion.tobytes()]
    photos += [scene.trajectory.tobytes(), repr(scene.background).encode()]
    return _digest(photos)


def fingerprint_of(run: Run, scene: SceneHash, priors: Iterable[PhotoPrior]) -> Fingerprint:
    """Return the fingerprint of a run in a scene; raise OSError or ValueError where its map's place cannot be read."""
    placed = run.dataparser_transforms
    return Fingerprint(
        settings=run.settings(),
        code=_code(),
        map=scene.map if placed is None else _digest([scene.map.encode(), read_regular(placed, _MAX_PLACED_BYTES)]),
        photos=scene.photos,
        priors=_digest(prior.T_map_camera.tobytes() for prior in priors),
    )


def _code() -> str:
    root = Path(gsfeatloc_ros.__file__).parent
    others = [root / name for name in _NOT_MEASURED]
    return _files(path for path in sorted(root.rglob("*.py")) if not any(map(path.is_relative_to, others)))


def _files(paths: Iterable[Path]) -> str:
    return _digest(map(_content, paths))


def _content(path: Path) -> bytes:
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").digest()


def _digest(parts: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()[:16]


def _header(identity: str, fingerprint: dict[str, Any]) -> str:
    return json.dumps({"run": identity, "fingerprint": fingerprint}) + "\n"


def _line(identity: str, result: QueryResult) -> str:
    return json.dumps({"run": identity, "result": asdict(result)}, allow_nan=False) + "\n"
