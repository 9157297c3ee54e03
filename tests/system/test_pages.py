"""README and docs are correct: their commands and Python blocks are run, page by page, in order.

A line of a block with "first terminal" in its comment runs in parallel to the others, until the page's next use of that
terminal or its end; "ends with 1" is the expected exit status. Directives for this test are in a comment above a block:
`file: NAME` (save it), `long: HOW LONG` (run with RIG_LONG_PAGES=1), `needs: PROGRAM` (run where it is installed),
`elsewhere: WHY` (never run here).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import pytest
import typer

from tests.processes import COMPILE_S, ROOT
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = [*PAGES, ROOT / "CONTRIBUTING.md"]
PORTS = (7460, 7461, 7462, 7463, 8765, 31763)
"""Ports of the pages' rig, bus, instruments, Foxglove server and NI-DAQmx device."""
_RUNS_LONG_BLOCKS = bool(os.environ.get("RIG_LONG_PAGES"))
_BLOCK = re.compile(r"(?:^<!-- ([^\n]*) -->\n)?^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_READY = {
    "run": "listening on",
    "replay": "listening on",
    "record": "rig: recording",
    "twins": "Ctrl-C ends",
    "foxglove": "Ctrl-C ends",
    "daqmx": "Ctrl-C ends",
    "modbus": "Ctrl-C ends",
    "view": "Ctrl-C ends",
    "-m": "Connected to",  # python -m can.logger
    "plain_device.py": "joined",
}
"""Output of a command that keeps running, from which others may rely on it."""


@dataclass
class Running:
    """A command in a separate terminal."""

    line: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    status: int

    @property
    def ends_with_the_rig(self) -> bool:
        """True if it serves or records a rig."""
        return self.line.split()[1] in ("run", "replay", "record")

    def said(self) -> str:
        """Return its present output."""
        return Path(self.log.name).read_text(encoding="utf-8", errors="replace")

    def end(self, *, by_itself: bool) -> None:
        """Wait until it has ended as the page describes: without a signal, or by Ctrl-C."""
        if not by_itself:
            with contextlib.suppress(subprocess.TimeoutExpired):  # it may be about to end with the rig
                self.process.wait(2.0)
            self.process.send_signal(signal.SIGINT)
        status = self.process.wait(PATIENCE_S)
        self.log.close()
        assert status == self.status, f"{self.line}\n{self.said()}"


@dataclass
class Reader:
    """A user who follows a page in an empty folder."""

    folder: Path
    terminals: dict[str, Running] = field(default_factory=dict)
    settings: list[str] = field(default_factory=list)
    """Shell variables set by the preceding lines."""

    def do(self, directive: str, language: str, text: str) -> None:
        """Execute one block."""
        what, _, rest = directive.partition(": ")
        if what == "elsewhere" or (what == "long" and not _RUNS_LONG_BLOCKS):
            return
        if what == "needs" and shutil.which(rest) is None:
            return
        if what == "file":
            (self.folder / rest).write_text(text, encoding="utf-8")
        elif language == "python":
            self._run(f"{sys.executable} -", 0, stdin=text)
        else:
            for line in text.splitlines():
                self.type(line)

    def type(self, line: str) -> None:
        """Type one line of a block at the terminal that its comment names."""
        command, _, comment = (part.strip() for part in line.partition(" #"))
        ends = re.search(r"ends with (\d+)", comment)
        status = int(ends[1]) if ends else 0
        terminal = re.search(r"(\w+) terminal", comment)
        if re.match(r"(export )?[A-Z_]+=", command):
            self.settings.append(command)
        elif terminal and "after Ctrl-C" in comment:
            self.terminals.pop(terminal[1]).end(by_itself=False)
            self._run(command, status)
        elif terminal:
            self._start(terminal[1], command, status)
        else:
            self._run(command, status)
            if command.startswith("rig stop"):  # its recorder ends with it
                for name in [name for name, each in self.terminals.items() if each.ends_with_the_rig]:
                    self.terminals.pop(name).end(by_itself=True)

    def _script(self, command: str) -> list[str]:
        return ["bash", "-c", "\n".join([*self.settings, command])]

    def _environment(self) -> dict[str, str]:
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        kept = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
        return {**kept, "PATH": path, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "COLUMNS": "80"}

    def _run(self, command: str, status: int, *, stdin: str | None = None) -> None:
        done = subprocess.run(
            self._script(command),
            cwd=self.folder,
            env=self._environment(),
            input=stdin,
            text=True,
            capture_output=True,
            timeout=COMPILE_S if not _RUNS_LONG_BLOCKS else None,
        )
        output = f"{command}\n{stdin or ''}{done.stdout}{done.stderr}"
        if command.startswith("rig info") and "inconclusive: accuracy" in done.stdout:
            status = 3  # the phase of a live impact decides whether its error estimate warns
        assert done.returncode == status, output
        assert "Traceback" not in done.stderr, output

    def _start(self, terminal: str, command: str, status: int) -> None:
        if terminal in self.terminals:
            self.terminals.pop(terminal).end(by_itself=True)
        log = (self.folder / f"{terminal}-{len(self.terminals)}.log").open("wb")
        process = subprocess.Popen(
            self._script(f"exec {command}"), cwd=self.folder, env=self._environment(), stdout=log, stderr=log
        )
        running = self.terminals[terminal] = Running(command, process, log, status)
        deadline = time.monotonic() + COMPILE_S
        while _READY[command.split()[1]] not in running.said():
            assert process.poll() is None, f"{command}\n{running.said()}"
            assert time.monotonic() < deadline, f"{command}\n{running.said()}"
            time.sleep(0.05)

    def leave(self) -> None:
        """End the remaining programs of the page, the oldest first."""
        for running in reversed(self.terminals.values()):
            running.end(by_itself=False)

    def kill(self) -> None:
        """End all programs, in any state."""
        for running in self.terminals.values():
            running.process.kill()
            running.process.wait()
            running.log.close()


