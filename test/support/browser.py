"""A headless Chromium that tests talk to by its DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
EXECUTABLE = next(filter(None, map(shutil.which, NAMES)), None)
_OPTIONS = (
    *("--headless", "--no-sandbox", "--no-first-run", "--disable-quic", "--remote-debugging-port=0"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    # WebGL without a GPU, however slow.
    *("--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "--disable-gpu-watchdog",
)
# Seconds. Pictures of splats that a CPU draws take long.
TIMEOUT = 120.0


class Browser:
    """One page of a browser.

    Args:
        address: of the DevTools of the page.
    """

    def __init__(self, address: str) -> None:
        self._socket = connect(address, max_size=None, ping_interval=None)
        self._sent = 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; return its result."""
        self._sent += 1
        self._socket.send(json.dumps({"id": self._sent, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(TIMEOUT))
            if answer.get("id") == self._sent:
                assert "error" not in answer, answer
                return answer["result"]

    def run(self, script: str) -> Any:
        """Return what JavaScript is worth."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait_for(self, script: str) -> Any:
        """Wait until JavaScript is worth something that is true; return that."""
        return wait_for(lambda: self.run(script), script)

    def press(self, text: str) -> None:
        """Click the button or tab that has a text, with the mouse: some do not hear of other clicks.

        Not before it lies still with nothing over it: while a page unfolds, a click meets what was there before.
        """
        button = (
            f"[...document.querySelectorAll('button,[role=tab]')].find(b => b.textContent.includes({json.dumps(text)}))"
        )
        middle = "(r => [r.x + r.width / 2, r.y + r.height / 2])(b.getBoundingClientRect())"
        seen = f"(at => b.contains(document.elementFromPoint(...at)) && at)((b.scrollIntoView(), {middle}))"
        place = None

        def lies_still() -> bool:
            nonlocal place
            before, place = place, self.run(f"(b => b && {seen})({button})")
            return bool(place) and place == before

        wait_for(lies_still, f"a button {text} that lies still")
        self.click(*place)

    def click(self, x: float, y: float) -> None:
        """Click with the mouse at a pixel of the page."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def wait_for_text(self, text: str) -> None:
        """Wait until the page has a text."""
        self.wait_for(f"document.body.innerText.includes({json.dumps(text)})")

    def screenshot(self) -> np.ndarray:
        """Return what is seen: (H, W, 3) uint8 RGB."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@contextmanager
def browser(url: str, folder: Path, size: tuple[int, int] = (700, 450)) -> Iterator[Browser]:
    """Open a page, with a new profile in a folder."""
    process = subprocess.Popen(
        [EXECUTABLE, *_OPTIONS, f"--user-data-dir={folder}", "about:blank"], stderr=subprocess.DEVNULL
    )
    try:
        port_file = folder / "DevToolsActivePort"
        wait_for(lambda: port_file.exists() and "\n" in port_file.read_text(), "Chromium")
        with urllib.request.urlopen(f"http://127.0.0.1:{port_file.read_text().split()[0]}/json") as answer:
            pages = [target for target in json.load(answer) if target["type"] == "page"]
        page = Browser(pages[0]["webSocketDebuggerUrl"])
        width, height = size
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        page.call("Page.navigate", url=url)
        yield page
    finally:
        process.terminate()
        process.wait(TIMEOUT)


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Return what a condition is worth once it is true; fail after TIMEOUT."""
    deadline = time.monotonic() + TIMEOUT
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.3)
    return found
