"""The page of the installed gsfeatloc view, in a real browser."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from functools import partial

import browser as chromium
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file

NAMES = "stamp,status,reason,x,y,z,qx,qy,qz,qw,var_x,var_y,var_z,var_rx,var_ry,var_rz"
# The camera stands in the middle of the room and looks along x.
ANSWER = "1.5,localized,well done,0,0,1.5,-0.5,0.5,-0.5,0.5,1e-4,1e-4,1e-4,1e-6,1e-6,1e-6"
FAILURE = "2.5,failed,<b>dark</b>,,,,,,,,,,,,,"

needs_chromium = pytest.mark.skipif(not chromium.EXECUTABLE, reason=f"there is no {' or '.join(chromium.NAMES)}")


@contextmanager
def served(map_file, *options):
    """Serve the page of a map; yield its address."""
    command = [sys.executable, "-P", "-m", "gsfeatloc_ros.tools.view", map_file, "--port", "0", "--gaussians", "2000"]
    # Who runs tests in the background has them ignore Ctrl-C, and their children inherit that.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True, preexec_fn=heed)
    try:
        address = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+", address)
        yield address
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def page(room_map_file, tmp_path_factory):
    """The address of the page, and the parameter file that it may write."""
    folder = tmp_path_factory.mktemp("view")
    (folder / "replayed").mkdir()
    (folder / "replayed" / "answers.csv").write_text("\n".join([NAMES, ANSWER, FAILURE]))
    with served(room_map_file, "--answers", folder / "replayed", "--out", folder / "map.yaml") as address:
        yield address, folder / "map.yaml"


@needs_chromium
def test_a_user_sees_the_map_stands_at_an_answer_and_sets_the_floor(page, tmp_path):
    address, parameters = page
    with chromium.browser(address, tmp_path / "profile") as user:
        user.wait_for_text("room.ply")

        def spread():
            # Left of the panel.
            return user.screenshot()[100:, :250].std()

        # The map is no white page.
        chromium.wait_for(lambda: spread() > 15, "the map")
        user.press("Answers")
        user.wait_for_text("2 images: 1 failed, 1 localized")
        user.press("1: 1.50 s, localized")
        user.wait_for_text("well done")
        user.wait_for("document.querySelectorAll('img').length > 0")
        user.press("2: 2.50 s, failed")
        # As it is, and no HTML.
        user.wait_for_text("<b>dark</b>")
        user.press("Frame")
        user.press("Floor: find it in the map")
        user.wait_for_text("off that")
        user.press("Write map.yaml")
        user.wait_for_text("wrote ")
        user.press("Scale: click two points so far apart")
        user.wait_for_text("0 of 2 clicked")
        # Left of the panel, and below what viser says of a browser without a GPU.
        user.click(60, 300)
        user.wait_for_text("1 of 2 clicked")
        user.click(250, 420)
        user.wait_for_text("units are 1 m: scale")
    values = read_parameter_file(parameters)
    np.testing.assert_allclose(values["map.translation"], [0, 0, 0], atol=0.05)


@needs_chromium
def test_a_prior_of_the_base_that_is_clicked_is_drawn(room_map_file, tmp_path):
    served_live = served(room_map_file, "--live", "--gaussians", "20000")
    with served_live as address, chromium.browser(address, tmp_path / "profile") as user:
        user.wait_for_text("room.ply")

        def yellow():
            """Return how many pixels left of the panel are about of the prior's colour."""
            red, green, blue = np.moveaxis(user.screenshot()[140:, :300].astype(int), 2, 0)
            return (np.minimum(red, green) > blue + 70).sum()

        chromium.wait_for(lambda: user.screenshot()[100:, :250].std() > 15, "the map")
        before = yellow()
        user.press("Prior")
        user.press("Base: click where it is")
        user.wait_for_text("0 of 2 clicked")
        user.click(240, 420)
        user.wait_for_text("1 of 2 clicked")
        user.click(285, 320)
        user.wait_for_text("sent on /initialpose, but nobody listens there")
        chromium.wait_for(lambda: yellow() > before + 150, "the base")


def test_a_page_from_elsewhere_is_not_served(page):
    import viser

    address = page[0].replace("http", "ws")
    protocol = [f"viser-v{viser.__version__}"]
    with connect(address, subprotocols=protocol, origin=page[0]) as own:
        assert own.recv(30)
    with (
        pytest.raises((ConnectionClosed, InvalidStatus)),
        connect(address, subprotocols=protocol, origin="https://evil.example") as foreign,
    ):
        foreign.recv(30)
