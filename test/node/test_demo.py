"""The demo, as `make demo` runs it, and what it says when things go wrong."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest

from gsfeatloc_ros.client.bag_player import Reply, play_bag
from gsfeatloc_ros.client.process import running_localizer
from gsfeatloc_ros.client.score import score
from gsfeatloc_ros.simulate import write_bag
from gsfeatloc_ros.tools.demo import TOPICS, main, make_parser, row, summary


def test_demo_localizes_photos_of_a_bag(tmp_path):
    command = [sys.executable, "-m", "gsfeatloc_ros.tools.demo", "--photos", "3", "--matcher", "sift"]
    done = subprocess.run([*command, "--out", tmp_path], capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert sum(line.split()[:1] in (["1"], ["2"], ["3"]) for line in lines) == 3 + 3
    assert lines[-2].startswith("localized 3 of 3 (100 %) within 1 degree and 2 cm; median error 0.")
    assert lines[-1].startswith("without a prior: localized 3 of 3 (100 %) within 1 degree and 2 cm; median error 0.")
    assert cv2.imread(str(tmp_path / "photos.png")).shape[1] > 3 * 640
    assert "ready" in (tmp_path / "localizer.log").read_text()


def reply(T_map_camera, **evidence) -> Reply:
    return Reply("100.000000000", T_map_camera, evidence, 250.0)


def test_failures_and_wrong_answers_are_not_successes(room_photos):
    photo = room_photos[0]
    good = score(photo, reply(photo.T_map_camera, inliers="99"))
    wrong = score(photo, reply(photo.T_map_camera_prior, inliers="21"))
    refused = score(photo, reply(None, reason="7 inliers between the photo and the render"))
    silent = score(photo, Reply("100.000000000", None, {}, float("nan")))
    assert [each.success for each in (good, wrong, refused, silent)] == [True, False, False, False]
    assert "0.000 deg   0.00 cm        99     250" in row(1, good)
    assert row(3, refused).endswith("no answer: 7 inliers between the photo and the render")
    assert row(4, silent).endswith("no answer: none came in time")
    assert summary([good, good, good, refused]) == (
        "localized 3 of 4 (75 %) within 1 degree and 2 cm; median error 0.00 degrees, 0.0 cm; median 250 ms"
    )
    assert summary([silent]) == "localized 0 of 1 (0 %) within 1 degree and 2 cm; no answers"


def test_the_old_name_of_an_option_works_with_a_notice(capsys):
    assert make_parser().parse_args(["--queries", "7"]).photos == 7
    assert "--queries is now --photos" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["--photos", "0"])
    assert "--photos: '0' is not a whole number of at least 1" in capsys.readouterr().err


@pytest.fixture
def bag(tmp_path, room_camera, room_photos):
    write_bag(tmp_path / "bag", room_camera, room_photos[:1])
    return tmp_path / "bag"


def test_player_says_when_there_is_no_localizer(bag):
    with pytest.raises(TimeoutError, match=r"no localizer on .*/prior.* within 0\.5 s"):
        next(play_bag(bag, TOPICS, is_running=lambda: True, start_timeout=0.5))


def test_player_says_when_the_localizer_has_ended(bag, tmp_path):
    with (
        running_localizer({"map.path": tmp_path / "no_such_map.ply"}, log=tmp_path / "log") as localizer,
        pytest.raises(RuntimeError, match="the localizer has ended"),
    ):
        next(play_bag(bag, TOPICS, is_running=lambda: localizer.alive))
    assert "no_such_map.ply" in (tmp_path / "log").read_text()


def test_localizer_is_gone_after_the_demo_even_when_it_is_interrupted(room_map_file, tmp_path):
    with pytest.raises(KeyboardInterrupt), running_localizer({"map.path": room_map_file}) as localizer:
        raise KeyboardInterrupt
    assert not localizer.alive


def test_no_answer_leaves_the_error_unknown(room_photos):
    scored = score(room_photos[0], reply(None))
    assert np.isnan(scored.error).all()
    assert scored.prior_error[0] > 1
