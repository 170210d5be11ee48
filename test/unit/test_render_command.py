"""gsfeatloc render: pictures, depths and videos of a map in files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from small_maps import one_gaussian, random_map

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.tools import render

IDENTITY = ["0", "0", "0", "0", "0", "0", "1"]
VIEW = ["--fov", "90", "--size", "64x48", "--threads", "1"]
# Of a field of view of 90 degrees across 64 pixels.
CAMERA = Camera(64, 48, np.array([[32.0, 0, 31.5], [0, 32.0, 23.5], [0, 0, 1]]))


@pytest.fixture
def map_path(tmp_path) -> str:
    write_ply(tmp_path / "map.ply", random_map(500, 1, seed=0))
    return str(tmp_path / "map.ply")


@pytest.fixture
def wall_path(tmp_path) -> str:
    """One large Gaussian two units ahead: all of the picture."""
    write_ply(tmp_path / "wall.ply", one_gaussian((0, 0, 2), (50, 50, 0.001), 0.999))
    return str(tmp_path / "wall.ply")


def read(path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_files_hold_what_the_renderer_draws(map_path, tmp_path):
    assert render.main([map_path, "--pose", *IDENTITY, *VIEW, "--out", str(tmp_path / "view")]) == 0
    from gsfeatloc_ros.maps import load_map

    expected = create_renderer(load_map(map_path), "cpu", 1).render(CAMERA, np.eye(4))
    np.testing.assert_array_equal(read(tmp_path / "view.png")[:, :, ::-1], expected.image())
    np.testing.assert_array_equal(np.load(tmp_path / "view_depth.npy"), expected.median_depth)
    np.testing.assert_allclose(read(tmp_path / "view_alpha.png") / 255, expected.alpha, atol=0.5 / 255 + 1e-6)
    depth = read(tmp_path / "view_depth.png")
    assert depth.dtype == np.uint16
    known = np.isfinite(expected.median_depth)
    np.testing.assert_allclose(depth[known] / 1000, expected.median_depth[known], atol=0.0006)
    assert not depth[~known].any()


def test_depth_is_in_units_of_the_map_frame_and_too_far_is_said(wall_path, tmp_path, capsys):
    there = [wall_path, "--pose", *IDENTITY, *VIEW, "--out", str(tmp_path / "wall")]
    assert render.main([*there, "--map-scale", "3"]) == 0
    assert read(tmp_path / "wall_depth.png")[24, 32] == pytest.approx(6000, abs=2)
    capsys.readouterr()
    assert render.main([*there, "--depth-scale", "100000"]) == 0
    assert "too far for 16 bits" in capsys.readouterr().err
    assert not read(tmp_path / "wall_depth.png").any()
    assert np.load(tmp_path / "wall_depth.npy")[24, 32] == pytest.approx(2.0, abs=0.01)


def test_a_line_of_a_tum_file_and_a_calibration_do_as_well(map_path, tmp_path):
    (tmp_path / "camera.yaml").write_text(
        "image_width: 64\nimage_height: 48\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [32, 0, 31.5, 0, 32, 23.5, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n"
    )
    assert render.main([map_path, "--pose", *IDENTITY, *VIEW, "--out", str(tmp_path / "one")]) == 0
    by_file = ["--camera", str(tmp_path / "camera.yaml"), "--threads", "1", "--out", str(tmp_path / "other")]
    assert render.main([map_path, "--pose", "12.5", *IDENTITY, *by_file]) == 0
    np.testing.assert_array_equal(read(tmp_path / "one.png"), read(tmp_path / "other.png"))


def test_a_path_becomes_pictures_and_a_video_that_plays(map_path, tmp_path):
    lines = [f"{stamp} {0.02 * stamp} 0 0 0 0 0 1" for stamp in range(5)]
    (tmp_path / "path.tum").write_text("# stamp x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    video = tmp_path / "path.mp4"
    where = ["--out", str(tmp_path / "frame"), "--video", str(video), "--rate", "5"]
    assert render.main([map_path, "--path", str(tmp_path / "path.tum"), *VIEW, *where]) == 0
    capture = cv2.VideoCapture(str(video))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(5)
    for number in range(5):
        there, frame = capture.read()
        assert there
        picture = read(tmp_path / f"frame_{number:04}.png").astype(float)
        assert -10 * np.log10(np.mean((frame - picture) ** 2) / 255**2) > 25
    assert not capture.read()[0]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--path", "nowhere.tum", *VIEW, "--out", "x"], "nowhere.tum: cannot be read"),
        (["--pose", *["0", "0", "0", "0", "0", "0", "0"], *VIEW, "--out", "x"], "quaternion"),
        (["--pose", *IDENTITY, "--camera", "nowhere.yaml", "--out", "x"], "nowhere.yaml: cannot be read"),
        (["--pose", *IDENTITY, *VIEW, "--out", "nowhere/x"], "there is no folder"),
        (["--path", "path.tum", "--fov", "90", "--size", "65x48", "--video", "x.mp4"], "must be even"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(arguments, says, map_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n")
    assert render.main([map_path, *arguments]) == 2
    *_, reason = capsys.readouterr().err.splitlines()
    assert reason.startswith("render: ")
    assert says in reason
    assert not list(tmp_path.glob("x*"))


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--pose", *IDENTITY, *VIEW],
        ["--pose", "1", "2", *VIEW, "--out", "x"],
        ["--pose", *IDENTITY, "--fov", "90", "--out", "x"],
        ["--pose", *IDENTITY, *VIEW, "--video", "x.mp4"],
        ["--pose", *IDENTITY, "--fov", "180", "--size", "64x48", "--out", "x"],
        ["--pose", *IDENTITY, "--fov", "90", "--size", "0x48", "--out", "x"],
    ],
)
def test_a_wrong_command_line_ends_with_its_usage(arguments, map_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        render.main([map_path, *arguments])
    assert "usage: gsfeatloc render" in capsys.readouterr().err
