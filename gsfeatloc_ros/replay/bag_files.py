"""The files of a rosbag2: .mcap or .db3, whole or compressed with zstd.

They are told by their content. metadata.yaml is not needed, and not read: what it says is in the files too, and it is
what is missing or wrong after a recording that was cut short or copied in part.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Protocol, TypeAlias

from backports import zstd
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel as McapChannel
from mcap.records import Schema, Statistics
from mcap.summary import Summary
from rosbags.rosbag2 import StoragePlugin

from gsfeatloc_ros.common.safe_files import open_regular

_MCAP, _SQLITE, _ZSTD, _ROS1 = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd", b"#ROSBAG V"
# Of a file of SQLite: header, and where it has the size of a page and their number (sqlite.org/fileformat.html).
_SQLITE_HEADER = 100
_PAGE_SIZE, _PAGES = slice(16, 18), slice(28, 32)
_SUFFIXES = (".mcap", ".db3")
# A file that was compressed as a whole unpacks to no more than so many times its size, or any to so many bytes; and to
# no more than this share of the disk that is free.
_MAX_UNPACKED, _ANY_UNPACKED, _MAX_DISK = 100, 10**9, 0.5
_BLOCK_BYTES = 1 << 20


class BagError(ValueError):
    """A bag cannot be read, or lacks what is asked of it; the message names it and says what to do."""


# Number of messages of each channel; times of the first and the last.
_Numbers: TypeAlias = "tuple[dict[Channel, int], tuple[int, int] | None]"


@dataclass(frozen=True)
class Channel:
    """What was recorded on a topic: messages of a type, in an encoding; ROS 2 has no other than "cdr"."""

    topic: str
    type: str
    encoding: str


class BagFile(Protocol):
    """A file of a bag.

    Attributes:
        storage: how its messages are stored.
        counts: number of messages of each channel.
        times: of the first and the last message, in nanoseconds; None where there is none.
    """

    storage: StoragePlugin
    counts: dict[Channel, int]
    times: tuple[int, int] | None

    def messages(self, topics: Collection[str]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, time in nanoseconds and bytes of each message on these topics, in the order of time."""


def open_files(path: Path, stack: ExitStack) -> list[BagFile]:
    """Open the files of a bag, a folder or one file, in the order of time; `stack` closes them.

    Raises:
        BagError: there is none, or one cannot be read.
    """
    files = [path]
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.is_file() and set(file.suffixes) & set(_SUFFIXES)]
        if not files:
            raise BagError(f"{path}: is no rosbag2: this folder has no {' or '.join(_SUFFIXES)} file")
    opened = []
    for file in files:
        try:
            opened.append(_open(file, stack))
        except BagError:
            raise
        except Exception as error:  # the libraries pass on whatever the decompressor, the database ... raise
            raise BagError(f"{file}: cannot be read: {in_words(error)}") from error
    return sorted(opened, key=lambda file: file.times or (0, 0))


