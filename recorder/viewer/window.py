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
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, TypeVar

from rerun.experimental import ViewerClient, ViewerState

from recorder.viewer.canvas import PICTURE, SIMULATED
from recorder.viewer.page import Page
from rig.base.closeable import Closing
from rig.base.errors import InputError, Words
from rig.serve.waiting import Deadline

Kind = Literal["native", "web", "headless"]
_Answer = TypeVar("_Answer")
_NO_ANSWER = (ConnectionError, TimeoutError, RuntimeError)
"""What rerun raises of a viewer that is not there, is not there yet, or has too much to do."""

_HOST = "127.0.0.1"
_PORT, _WEB_PORT = 9876, 9090
_PAGE = "notebook=1&theme=dark"
"""As in a notebook: the page then sends no usage reports and looks for no updates, which no environment can tell it."""
_ASKED_S = 0.2
_READY_S = 60.0
_LOADED_S = 240.0
"""On a busy machine without a graphics card one answer may take the 15 s that rerun itself waits for a picture."""
_TOLD_S = 15.0
_SETTLED_S = 0.5
_PICTURES = 8
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


class Window(Closing):
    """A running rerun viewer, or the server of one.

    Attributes:
        url: Where a recording stream connects to.
        address: What to open in a browser; empty if it is not that kind.
        page: What browsers are served; None if it is not that kind.
    """

    def __init__(
        self,
        kind: Kind,
        *,
        size: tuple[int, int] = (1920, 1080),
        live: bool = False,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Start it and wait until it listens.

        Args:
            kind: What it is.
            size: Of the picture [pixels].
            live: For a stream without end: little is kept.
            tell: Is told in words if something takes long.

        Raises:
            WindowError: It ended at once, or does not listen in time.
        """
        memory = "512MiB" if live else "2GiB"
        # A browser that comes later takes in all that the server kept before anything new.
        history = "1MiB" if live else memory
        self._tell = tell
        self._taken: int | None = None
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
            # A viewer listens before it looks for a screen, and without one for a graphics driver at its first picture.
            if kind == "native":
                self._ask(lambda viewer: viewer.get_state().viewer_version)
                threading.Thread(target=self._watch, name="viewer watch", daemon=True).start()
            elif kind == "headless":
                self._ask(lambda viewer: viewer.take_screenshot(max_size=64))
            else:
                asked = f"url=rerun%2Bhttp%3A%2F%2F{_HOST}%3A{port}%2Fproxy&{_PAGE}"
                viewer = f"http://{_HOST}:{own_port}"
                self.page = Page(_HOST, web_port, viewer=viewer, query=asked, timeline=PICTURE, rests=live)
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

    def taken(self) -> int | None:
        """Number of the latest picture that the viewer, or the slowest browser, has taken in; None if nobody looks."""
        return self._taken if self.page is None else self.page.taken()

    def _watch(self) -> None:
        """Ask a viewer on the screen again and again how far it is: it answers with its next frame."""
        viewer = ViewerClient.connect(self.url)
        while self.open:
            with contextlib.suppress(*_NO_ANSWER):
                self._taken = _end_of(PICTURE, viewer.get_state())
            time.sleep(_ASKED_S)

    def picture(self, path: Path, *, at_s: float, end_s: float) -> None:
        """Save what it shows at an instant.

        Args:
            path: PNG file to write.
            at_s: Simulated time to show [s].
            end_s: Last instant that was drawn [s]: as long as it is not there, it is waited for.

        Raises:
            WindowError: It does not show the recording in time.
        """
        self._ask(lambda viewer: _end_of(SIMULATED, viewer.get_state()) >= round(end_s * 1e9) - 1000)
        self._ask(lambda viewer: viewer.set_time(SIMULATED, duration=at_s, play_state="paused") or True)
        # Nothing tells that the last of it is on the screen: it is when two pictures are equal.
        picture = b""
        for _ in range(_PICTURES):
            time.sleep(_SETTLED_S)
            before, picture = picture, self._ask(lambda viewer: viewer.take_screenshot())
            if picture == before:
                break
        path.write_bytes(picture)

    def _ask(self, asked: Callable[[ViewerClient], _Answer]) -> _Answer:
        """Ask the viewer until it gives an answer that is one."""
        for _ in self._while_it_runs(_LOADED_S, 0.1):
            with contextlib.suppress(*_NO_ANSWER):
                answer = asked(ViewerClient.connect(self.url))
                if answer:
                    return answer
        raise WindowError(
            f"the viewer did not load the recording and answer within {_LOADED_S:g} s (a busy machine?): "
            f"{self.last_words()}"
        )

    def last_words(self) -> str:
        """The end of what it printed."""
        # Read in place: the process writes through the same position in the file.
        size = os.fstat(self._output.fileno()).st_size
        lines = os.pread(self._output.fileno(), size, 0).decode(errors="replace").strip().splitlines()
        telling = [line for line in lines if "rror" in line or "panicked" in line] or lines
        return telling[-1].strip() if telling else "it said nothing"

    def close(self) -> None:
        """End it and all that it started."""
        if self.page is not None:
            self.page.close()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGTERM)
        self.wait(_ENDED_S)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(_ENDED_S)
        self._output.close()

    def _wait_for(self, port: int) -> None:
        for _ in self._while_it_runs(_READY_S, 0.05):
            with contextlib.suppress(OSError), socket.create_connection((_HOST, port), timeout=1.0):
                return
        raise WindowError(f"the viewer does not listen on port {port} after {_READY_S:g} s: {self.last_words()}")

    def _while_it_runs(self, timeout_s: float, pause_s: float) -> Iterator[None]:
        """Again and again for a time, with a pause after each turn."""
        deadline, report = Deadline(timeout_s), Deadline(_TOLD_S)
        for _ in deadline.polls(pause_s):
            if not self.open:
                raise WindowError(f"the viewer could not start: {self.last_words()}")
            if report.passed:
                report = Deadline(_TOLD_S)
                waited_s = timeout_s - deadline.left_s
                self._tell(f"waiting for the viewer since {waited_s:.0f} s, at most {timeout_s:.0f} s")
            yield


def _end_of(timeline: str, state: ViewerState) -> int:
    """The end of a time line in a viewer; 0 where nothing is there yet."""
    lines = (line for recording in state.recordings for line in recording.timelines if line.name == timeline)
    return max((line.end or 0 for line in lines), default=0)


def picture_of(path: Path, *, tell: Callable[[str], None], size: tuple[int, int]) -> Window:
    """Start a viewer that draws a picture of a size [px]; `tell` receives a text if something takes long.

    Raises:
        InputError: This machine cannot draw.
    """
    try:
        return Window("headless", tell=tell, size=size)
    except WindowError as error:
        must = "used where a Vulkan driver is installed (Debian: libvulkan1 mesa-vulkan-drivers)"
        raise InputError("--screenshot", must, Words(f"{path}; {error}")) from None
