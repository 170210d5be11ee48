"""The installed localizer in a process of its own."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from signal import SIGINT, Signals

from ament_index_python.packages import PackageNotFoundError, get_package_prefix, get_package_share_directory

# What the localizer writes when images need no prior any more.
INDEX_READY = "the view index is ready"
# Seconds. Generous: the first start on a machine compiles kernels, and CI machines are slow and shared.
START_TIMEOUT = 180.0
# Seconds that the localizer may take to leave after a signal; with less, a localization may still be under way.
STOP_TIMEOUT = 10.0
_POLL_PERIOD = 0.02


def executable() -> Path:
    """Return the file that `ros2 run gsfeatloc_ros localizer` runs."""
    return Path(get_package_prefix("gsfeatloc_ros")) / "lib" / "gsfeatloc_ros" / "localizer"


def node_arguments(parameters: Mapping[str, object], remappings: Mapping[str, str] | None = None) -> list[str]:
    """Return the command line that sets config/localizer.yaml, then `parameters`, and remaps names."""
    defaults = _config_folder() / "localizer.yaml"
    arguments = ["--ros-args", "--params-file", str(defaults)]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={value}"]
    for name, other in (remappings or {}).items():
        arguments += ["-r", f"{name}:={other}"]
    return arguments


def isolate_ros() -> None:
    """Let this process and its children talk to each other over ROS and to nobody else, large images included.

    Raises:
        RuntimeError: the package is not installed where ROS looks.
    """
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(_config_folder() / "fastdds.xml"))


def _config_folder() -> Path:
    try:
        return Path(get_package_share_directory("gsfeatloc_ros")) / "config"
    except PackageNotFoundError as error:
        raise RuntimeError("gsfeatloc_ros is not installed where ROS looks: source its install/setup.bash") from error


class LocalizerProcess:
    """A started localizer with all that it prints.

    Args:
        arguments: its command line, as of node_arguments().
        log: file that takes what it prints; a temporary one by default.
        environment: changes of this process's; None takes a variable out.
    """

    def __init__(
        self, arguments: Sequence[str], log: Path | None = None, environment: Mapping[str, str | None] | None = None
    ) -> None:
        self._log = tempfile.TemporaryFile() if log is None else log.open("w+b")  # noqa: SIM115 - see close()
        self._last_output = ""
        changed: dict[str, str | None] = {**os.environ, **(environment or {})}
        self._process = subprocess.Popen(
            [executable(), *arguments],
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env={name: value for name, value in changed.items() if value is not None},
        )

    @property
    def output(self) -> str:
        """All that it printed up to now."""
        if self._log.closed:
            return self._last_output
        # Without a seek, which would move the place where it writes.
        size = os.fstat(self._log.fileno()).st_size
        return os.pread(self._log.fileno(), size, 0).decode(errors="replace")

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def wait_for_output(self, pattern: str, timeout: float) -> None:
        """Wait until the output matches a regular expression.

        Raises:
            RuntimeError: it ended without.
            TimeoutError: it did not print that within `timeout` seconds.
        """
        deadline = time.monotonic() + timeout
        while True:
            # In this order: what it prints at last is read before it is said to have ended.
            ended = not self.alive
            if re.search(pattern, self.output):
                return
            if ended:
                raise RuntimeError(f"the localizer has ended without {pattern!r} in its output:\n{self.output}")
            if time.monotonic() > deadline:
                raise TimeoutError(f"no {pattern!r} within {timeout:g} s in the output:\n{self.output}")
            time.sleep(_POLL_PERIOD)

    def wait_until_ready(self, timeout: float = START_TIMEOUT) -> None:
        """Wait until it serves a map; errors are those of wait_for_output()."""
        self.wait_for_output(r"localizer\]: ready", timeout)

    def signal(self, number: Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def wait(self, timeout: float) -> int:
        """Return the exit status once it has ended by itself.

        Raises:
            subprocess.TimeoutExpired: it still runs after `timeout` seconds.
        """
        return self._process.wait(timeout)

    def stop(self, number: Signals = SIGINT, timeout: float = STOP_TIMEOUT) -> int:
        """Ask it to leave, kill it after `timeout` seconds, and return the exit status."""
        self.signal(number)
        try:
            return self.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def close(self) -> None:
        """Close the file of what it printed; `output` stays."""
        self._last_output = self.output
        self._log.close()


@contextmanager
def running_localizer(
    parameters: Mapping[str, object], remappings: Mapping[str, str] | None = None, log: Path | None = None
) -> Iterator[LocalizerProcess]:
    """Start the localizer, and stop it on leaving; it may not be ready yet."""
    process = LocalizerProcess(node_arguments(parameters, remappings), log)
    try:
        yield process
    finally:
        process.stop()
        process.close()