def in_words(error: Exception) -> str:
    """Return what an error says, in one line; some say nothing, then its type."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _open(path: Path, stack: ExitStack) -> BagFile:
    file = stack.enter_context(open_regular(path))
    start = file.read(_SQLITE_HEADER)
    if start.startswith(_ZSTD):
        return _open(_unpacked(path, Path(stack.enter_context(tempfile.TemporaryDirectory()))), stack)
    if start.startswith(_ROS1):
        raise BagError(f"{path}: is a bag of ROS 1: convert it with rosbags-convert")
    for magic, is_whole, opened in ((_MCAP, _is_whole_mcap, _McapFile), (_SQLITE, _is_whole_sqlite, _SqliteFile)):
        # Of a file that was cut short, the start of its start may be all there is.
        if start.startswith(magic) or magic.startswith(start):
            if not start.startswith(magic) or not is_whole(file, start):
                raise BagError(f"{path}: was cut short while it was recorded or copied: try ros2 bag reindex")
            return opened(path, file, stack)
    raise BagError(f"{path}: is no file of a rosbag2: neither MCAP nor SQLite")


def _unpacked(path: Path, folder: Path) -> Path:
    """Return a file in a folder with what is in one that was compressed as a whole."""
    size, free = path.stat().st_size, shutil.disk_usage(folder).free
    left = min(max(_MAX_UNPACKED * size, _ANY_UNPACKED), int(_MAX_DISK * free))
    unpacked = folder / path.stem
    with zstd.open(path, "rb") as compressed, unpacked.open("wb") as whole:
        while block := compressed.read(_BLOCK_BYTES):
            left -= len(block)
            if left < 0:
                raise BagError(
                    f"{path}: unpacks to more than {_MAX_UNPACKED} times its size, or than is good for the disk of "
                    f"{folder.parent} ({1e-9 * free:.1f} GB are free): unpack it with zstd -d"
                )
            whole.write(block)
    return unpacked


def _is_whole_mcap(file: IO[bytes], start: bytes) -> bool:
    size = file.seek(0, 2)
    file.seek(max(0, size - len(_MCAP)))
    return size > 2 * len(_MCAP) and file.read() == _MCAP


def _is_whole_sqlite(file: IO[bytes], start: bytes) -> bool:
    if len(start) < _SQLITE_HEADER:
        return False
    page = int.from_bytes(start[_PAGE_SIZE], "big")
    return file.seek(0, 2) >= int.from_bytes(start[_PAGES], "big") * (65536 if page == 1 else page)


class _McapFile:
    storage = StoragePlugin.MCAP

    def __init__(self, path: Path, file: IO[bytes], stack: ExitStack) -> None:
        self._file = file
        file.seek(0)
        self._seeking = SeekingReader(file, validate_crcs=True)
        summary = self._seeking.get_summary()
        # Of the summary at the end of the file each part may be left out.
        self._has_index = summary is not None and bool(summary.chunk_indexes and summary.channels)
        if summary is not None and summary.statistics is not None and self._has_index:
            self.counts, self.times = _counted(summary, summary.statistics)
        else:
            self.counts, self.times = self._scanned()

    def messages(self, topics: Collection[str]) -> Iterator[tuple[Channel, int, bytes]]:
        return self._read(topics, in_order=True)

    def _read(self, topics: Collection[str] | None, in_order: bool) -> Iterator[tuple[Channel, int, bytes]]:
        if self._has_index:
            recorded = self._seeking.iter_messages(topics, log_time_order=in_order)
        else:
            # In the order of the file: all would have to be kept to sort them.
            self._file.seek(0)
            recorded = NonSeekingReader(self._file).iter_messages(topics, log_time_order=False)
        for schema, channel, message in recorded:
            yield _channel(channel, schema), message.log_time, message.data

    def _scanned(self) -> _Numbers:
        """Return counts and times by reading all messages."""
        counts: Counter[Channel] = Counter()
        first, last = None, None
        for channel, time, _ in self._read(None, in_order=False):
            counts[channel] += 1
            first = time if first is None else min(first, time)
            last = time if last is None else max(last, time)
        return dict(counts), None if first is None or last is None else (first, last)


def _counted(summary: Summary, statistics: Statistics) -> _Numbers:
    """Return counts and times by the summary of an .mcap."""
    counts: Counter[Channel] = Counter()
    for number, channel in summary.channels.items():
        found = _channel(channel, summary.schemas.get(channel.schema_id))
        counts[found] += statistics.channel_message_counts.get(number, 0)
    times = statistics.message_start_time, statistics.message_end_time
    return dict(counts), times if statistics.message_count else None


def _channel(channel: McapChannel, schema: Schema | None) -> Channel:
    return Channel(channel.topic, schema.name if schema else "", channel.message_encoding)


class _SqliteFile:
    storage = StoragePlugin.SQLITE3

    def __init__(self, path: Path, file: IO[bytes], stack: ExitStack) -> None:
        self._database = sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)
        stack.callback(self._database.close)
        topics = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        self._channels = {number: Channel(*(str(text) for text in texts)) for number, *texts in topics}
        found = self._database.execute(
            "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY 1"
        )
        numbers = found.fetchall()
        counted = {number: count for number, count, _, _ in numbers}
        self.counts = {channel: counted.get(number, 0) for number, channel in self._channels.items()}
        times = list(chain.from_iterable(row[2:] for row in numbers))
        self.times = (min(times), max(times)) if times else None

    def messages(self, topics: Collection[str]) -> Iterator[tuple[Channel, int, bytes]]:
        wanted = [number for number, channel in self._channels.items() if channel.topic in topics]
        marks = ",".join("?" * len(wanted))
        select = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
        for number, time, data in self._database.execute(select, wanted):
            yield self._channels[number], time, data
