"""A rerun process of our own: on the screen, in the browser, or without either for a picture.

It listens on 127.0.0.1 only (rerun's own calls listen on every interface), reports its use to nobody, and runs in a
process group that ends with us: ending the starting script alone would leave the viewer behind.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, Self

from rerun.experimental import ViewerClient, ViewerState

from recorder.viewer.canvas import SIMULATED
from rig.errors import InputError

Kind = Literal["native", "web", "headless"]

_HOST = "127.0.0.1"
_PORT, _WEB_PORT = 9876, 9090
_PAGE = "&notebook=1&theme=dark"
"""As in a notebook: the page then sends no usage reports and looks for no updates, which no environment can tell it."""
_READY_S = 30.0
_LOADED_S = 60.0
_SETTLED_S = 1.5
_ENDED_S = 5.0


def screen_is_there() -> bool:
    """Whether a window can be opened."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def environment() -> dict[str, str]:
    """Our environment without rerun's usage reports: it sends none where `CI` is set and nothing forces it to."""
    quiet = {key: value for key, value in os.environ.items() if key != "FORCE_RERUN_ANALYTICS"}
    return {**quiet, "CI": "true", "TELEMETRY_ENABLED": "false", "RUST_LOG": "warn"}


def free_port(wanted: int) -> int:
    """The wanted port of 127.0.0.1 if it is free, else another that is."""
    for port in (wanted, 0):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(OSError):
                probe.bind((_HOST, port))
                return int(probe.getsockname()[1])
    raise OSError(f"no port of {_HOST} is free")


class WindowError(RuntimeError):
    """The viewer could not be started, or it went away."""


class Window:
    """A running rerun viewer, or the server of one.

    Attributes:
        url: Where a recording stream connects to.
        address: What to open in a browser; empty if it is not that kind.
    """

    def __init__(self, kind: Kind, *, size: tuple[int, int] = (1920, 1080), memory: str = "2GiB") -> None:
        """Start it and wait until it listens.

        Raises:
            WindowError: It ended at once, or does not listen in time.
        """
        port = free_port(_PORT)
        ports = [port]
        command = [sys.executable, "-m", "rerun_cli", "--bind", _HOST, "--port", str(port), "--memory-limit", memory]
        self.url = f"rerun+http://{_HOST}:{port}/proxy"
        self.address = ""
        if kind == "web":
            web_port = free_port(_WEB_PORT)
            ports.append(web_port)
            command += ["--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", memory]
            self.address = f"http://{_HOST}:{web_port}/?url=rerun%2Bhttp%3A%2F%2F{_HOST}%3A{port}%2Fproxy{_PAGE}"
        elif kind == "headless":
            command += ["--headless", "--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen"]
        else:
            command += ["--expect-data-soon", "--hide-welcome-screen"]
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        self._process = subprocess.Popen(
            command,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            for each in ports:
                self._wait_for(each)
            # A viewer listens before it looks for a screen, and without one for a graphics driver at its first picture.
            if kind == "native":
                self._ask(lambda viewer: bool(viewer.get_state().viewer_version))
            elif kind == "headless":
                self._ask(lambda viewer: bool(viewer.take_screenshot(max_size=64)))
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process (and process group) id."""
        return self._process.pid

    @property
    def open(self) -> bool:
        """Whether it still runs: the user may close the window."""
        return self._process.poll() is None

    @property
    def failure(self) -> str:
        """What went wrong with a viewer that is not open any more; empty if it was closed in good order."""
        return "" if self._process.poll() in (None, 0) else self.last_words()

    def wait(self, timeout_s: float) -> bool:
        """Wait for it to be closed; whether it was."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return not self.open

    def picture(self, path: Path, *, at_s: float, end_s: float) -> None:
        """Save what it shows at an instant.

        Args:
            path: PNG file to write.
            at_s: Simulated time to show [s].
            end_s: Last instant that was drawn [s]: as long as it is not there, it is waited for.

        Raises:
            WindowError: It does not show the recording in time.
        """
        viewer = self._ask(lambda viewer: _reaches(viewer.get_state(), end_s))
        viewer.set_time(SIMULATED, duration=at_s, play_state="paused")
        # Nothing tells that the last of it is on the screen; a software renderer takes about a quarter of a second.
        time.sleep(_SETTLED_S)
        viewer.save_screenshot(str(path.resolve()))

    def _ask(self, satisfied: Callable[[ViewerClient], bool]) -> ViewerClient:
        """Wait until the viewer answers as wanted."""
        for _ in self._while_it_runs(_LOADED_S, 0.1):
            with contextlib.suppress(ConnectionError, RuntimeError):
                viewer = ViewerClient.connect(self.url)
                if satisfied(viewer):
                    return viewer
        raise WindowError(f"the viewer does not answer, or did not load the recording: {self.last_words()}")

    def last_words(self) -> str:
        """The end of what it printed."""
        # Read in place: the process writes through the same position in the file.
        size = os.fstat(self._output.fileno()).st_size
        lines = os.pread(self._output.fileno(), size, 0).decode(errors="replace").strip().splitlines()
        telling = [line for line in lines if "rror" in line or "panicked" in line] or lines
        return telling[-1].strip() if telling else "it said nothing"

    def close(self) -> None:
        """End it and all that it started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGTERM)
        self.wait(_ENDED_S)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(_ENDED_S)
        self._output.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for(self, port: int) -> None:
        for _ in self._while_it_runs(_READY_S, 0.05):
            with contextlib.suppress(OSError), socket.create_connection((_HOST, port), timeout=1.0):
                return
        raise WindowError(f"the viewer does not listen on port {port} after {_READY_S:g} s: {self.last_words()}")

    def _while_it_runs(self, timeout_s: float, pause_s: float) -> Iterator[None]:
        """Again and again for a time, with a pause after each turn."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if not self.open:
                raise WindowError(f"the viewer could not start: {self.last_words()}")
            yield
            time.sleep(pause_s)


def _reaches(state: ViewerState, end_s: float) -> bool:
    """Whether a viewer has a recording up to an instant on its simulated time line."""
    for recording in state.recordings:
        for timeline in recording.timelines:
            if timeline.name == SIMULATED and timeline.end is not None and timeline.end >= round(end_s * 1e9) - 1000:
                return True
    return False


def picture_of(path: Path) -> Window:
    """A viewer for a picture.

    Raises:
        InputError: This machine cannot draw.
    """
    try:
        return Window("headless")
    except WindowError as error:
        must = "used where a Vulkan driver is installed (Debian: libvulkan1 mesa-vulkan-drivers)"
        raise InputError("--screenshot", must, f"{path}; {error}") from None
