"""Process of a rerun viewer: in a window, in the browser, or headless for a picture.

It listens only on 127.0.0.1 (rerun's default is every interface), sends no usage reports, and runs in its own process
group, which is terminated with this process; terminating only the start script would leave the viewer running.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, TypeVar

from rerun.experimental import ViewerClient, ViewerState

from recorder.viewer.canvas import PICTURE, SIMULATED
from recorder.viewer.page import Page
from rig.base.errors import InputError, Words
from rig.base.files import Closing, write_file
from rig.serve.waiting import Deadline

Kind = Literal["native", "web", "headless"]
_Reply = TypeVar("_Reply")
_NO_REPLY = (ConnectionError, TimeoutError, RuntimeError)
"""Exceptions of rerun for a viewer that is absent, not ready or busy."""

_HOST = "127.0.0.1"
_PORT, _WEB_PORT = 9876, 9090
_PAGE_OPTIONS = "notebook=1&theme=dark"
"""Notebook mode, in which the page sends no usage reports and does not check for updates."""
_POLL_INTERVAL_S = 0.2
"""Interval of the requests for the viewer's progress [s]."""
_START_TIMEOUT_S = 60.0
"""Longest wait until the viewer listens [s]."""
_REPLY_TIMEOUT_S = 240.0
"""Longest wait for a reply of the viewer [s]; without a graphics card, one screenshot may take 15 s."""
_MESSAGE_INTERVAL_S = 15.0
"""Interval of the messages during a wait [s]."""
_SCREENSHOT_INTERVAL_S = 0.5
"""Time between two screenshots that are compared [s]."""
_MAX_SCREENSHOTS = 8
"""Largest number of screenshots until two are equal."""
_EXIT_TIMEOUT_S = 5.0
"""Longest wait for the end of the process [s]."""


