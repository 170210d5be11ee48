"""The panel by which a prior is sent to a running node."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from viser import GuiEvent, ViserServer

from gsfeatloc_ros.common.geometry import isotropic_covariance, make_pose, matrix_from_quaternion, so3_exp
from gsfeatloc_ros.view.clicks import Clicks
from gsfeatloc_ros.view.words import plain


class PriorSender(Protocol):
    """What sends priors to a node."""

    def send_base(self, pose: np.ndarray, covariance: np.ndarray) -> str:
        """Send a pose (4, 4) of the base with its covariance (6, 6), as RViz does; return what was sent where."""

    def send_camera(self, pose: np.ndarray, covariance: np.ndarray) -> str:
        """Send a pose (4, 4) of the camera with its covariance (6, 6); return what was sent where."""


class PriorPanel:
    """Sends the robot's pose by two clicks, or the camera's by where the user stands.

    Args:
        server: of the page.
        clicks: asks for points.
        sender: sends it.
    """

    def __init__(self, server: ViserServer, clicks: Clicks, sender: PriorSender) -> None:
        self._clicks, self._sender = clicks, sender
        gui = server.gui
        gui.add_markdown("A prior says to the node where to look first.")
        self._metres = gui.add_number("Known to, map units", 0.5, min=1e-3)
        self._degrees = gui.add_number("Known to, degrees", 15.0, min=0.1, max=180.0)
        gui.add_button("Base: click where it is, then what it faces").on_click(lambda _: self._ask())
        gui.add_button("Camera: as I look now").on_click(self._send_view)
        self._said = gui.add_markdown("")

    def say(self, text: str) -> None:
        """Show a text that may come from elsewhere."""
        self._said.content = f"**{plain(text)}**"

    def _ask(self) -> None:
        def then(points: np.ndarray, seen_from: np.ndarray) -> None:
            pose = base_facing(points[0], points[1])
            if pose is None:
                self.say("one is above the other: click the second farther away")
                return
            self.say(self._sender.send_base(pose, self._covariance()))

        self._clicks.ask("where the base stands on the floor, then what it faces", 2, then)

    def _send_view(self, event: GuiEvent) -> None:
        if event.client is None:
            return
        w, x, y, z = event.client.camera.wxyz
        pose = make_pose(matrix_from_quaternion([x, y, z, w]), event.client.camera.position)
        self.say(self._sender.send_camera(pose, self._covariance()))

    def _covariance(self) -> np.ndarray:
        return isotropic_covariance(self._metres.value, float(np.radians(self._degrees.value)))


def base_facing(place: np.ndarray, target: np.ndarray) -> np.ndarray | None:
    """Return the pose (4, 4) of a base (x ahead, z up) that stands upright at a point (3,) and faces another (3,).

    None where one is above the other.
    """
    ahead = target[:2] - place[:2]
    if not np.linalg.norm(ahead) > 0:
        return None
    yaw = np.arctan2(ahead[1], ahead[0])
    return make_pose(so3_exp(np.array([0.0, 0.0, yaw])), place)