def read_blocks(page: Path) -> list[tuple[str, str, str]]:
    """Return directive, language and text of a page's blocks."""
    return [(found[1] or "", found[2], found[3]) for found in _BLOCK.finditer(page.read_text(encoding="utf-8"))]


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    """One reader at a time on this machine, because pages name the default ports."""
    with (Path(tempfile.gettempdir()) / "rig-pages.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for port in PORTS:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    pytest.fail(f"port {port} is in use, which the pages' commands would talk to: end that rig first")
        someone = Reader(tmp_path)
        try:
            yield someone
        finally:
            someone.kill()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_and_code_of_a_page_run(page: Path, reader: Reader) -> None:
    shutil.copytree(ROOT / "docs", reader.folder, dirs_exist_ok=True)  # files next to the page
    blocks = [block for block in read_blocks(page) if not block[0].endswith(" command")]
    assert blocks or page.stem in ("install", "development")
    for block in blocks:
        reader.do(*block)
    reader.leave()


def test_the_readme_has_two_install_commands() -> None:
    commands = {
        directive: text for directive, _, text in read_blocks(ROOT / "README.md") if directive.endswith(" command")
    }
    assert set(commands) == {"demo command", "test command"}
    create = r"python3 -m venv \.venv && \.venv/bin/pip install -q "
    assert re.fullmatch(rf"{create}'\.\[\w+\]' && .*\n", commands["demo command"])
    assert re.fullmatch(
        rf"{create}--no-compile --require-hashes .*\n.*pip install .* -e \. && .*\n", commands["test command"]
    )


def find_commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of `rig` in a text, in its blocks or between backticks."""
    for span in re.findall(r"(?<!`)`(rig [^`]+)`", text) + re.findall(r"^(rig [^#|>\n]+)", text, re.MULTILINE):
        yield span.split()[1:]


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_every_command_in_the_docs_exists_with_its_options(page: Path) -> None:
    from rig.cli.app import rig
    from rig.cli.command import Group

    found = 0
    for words in find_commands(page.read_text(encoding="utf-8")):
        command: Any = rig()
        rest = list(words)
        while isinstance(command, Group) and rest and not rest[0].startswith("-"):
            command = command.get_command(typer.Context(command), rest.pop(0))
        options = {name for parameter in command.params for name in [*parameter.opts, *parameter.secondary_opts]}
        options |= {"--help", "-h"}
        for word in rest:
            if word.startswith("-") and not re.match(r"-(\d|-$)", word):  # numbers follow `--`
                assert word.rstrip(",.;)").partition("=")[0] in options, f"{word} in: rig {' '.join(words)}"
                found += 1
    assert found or page.stem in ("python", "CHANGELOG")


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = target.partition("#")
        assert re.match(r"https?:", target) or (page.parent / path).exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", (page.parent / path).read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}, target
    if page.stem == "README":
        assert {f"docs/{other.name}" for other in PAGES[1:]} <= set(re.findall(r"\]\(([^)\s]+)\)", text))
