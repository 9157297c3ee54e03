"""The page of the web viewer: additions to rerun's own, and handling of the browsers' reports."""

from __future__ import annotations

import http.client
import socket
import struct
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import pytest

from recorder.viewer import page
from recorder.viewer.canvas import SIMULATED
from recorder.viewer.window import free_port
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.wallclock

# Report of a browser with rerun 0.41, as received, with its views cut off.
STATE = (
    b"\nHabout:recording?app_id=rig&recording_id=25718b766d4b4e7f9b698300588bf302\x12.Recording:rig:"
    b"25718b766d4b4e7f9b698300588bf302\x1a\xe7\x01\n.Recording:rig:25718b766d4b4e7f9b698300588bf302"
    b'\x12$\n\x10\n\x0esimulated_time\x10\x02\x1a\x06\x10\xb0\xab\xf9\x9d\x15"\x06\x08\xb0\xab\xf9\x9d\x15'
    b"\x12%\n\x0b\n\twall_time\x10\x03\x1a\x14\x08\x80\xfc\xd9\x95\xfe\xcb\x9c\xf5\x18\x10\x80\x84\xa0\xb4\x93\xcc\x9c\xf5\x18"
    b"\x1a\x1c\n\x10\n\x0esimulated_time\x10\x02\x1a\x06\x08\xb0\xab\xf9\x9d\x15"
)


class Rerun(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = b'<html><link href="https://fonts.googleapis.com/x"><body>viewer</body></html>'
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def served() -> Iterator[tuple[page.Page, str]]:
    with HTTPServer(("127.0.0.1", 0), Rerun) as rerun:
        Thread(target=rerun.serve_forever, args=(0.02,), daemon=True).start()
        port = free_port(0)
        viewer = f"http://127.0.0.1:{rerun.server_address[1]}"
        shown = page.Page("127.0.0.1", port, viewer=viewer, query="url=x", timeline=SIMULATED)
        yield shown, f"http://127.0.0.1:{port}"
        shown.close()
        rerun.shutdown()


def post(address: str, body: bytes) -> str:
    with urllib.request.urlopen(address, data=body, timeout=PATIENCE_S) as reply:
        return reply.read().decode()


def test_the_page_adds_a_script_and_uses_no_other_site(served: tuple[page.Page, str]) -> None:
    with urllib.request.urlopen(served[1], timeout=PATIENCE_S) as reply:
        body = reply.read()
        assert reply.url.endswith("/?url=x")
    assert b"viewer_state()" in body
    assert b"viewer" in body
    assert b"googleapis" not in body


def test_the_slowest_browser_sets_the_rate(served: tuple[page.Page, str]) -> None:
    shown, address = served
    assert shown.get_processed_picture() is None
    shown.title = "rig: 0.1 s behind"
    assert post(f"{address}/state?a", STATE) == "rig: 0.1 s behind"
    assert shown.get_processed_picture() == 5_699_950_000
    post(f"{address}/state?b", b"")  # a page that is still loading
    assert shown.get_processed_picture() == 0
    post(f"{address}/closed?b", b"")
    assert shown.get_processed_picture() == 5_699_950_000


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://example.com"},
        {"Origin": "null"},  # a frame of another site that hides its origin
        {"Origin": "http://example.com", "Host": "example.com"},  # a site that resolves its own name to our address
        {"Host": "example.com"},
    ],
)
def test_reports_of_other_sites_are_refused(served: tuple[page.Page, str], headers: dict[str, str]) -> None:
    for data in (STATE, None) if "Host" in headers else (STATE,):
        request = urllib.request.Request(f"{served[1]}/state?a", data=data, headers=headers)
        with pytest.raises(urllib.error.HTTPError, match="400"):
            urllib.request.urlopen(request, timeout=PATIENCE_S)
    assert served[0].get_processed_picture() is None


@pytest.mark.parametrize("begun", [b"GET /?url=x", b"POST /state?a"])
def test_a_browser_that_disconnects_prints_nothing(
    served: tuple[page.Page, str], begun: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    host = served[1].removeprefix("http://")
    with socket.create_connection(("127.0.0.1", int(host.partition(":")[2])), timeout=PATIENCE_S) as browser:
        browser.sendall(begun + b" HTTP/1.1\r\nHost: " + host.encode() + b"\r\nContent-Length: 9\r\n\r\na")
        browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # it resets the connection
    assert post(f"{served[1]}/state?b", b"")
    served[0].close()
    assert not capfd.readouterr().err


@pytest.mark.parametrize(
    ("method", "path", "size", "status"),
    [
        ("POST", "/state?A", "0", 400),
        ("POST", "/state?" + "a" * 17, "0", 400),
        ("POST", "/other?a", "0", 400),
        ("POST", "/state?a", "many", 400),
        ("POST", "/state?a", str((1 << 20) + 1), 413),
        ("POST", "/state?a", "9" * 5000, 400),
        ("GET", "/../secret", "0", 404),
        ("GET", "/%2e%2e/x", "0", 404),
        ("PUT", "/state?a", "0", 501),
    ],
)
def test_invalid_reports_are_refused(
    served: tuple[page.Page, str], method: str, path: str, size: str, status: int
) -> None:
    connection = http.client.HTTPConnection(served[1].removeprefix("http://"), timeout=PATIENCE_S)
    connection.request(method, path, headers={"Content-Length": size})
    assert connection.getresponse().status == status
    connection.close()
    assert served[0].get_processed_picture() is None


def test_pages_are_not_without_number(served: tuple[page.Page, str]) -> None:
    shown, address = served
    for number in range(32):
        post(f"{address}/state?{number}", STATE)
    post(f"{address}/state?more", b"")
    assert shown.get_processed_picture() == 5_699_950_000


@pytest.mark.parametrize("cut", range(0, len(STATE), 7))
def test_a_truncated_state_is_refused_or_unchanged(cut: int) -> None:
    assert page.end_of(SIMULATED, STATE[:cut]) in (0, 5_699_950_000)


def test_a_line_with_a_start() -> None:
    assert page.end_of("wall_time", STATE) > 1_700_000_000_000_000_000
    assert page.end_of("other", STATE) == 0
