"""Web page with rerun's viewer: a short address, no requests to other sites, and progress reports.

The page is fetched from rerun's server and extended by a script that posts the viewer's state. Posted data are limited
in size, number and time, and only one number is read from them.
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
_EXTERNAL_LINK = re.compile(rb"<link[^>]*https://fonts[^>]*>")
_PAGE = re.compile(r"[a-z0-9]{1,16}")
_SIZE = re.compile(r"[0-9]{1,9}")
_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]+)?")
"""Accepted `Host` headers; another site may resolve its own name to this address (DNS rebinding)."""
_MAX_BODY_BYTES = 1 << 20
_MAX_PAGES = 32
_SILENCE_S = 30.0
"""Silence after which a page counts as closed [s]; a busy page may be silent while it loads or draws."""
_HIDDEN_LIMIT_S = 15.0
"""Time after which a hidden page is unloaded [s], as it processes no data; it reloads when visible."""
_SCRIPT = """<script>
const page = Math.random().toString(36).slice(2);
let visibleMs = Date.now();
async function report() {
  if (!document.hidden) visibleMs = Date.now();
  if (Date.now() - visibleMs > %s) return location.replace("resting");
  try {
    if (document.hidden) navigator.sendBeacon("closed?" + page);
    else {
      const state = window._handle ? window._handle.viewer_state() : "";
      const reply = await fetch("state?" + page, {method: "POST", body: state});
      document.title = await reply.text();
    }
  } catch (error) { console.debug(error); }
  setTimeout(report, 200);
}
addEventListener("pagehide", () => navigator.sendBeacon("closed?" + page));
report();
</script></body>"""
_RESTING_PAGE = b"""<!doctype html><title>rig: resting</title><script>
document.addEventListener("visibilitychange", () => document.hidden || location.replace("/"));
document.hidden || location.replace("/");
</script>"""


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Suppress errors of browsers that disconnect, which would clutter the terminal."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class Page:
    """Server of the page on its own thread, with the progress of each browser.

    Attributes:
        title: Title of the page in the browsers.
    """

    def __init__(self, host: str, port: int, *, viewer: str, query: str, timeline: str, rests: bool = False) -> None:
        """Start listening.

        Args:
            host: Host to listen on.
            port: Port to listen on.
            viewer: URL of rerun's page.
            query: Query string for that page.
            timeline: Timeline whose end measures the progress of a browser.
            rests: Unload hidden pages and reload them when visible, instead of letting them fall behind.
        """
        self.title = "rig"
        self._viewer = viewer
        self._query = query
        self._timeline = timeline
        self._script = _SCRIPT % (round(1000.0 * _HIDDEN_LIMIT_S) if rests else "Infinity")
        self._progress: dict[str, tuple[int, float]] = {}
        self._lock = threading.Lock()
        page = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 10.0

            def do_GET(self) -> None:
                page._get(self)

            def do_POST(self) -> None:
                page._post(self)

            def log_message(self, format: str, *args: object) -> None:
                """Suppress the request log, which would clutter the terminal."""

        self._server = _Server((host, port), Handler)
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="page", daemon=True).start()

    def get_processed_picture(self) -> int | None:
        """Return the number of the latest picture that the slowest browser has, 0 for none; None without a browser."""
        now_s = time.monotonic()
        with self._lock:
            self._progress = {page: entry for page, entry in self._progress.items() if now_s - entry[1] < _SILENCE_S}
            return min((number for number, _ in self._progress.values()), default=None)

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def _get(self, request: BaseHTTPRequestHandler) -> None:
        path, _, query = request.path.partition("?")
        if not _OWN_HOST.fullmatch(request.headers.get("Host", "")):
            return request.send_error(HTTPStatus.BAD_REQUEST)
        if path == "/resting":
            return _reply(request, _RESTING_PAGE)
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
            body = _EXTERNAL_LINK.sub(b"", body).replace(b"</body>", self._script.encode())
        return _reply(request, body, kind=kind)

    def _post(self, request: BaseHTTPRequestHandler) -> None:
        path, _, page = request.path.partition("?")
        size = request.headers.get("Content-Length", "")
        # Browsers send the origin of a page, or null to hide it; other programs send none.
        host = request.headers.get("Host", "")
        own = _OWN_HOST.fullmatch(host) and request.headers.get("Origin") in (None, f"http://{host}")
        if not own or path not in ("/state", "/closed") or not _PAGE.fullmatch(page) or not _SIZE.fullmatch(size):
            return request.send_error(HTTPStatus.BAD_REQUEST)
        if int(size) > _MAX_BODY_BYTES:
            return request.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        number = end_of(self._timeline, request.rfile.read(int(size)))
        with self._lock:
            if path == "/closed":
                self._progress.pop(page, None)
            elif page in self._progress or len(self._progress) < _MAX_PAGES:
                self._progress[page] = (number, time.monotonic())
        return _reply(request, self.title.encode(), kind="text/plain; charset=utf-8")


def _reply(request: BaseHTTPRequestHandler, body: bytes, *, kind: str = "text/html; charset=utf-8") -> None:
    request.send_response(HTTPStatus.OK)
    request.send_header("Content-Type", kind)
    request.send_header("Content-Length", str(len(body)))
    request.end_headers()
    request.wfile.write(body)


def end_of(timeline: str, state: bytes) -> int:
    """Return the end of a timeline in a viewer's state; 0 if it is absent or the state is invalid.

    Args:
        timeline: Name of the timeline.
        state: `GetStateResponse` of rerun's viewer control. In it a timeline's name is followed by its type (field 2)
            and its range (field 3): an optional start, and an end.
    """
    number = rb"[\x80-\xff]{0,9}[\x00-\x7f]"
    ends = re.findall(timeline.encode() + rb"\x10.\x1a.(?:\x08%b)?\x10(%b)" % (number, number), state, re.DOTALL)
    # Protobuf varint: seven bits per byte, lowest first.
    return max((sum((byte & 0x7F) << 7 * at for at, byte in enumerate(end)) for end in ends), default=0)
