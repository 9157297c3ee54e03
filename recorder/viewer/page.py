"""rerun's web viewer at an address of our own: short, without requests to other sites, and it tells how far it is.

The page is rerun's, fetched from its server, with a script that sends the viewer's own description of its state. What
comes in so is checked here: bounded in size, number and time, and read as far as one number.
"""

from __future__ import annotations

import re
import sys
import threading
import time
import urllib.request
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

_FILE = re.compile(r"/[A-Za-z0-9_]*(\.(js|wasm|ico|png|svg))?")
_FOREIGN = re.compile(rb"<link[^>]*https://fonts[^>]*>")
_PAGE = re.compile(r"[a-z0-9]{1,16}")
_SIZE = re.compile(r"[0-9]{1,9}")
_HERE = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]+)?")
"""What a page of ours is asked for by; another site may give a name of its own our address."""
_MOST_BYTES = 1 << 20
_MOST_PAGES = 32
_FORGOTTEN_S = 30.0
"""A page that tells nothing for so long is lost, not only busy loading or painting [s]."""
_REST_S = 15.0
"""A page that nobody sees paints nothing and takes nothing in: after so long it leaves, to come back when seen [s]."""
_SCRIPT = """<script>
const page = Math.random().toString(36).slice(2);
let seen = Date.now();
async function tell() {
  if (!document.hidden) seen = Date.now();
  if (Date.now() - seen > %s) return location.replace("resting");
  try {
    if (document.hidden) navigator.sendBeacon("closed?" + page);
    else {
      const state = window._handle ? window._handle.viewer_state() : "";
      const reply = await fetch("state?" + page, {method: "POST", body: state});
      document.title = await reply.text();
    }
  } catch (error) { console.debug(error); }
  setTimeout(tell, 200);
}
addEventListener("pagehide", () => navigator.sendBeacon("closed?" + page));
tell();
</script></body>"""
_RESTING = b"""<!doctype html><title>rig: resting</title><script>
document.addEventListener("visibilitychange", () => document.hidden || location.replace("/"));
document.hidden || location.replace("/");
</script>"""


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing for a browser that goes in the middle of a file or a word: the terminal is ours."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class Page:
    """Serves the page on a thread of its own, and knows how far each browser has come.

    Attributes:
        title: What the browsers show as the page's title.
    """

    def __init__(self, host: str, port: int, *, viewer: str, query: str, timeline: str, rests: bool = False) -> None:
        """Listen.

        Args:
            host: Where.
            port: Where.
            viewer: URL of rerun's own page.
            query: What that page is asked for.
            timeline: Whose end tells how far a browser has come.
            rests: A page that is not seen leaves and begins anew when it is, instead of falling behind.
        """
        self.title = "rig"
        self._viewer = viewer
        self._query = query
        self._timeline = timeline
        self._script = _SCRIPT % (round(1000.0 * _REST_S) if rests else "Infinity")
        self._told: dict[str, tuple[int, float]] = {}
        self._lock = threading.Lock()
        page = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 10.0

            def do_GET(self) -> None:
                page._get(self)

            def do_POST(self) -> None:
                page._post(self)

            def log_message(self, format: str, *args: object) -> None:
                """Nothing: the terminal is ours."""

        self._server = _Server((host, port), Handler)
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="page", daemon=True).start()

    def taken(self) -> int | None:
        """Number of the latest picture that the slowest browser has, 0 where it has none; None without any browser."""
        now_s = time.monotonic()
        with self._lock:
            self._told = {page: told for page, told in self._told.items() if now_s - told[1] < _FORGOTTEN_S}
            return min((number for number, _ in self._told.values()), default=None)

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()

    def _get(self, request: BaseHTTPRequestHandler) -> None:
        path, _, query = request.path.partition("?")
        if not _HERE.fullmatch(request.headers.get("Host", "")):
            return request.send_error(HTTPStatus.BAD_REQUEST)
        if path == "/resting":
            return _reply(request, _RESTING)
        if path == "/" and query != self._query:
            request.send_response(HTTPStatus.FOUND)
            request.send_header("Location", f"/?{self._query}")
            request.send_header("Content-Length", "0")
            return request.end_headers()
        if not _FILE.fullmatch(path):
            return request.send_error(HTTPStatus.NOT_FOUND)
        try:
            with urllib.request.urlopen(self._viewer + path, timeout=30.0) as reply:
                body, kind = reply.read(), reply.headers.get("Content-Type", "")
        except OSError:
            return request.send_error(HTTPStatus.NOT_FOUND)
        if path == "/":
            body = _FOREIGN.sub(b"", body).replace(b"</body>", self._script.encode())
        return _reply(request, body, kind=kind)

    def _post(self, request: BaseHTTPRequestHandler) -> None:
        path, _, page = request.path.partition("?")
        size = request.headers.get("Content-Length", "")
        # A browser says from which site a page speaks, or null where it hides that; programs say nothing.
        host = request.headers.get("Host", "")
        ours = _HERE.fullmatch(host) and request.headers.get("Origin") in (None, f"http://{host}")
        if not ours or path not in ("/state", "/closed") or not _PAGE.fullmatch(page) or not _SIZE.fullmatch(size):
            return request.send_error(HTTPStatus.BAD_REQUEST)
        if int(size) > _MOST_BYTES:
            return request.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        number = end_of(self._timeline, request.rfile.read(int(size)))
        with self._lock:
            if path == "/closed":
                self._told.pop(page, None)
            elif page in self._told or len(self._told) < _MOST_PAGES:
                self._told[page] = (number, time.monotonic())
        return _reply(request, self.title.encode(), kind="text/plain; charset=utf-8")


def _reply(request: BaseHTTPRequestHandler, body: bytes, *, kind: str = "text/html; charset=utf-8") -> None:
    request.send_response(HTTPStatus.OK)
    request.send_header("Content-Type", kind)
    request.send_header("Content-Length", str(len(body)))
    request.end_headers()
    request.wfile.write(body)


def end_of(timeline: str, state: bytes) -> int:
    """The end of a timeline in a viewer's state; 0 where there is no such line, or it is no such state.

    Args:
        timeline: Its name.
        state: A `GetStateResponse` of rerun's viewer control. In it a timeline's name is followed by its type (field 2)
            and its range (field 3): a start, which may be missing, and an end.
    """
    number = rb"[\x80-\xff]{0,9}[\x00-\x7f]"
    ends = re.findall(timeline.encode() + rb"\x10.\x1a.(?:\x08%b)?\x10(%b)" % (number, number), state, re.DOTALL)
    # A protobuf number has seven bits in each byte, the lowest first.
    return max((sum((byte & 0x7F) << 7 * at for at, byte in enumerate(end)) for end in ends), default=0)
