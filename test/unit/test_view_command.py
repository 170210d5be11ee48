"""The command line of view: what cannot be used is said in one line, before a page is served."""

from __future__ import annotations

import pytest
from small_maps import random_map

from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.tools.view import main


@pytest.fixture
def map_file(tmp_path):
    write_ply(tmp_path / "map.ply", random_map(50, 0, seed=0))
    return str(tmp_path / "map.ply")


def test_a_file_that_cannot_be_written_is_said_before_the_page_is_served(map_file, tmp_path, capsys):
    assert main([map_file, "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"view: {tmp_path}: cannot be written, it is a folder: name another file\n"


@pytest.mark.parametrize("options", [["--bag", "bag"], ["--live", "--answers", "replayed"], ["--port", "x"]])
def test_options_that_do_not_go_together_are_refused(map_file, options):
    with pytest.raises(SystemExit) as ended:
        main([map_file, *options])
    assert ended.value.code == 2


def test_an_address_that_this_machine_has_not_is_named(tmp_path, capsys):
    pytest.importorskip("viser")
    # Of documentation (RFC 5737): nobody has it.
    assert main([str(tmp_path / "room.ply"), "--host", "192.0.2.1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("view: 192.0.2.1: this machine cannot listen there: ")


def test_a_port_that_is_none_is_named(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["room.ply", "--port", "65536"])
    assert "argument --port: '65536' is not a whole number of at least 0 and at most 65535" in capsys.readouterr().err
