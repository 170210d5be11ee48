"""Bags as people have them: what nobody asked for does not matter, and only what is cut short is said to be."""

from __future__ import annotations

import os
import sqlite3

import numpy as np
import pytest
from backports import zstd
from bags import TOPICS, image, write_messages
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from gsfeatloc_ros.replay import bag as bag_module
from gsfeatloc_ros.replay import bag_files
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.bag_files import BagError

IMAGE = TOPICS["image"]
ROLES = {Role.IMAGE: [IMAGE]}
STORE = get_typestore(Stores.ROS2_JAZZY)
SMALL = np.zeros((4, 6, 3), np.uint8)
storages = pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])


def cdr(stamp: float) -> bytes:
    message = image(stamp, SMALL)
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def stamps(path, roles=ROLES) -> list[int]:
    with open_bag(path, roles) as bag:
        found = [each.message.header.stamp.sec for each in bag.messages() if each.role is Role.IMAGE]
        assert bag.images == len(found)
        return found


def write_mcap(path, *, profile="ros2", wanted="cdr", **options):
    """An .mcap with images, and beside them channels of every kind."""
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start(profile)
        schemas = {
            "json": writer.register_schema("Foo", "jsonschema", b'{"type": "object"}'),
            "protobuf": writer.register_schema("foo.Bar", "protobuf", b"\x0a\x01"),
            "cdr idl": writer.register_schema("my_msgs/msg/Odd", "ros2idl", b"module broken {"),
            "cdr msg": writer.register_schema("my_msgs/msg/Worse", "ros2msg", b"no definition ["),
            "cdr event": writer.register_schema("std_srvs/srv/Trigger_Event", "ros2msg", b"string event\n"),
            "cdr unknown": 0,
        }
        for name, schema in schemas.items():
            channel = writer.register_channel(f"/{name.replace(' ', '_')}", name.split()[0], schema)
            writer.add_message(channel, 1, b"{}", 1)
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"also no definition [")
        channel = writer.register_channel(IMAGE, wanted, schema)
        for stamp in (2, 1):  # not in the order of time
            writer.add_message(channel, stamp, cdr(stamp), stamp)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="indexed"),
        pytest.param({"use_statistics": False}, id="not counted"),
        pytest.param({"profile": ""}, id="of another recorder"),
    ],
)
def test_other_channels_do_not_matter(tmp_path, options):
    assert stamps(write_mcap(tmp_path / "a.mcap", **options)) == [1, 2]


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"repeat_channels": False}])
def test_without_an_index_messages_come_in_the_order_of_the_file(tmp_path, options):
    assert stamps(write_mcap(tmp_path / "a.mcap", **options)) == [2, 1]


def test_a_wanted_topic_must_be_of_ros_2(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", wanted="json")
    with pytest.raises(BagError, match=f"{IMAGE} is encoded as json: only ROS 2's own cdr is read"):
        stamps(path)


@storages
def test_metadata_does_not_matter(tmp_path, storage):
    bag = write_messages(tmp_path / "bag", [(IMAGE, image(5.0, SMALL))], storage)
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    for changed in (text.replace(storage.name.lower(), "''", 1), "{", ""):
        metadata.write_text(changed)
        assert stamps(bag) == [5]
    metadata.unlink()
    assert stamps(bag) == [5]


@storages
def test_compressed_files_and_messages(tmp_path, storage):
    bag = write_messages(tmp_path / "bag", [(IMAGE, image(5.0, SMALL))], storage)
    (file,) = bag.glob("bag.*")
    (bag / f"{file.name}.zstd").write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    assert stamps(bag) == [5]
    assert stamps(bag / f"{file.name}.zstd") == [5]


def test_messages_that_were_compressed_one_by_one(tmp_path):
    kind = {IMAGE: "sensor_msgs/msg/Image"}
    compressed = (IMAGE, ("sensor_msgs/msg/Image", zstd.compress(cdr(5.0))))
    assert stamps(write_messages(tmp_path / "bag", [compressed], topics=kind)) == [5]


def test_a_message_that_unpacks_to_too_much_is_reported(tmp_path, monkeypatch):
    cut_short, whole = (zstd.compress(content) for content in (bytes(10_000_000), cdr(5.0)))
    monkeypatch.setattr(bag_module, "_MAX_MESSAGE_BYTES", 1_000_000)
    write_messages(tmp_path / "bag", [(IMAGE, ("sensor_msgs/msg/Image", data)) for data in (cut_short, whole)])
    with open_bag(tmp_path / "bag", ROLES) as bag:
        bomb, image_ = bag.messages()
    assert bomb.message is None
    assert "unpacks to more than 1 megabytes" in bomb.problem
    assert image_.message.header.stamp.sec == 5


@pytest.mark.parametrize("limit", [("_MAX_UNPACKED", 10), ("_MAX_DISK", 1e-9)])
def test_a_file_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, limit):
    monkeypatch.setattr(bag_files, "_ANY_UNPACKED", 100_000)
    monkeypatch.setattr(bag_files, *limit)
    monkeypatch.setattr(bag_files.tempfile, "tempdir", str(tmp_path))
    bomb = tmp_path / "bag.mcap.zstd"
    bomb.write_bytes(zstd.compress(b"\x89MCAP0\r\n" + bytes(10_000_000)))
    with pytest.raises(BagError, match=r"bag\.mcap\.zstd: unpacks to more than"), open_bag(bomb, ROLES):
        pass
    assert list(tmp_path.iterdir()) == [bomb]


@pytest.mark.parametrize("name", ["bag.mcap", "bag.db3"])
def test_a_pipe_is_no_bag_and_is_not_waited_for(tmp_path, name: str):
    os.mkfifo(tmp_path / name)
    with pytest.raises(BagError, match="is not a regular file"), open_bag(tmp_path / name, ROLES):
        pass
    with pytest.raises(BagError, match="has no"), open_bag(tmp_path, ROLES):
        pass


def test_files_of_a_split_recording_come_in_the_order_of_time(tmp_path):
    first = write_messages(tmp_path / "first", [(IMAGE, image(5.0, SMALL))])
    second = write_messages(tmp_path / "second", [(IMAGE, image(6.0, SMALL))], step=0.1)
    (second / "second.mcap").rename(first / "a_name_before.mcap")
    assert stamps(first) == [5, 6]


@storages
def test_only_what_is_cut_short_is_said_to_be(tmp_path, storage):
    bag = write_messages(tmp_path / "bag", [(IMAGE, image(5.0, SMALL))], storage)
    (file,) = bag.glob("bag.*")
    whole = file.read_bytes()
    for size in (0, 7, 99, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:size])
        with pytest.raises(BagError, match=f"{file.name}: was cut short .* try ros2 bag reindex"):
            stamps(bag)
    file.write_bytes(whole[:40] + b"\xff" * (len(whole) - 60) + whole[-20:])
    with pytest.raises(BagError) as error:
        stamps(bag)
    assert "cut short" not in str(error.value)


def test_a_database_of_something_else(tmp_path):
    database = sqlite3.connect(tmp_path / "a.db3")
    database.execute("CREATE TABLE songs (name TEXT)")
    database.commit()
    database.close()
    with pytest.raises(BagError, match=r"a\.db3: cannot be read: no such table: topics"):
        stamps(tmp_path / "a.db3")