def screen_is_there() -> bool:
    """Return whether a window can be opened."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def environment() -> dict[str, str]:
    """Return the environment for rerun, without usage reports: none are sent with `CI` set and no override."""
    quiet = {key: value for key, value in os.environ.items() if key != "FORCE_RERUN_ANALYTICS"}
    return {**quiet, "CI": "true", "TELEMETRY_ENABLED": "false", "RUST_LOG": "warn"}


def free_port(wanted: int) -> int:
    """Return the wanted port of 127.0.0.1 if it is free, otherwise another free one."""
    for port in (wanted, 0):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with contextlib.suppress(OSError):
                probe.bind((_HOST, port))
                return int(probe.getsockname()[1])
    raise OSError(f"no port of {_HOST} is free")


class WindowError(RuntimeError):
    """Viewer that could not be started or has ended unexpectedly."""


class Window(Closing):
    """Running rerun viewer, or the server of a web viewer.

    Attributes:
        url: Address for the recording stream.
        address: Address for the browser; empty for other kinds.
        page: Page server; None for other kinds.
    """

    def __init__(
        self,
        kind: Kind,
        *,
        size: tuple[int, int] = (1920, 1080),
        live: bool = False,
        on_message: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Start the viewer and wait until it listens.

        Args:
            kind: Window, browser page or headless.
            size: Size of the picture [pixels].
            live: Whether the stream has no end, so that only little history is kept.
            on_message: Receives a message if something takes long.

        Raises:
            WindowError: The viewer ended at once, or does not listen in time.
        """
        memory = "512MiB" if live else "2GiB"
        # A browser opened later first processes everything that the server has kept.
        history = "1MiB" if live else memory
        self._on_message = on_message
        self._processed_picture: int | None = None
        self.page: Page | None = None
        port, web_port, own_port = free_port(_PORT), free_port(_WEB_PORT), free_port(0)
        ports = [port]
        command = [sys.executable, "-m", "rerun_cli", "--bind", _HOST, "--port", str(port), "--memory-limit", memory]
        self.url = f"rerun+http://{_HOST}:{port}/proxy"
        self.address = ""
        if kind == "web":
            ports.append(own_port)
            command += ["--serve-web", "--web-viewer-port", str(own_port), "--server-memory-limit", history]
            self.address = f"http://{_HOST}:{web_port}/"
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
            # A viewer listens before it opens a screen, or a graphics driver for its first picture.
            if kind == "native":
                self._request(lambda viewer: viewer.get_state().viewer_version)
                threading.Thread(target=self._watch, name="viewer watch", daemon=True).start()
            elif kind == "headless":
                self._request(lambda viewer: viewer.take_screenshot(max_size=64))
            else:
                request = f"url=rerun%2Bhttp%3A%2F%2F{_HOST}%3A{port}%2Fproxy&{_PAGE_OPTIONS}"
                viewer = f"http://{_HOST}:{own_port}"
                self.page = Page(_HOST, web_port, viewer=viewer, query=request, timeline=PICTURE, rests=live)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id, equal to the process group id."""
        return self._process.pid

    @property
    def open(self) -> bool:
        """True if the viewer is running; the user may have closed the window."""
        return self._process.poll() is None

    @property
    def failure(self) -> str:
        """Error of a viewer that has ended; empty if it was closed normally."""
        return "" if self._process.poll() in (None, 0) else self.last_output()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the viewer to be closed and return whether it was, within a timeout [s]."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return not self.open

    def get_processed_picture(self) -> int | None:
        """Return the number of the latest picture processed by the viewer or the slowest browser; None without one."""
        return self._processed_picture if self.page is None else self.page.get_processed_picture()

    def _watch(self) -> None:
        """Poll the progress of a viewer on the screen; it replies with its next frame."""
        viewer = ViewerClient.connect(self.url)
        while self.open:
            with contextlib.suppress(*_NO_REPLY):
                self._processed_picture = _end_of(PICTURE, viewer.get_state())
            time.sleep(_POLL_INTERVAL_S)

    def picture(self, path: Path, *, at_s: float, end_s: float) -> None:
        """Save a screenshot of an instant.

        Args:
            path: PNG file to write.
            at_s: Simulated time to show [s].
            end_s: Last instant drawn [s]; the viewer must have received it first.

        Raises:
            WindowError: The viewer does not show the recording in time.
        """
        self._request(lambda viewer: _end_of(SIMULATED, viewer.get_state()) >= round(end_s * 1e9) - 1000)
        self._request(lambda viewer: viewer.set_time(SIMULATED, duration=at_s, play_state="paused") or True)
        # rerun does not report a finished frame, so wait until two screenshots are equal.
        picture = b""
        for _ in range(_MAX_SCREENSHOTS):
            time.sleep(_SCREENSHOT_INTERVAL_S)
            before, picture = picture, self._request(lambda viewer: viewer.take_screenshot())
            if picture == before:
                break
        write_file(path, picture)

    def _request(self, request: Callable[[ViewerClient], _Reply]) -> _Reply:
        """Repeat a request to the viewer until the reply is not empty."""
        for _ in self._while_it_runs(_REPLY_TIMEOUT_S, 0.1):
            with contextlib.suppress(*_NO_REPLY):
                reply = request(ViewerClient.connect(self.url))
                if reply:
                    return reply
        raise WindowError(
            f"the viewer did not load the recording within {_REPLY_TIMEOUT_S:g} s (is the machine busy?): "
            f"{self.last_output()}"
        )

    def last_output(self) -> str:
        """Return the last line of output, or the last error in it."""
        # The process shares the file position, so read with an explicit one.
        size = os.fstat(self._output.fileno()).st_size
        lines = os.pread(self._output.fileno(), size, 0).decode(errors="replace").strip().splitlines()
        error_lines = [line for line in lines if "rror" in line or "panicked" in line] or lines
        return error_lines[-1].strip() if error_lines else "it printed nothing"

    def close(self) -> None:
        """Terminate the viewer and its child processes."""
        if self.page is not None:
            self.page.close()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGTERM)
        self.wait(_EXIT_TIMEOUT_S)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(_EXIT_TIMEOUT_S)
        self._output.close()

    def _wait_for(self, port: int) -> None:
        for _ in self._while_it_runs(_START_TIMEOUT_S, 0.05):
            with contextlib.suppress(OSError), socket.create_connection((_HOST, port), timeout=1.0):
                return
        raise WindowError(f"no viewer on port {port} within {_START_TIMEOUT_S:g} s: {self.last_output()}")

    def _while_it_runs(self, timeout_s: float, pause_s: float) -> Iterator[None]:
        """Yield at intervals until the timeout, while the viewer is running."""
        deadline, report = Deadline(timeout_s), Deadline(_MESSAGE_INTERVAL_S)
        for _ in deadline.polls(pause_s):
            if not self.open:
                raise WindowError(f"the viewer could not start: {self.last_output()}")
            if report.passed:
                report = Deadline(_MESSAGE_INTERVAL_S)
                waited_s = timeout_s - deadline.left_s
                self._on_message(f"waiting for the viewer for {waited_s:.0f} s, at most {timeout_s:.0f} s")
            yield


def _end_of(timeline: str, state: ViewerState) -> int:
    """Return the end of a timeline in a viewer; 0 if it has no data yet."""
    lines = (line for recording in state.recordings for line in recording.timelines if line.name == timeline)
    return max((line.end or 0 for line in lines), default=0)


def open_headless(path: Path, *, on_message: Callable[[str], None], size: tuple[int, int]) -> Window:
    """Start a viewer that draws a picture of a size [px]; `on_message` receives a text if something takes long.

    Raises:
        InputError: This machine cannot draw.
    """
    try:
        return Window("headless", on_message=on_message, size=size)
    except WindowError as error:
        must = "used where a Vulkan driver is installed (Debian: libvulkan1 mesa-vulkan-drivers)"
        raise InputError("--screenshot", must, Words(f"{path}; {error}")) from None
