"""Access control of a live rig: every row of the table, tried by every role that it names and by the others.

Each subject does everything possible with every key: it subscribes, fetches history, requests, puts, deletes, replies
and declares tokens. The effects at the rig and at an honest client must be those of the table.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh  # noqa: TID253
from cryptography import x509  # noqa: TID253
from cryptography.hazmat.primitives.asymmetric import ec  # noqa: TID253
from cryptography.x509.oid import ExtendedKeyUsageOID as Usage  # noqa: TID253

from drivers.console import Console
from rig.base.errors import InputError
from rig.serve.request_handler import RequestHandler
from rig.serve.transport import NoReplyError
from rig.serve.transport.clients import Reporter
from rig.serve.transport.exposure.access import (
    PERMISSIONS,
    PLAIN,
    ROLES,
    WITH_TRUTH,
    Action,
    Permission,
    get_permissions,
    is_allowed,
)
from rig.serve.transport.exposure.certificates import (
    SIGNER,
    CertificateIssuer,
    Holder,
    add_device,
    build_subject,
    create_keys,
    read_holder,
    remove_holder,
    write_holder,
)
from rig.serve.transport.zenoh import Exposure, ZenohClient, ZenohServer
from tests.processes import free_endpoint
from tests.waiting import PATIENCE_S, time_limit, until

pytestmark = pytest.mark.wallclock

NAMES = [name for role in ROLES for name in (role, role + WITH_TRUTH)]
STRANGER = "stranger"
KEYS = sorted({key for permission in PERMISSIONS for key in permission.keys})
FORGED = b"forged"


def example(pattern: str, chunk: str = "a") -> str:
    return pattern.replace("**", chunk).replace("*", chunk)


def get_all_replies(session: zenoh.Session, selector: str) -> Iterator[zenoh.Reply]:
    """Return all replies, also if several have one key."""
    none, anything = zenoh.ConsolidationMode.NONE, zenoh.ReplyKeyExpr.ANY
    return iter(session.get(selector, timeout=2.0, consolidation=none, accept_replies=anything))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One authority's certificates for every role, for an unknown role, and an expired one."""
    folder = tmp_path_factory.mktemp("keys")
    signing = ec.generate_private_key(ec.SECP256R1())
    issue, late = CertificateIssuer(signing, timedelta(days=1)), CertificateIssuer(signing, timedelta(minutes=-1))
    authority = issue.certificate(SIGNER, signing, None, [])
    hosts = [build_subject("127.0.0.1"), build_subject("localhost")]
    for holder, name, by, usage in (
        ("server", "the rig", issue, Usage.SERVER_AUTH),
        ("expired", "operator", late, Usage.CLIENT_AUTH),
        *((name, name, issue, Usage.CLIENT_AUTH) for name in (*NAMES, STRANGER)),
    ):
        key = ec.generate_private_key(ec.SECP256R1())
        subjects = hosts if usage is Usage.SERVER_AUTH else [x509.DNSName("client")]
        write_holder(folder / holder, authority, by.certificate(name, key, usage, subjects), key)
    create_keys(folder / "others", days=1)
    return folder


def read_settings(folder: Path) -> dict[str, Any]:
    """Return settings as `Holder.settings` does, of a folder that our own checks would refuse."""
    return {
        "root_ca_certificate": str(folder / "authority.pem"),
        "connect_certificate": str(folder / "certificate.pem"),
        "connect_private_key": str(folder / "key.pem"),
        "enable_mtls": True,
    }


@contextmanager
def open_hostile_session(locator: str, mode: str = "client", folder: Path | None = None) -> Iterator[zenoh.Session]:
    """Open a plain zenoh session, without the checks of our client."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": [locator],
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
    }
    if folder is not None:
        settings["transport/link/tls"] = read_settings(folder)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


class NormalClient(ZenohClient):
    """A normal client whose session the test can use directly."""

    @property
    def session(self) -> zenoh.Session:
        return self._session.session


class Rig:
    """Every key of the table in use, and a client of either mode that listens to everything."""

    def __init__(self, server: ZenohServer) -> None:
        self.heard: set[str] = set()
        self.shown: set[str] = set()
        self.server = server
        for permission in PERMISSIONS:
            for pattern in permission.keys:
                key = example(pattern)
                if permission.action is Action.ASK:
                    server.answer(key, lambda _: b"honest")
                elif permission.action is Action.RECEIVE:
                    server.publish(key, b"honest")
                elif permission.action is Action.SEND:
                    server.subscribe_reports(pattern, lambda key, _: self.heard.add(key))
                elif permission.action is Action.SHOW:
                    server.watch(pattern, lambda key, there: self.shown.add(key) if there else None)

    def publish(self) -> None:
        for key in receivable(PERMISSIONS):
            self.server.publish(key, b"honest")

    def announce(self) -> None:
        for permission in PERMISSIONS:
            if permission.action is Action.WATCH:
                self.server.announce(example(permission.keys[0]))


def keys_of(permissions: tuple[Permission, ...], action: Action) -> set[str]:
    return {example(key) for permission in permissions if permission.action is action for key in permission.keys}


def receivable(permissions: tuple[Permission, ...]) -> set[str]:
    return keys_of(permissions, Action.RECEIVE)


class Attempt:
    """All that a subject does, and its effects as the subject observes them."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.received: set[str] = set()
        self.heartbeats: set[str] = set()
        self.kept: list[Any] = []
        self.tokens: list[Any] = []
        every = [*map(example, KEYS), "rig/**"]
        for key in every:
            self._listen(key, lambda sample: self.received.add(str(sample.key_expr)))
            beat = f"{key}/@adv/pub/**"
            self._listen(beat, lambda sample: self.heartbeats.add(str(sample.key_expr).partition("/@adv")[0]))
            self.kept.append(session.declare_queryable(key, lambda query: query.reply(query.key_expr, FORGED)))
            self.kept.append(session.declare_queryable(f"{key}/@adv/**", lambda query: query.reply("rig/a", FORGED)))
        for pattern in KEYS:
            self.tokens.append(session.liveliness().declare_token(example(pattern)))
            # Not to its own subscriptions.
            for _ in range(5):
                session.put(example(pattern), FORGED, allowed_destination=zenoh.Locality.REMOTE)
            session.delete(example(pattern), allowed_destination=zenoh.Locality.REMOTE)

    def _listen(self, key: str, callback: Callable[[Any], None]) -> None:
        self.kept.append(self.session.declare_subscriber(key, callback))

    def answered(self, selector: str) -> set[str]:
        replies = get_all_replies(self.session, selector)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok and reply.ok.payload.to_bytes() == b"honest"}

    def history(self) -> set[str]:
        keys = {example(key) for key in KEYS}
        return set.union(*(self.answered(f"{key}/@adv/**?_max=1") for key in (*keys, "rig/**")))

    def sees(self, key: str) -> bool:
        return any(reply.ok for reply in self.session.liveliness().get(key, timeout=2.0))


SUBJECTS = [
    pytest.param(None, "client", id=f"{PLAIN}, client"),
    pytest.param(None, "peer", id=f"{PLAIN}, peer"),
    *(pytest.param(name, mode, id=f"{name}, {mode}") for name, mode in zip(NAMES, ["client", "peer"] * 3, strict=True)),
    pytest.param(STRANGER, "client", id="certificate of no role"),
]


@pytest.mark.parametrize(("name", "mode"), SUBJECTS)
def test_each_role_has_exactly_the_rights_of_the_table(name: str | None, mode: str, folders: Path) -> None:
    plain, exposed = free_endpoint(), free_endpoint()
    permissions = get_permissions(name)
    inbox: list[tuple[str, bytes]] = []
    with (
        ZenohServer(plain, exposed=Exposure(exposed, read_holder(folders / "server", server=True))) as server,
        NormalClient(plain) as honest,
        open_hostile_session(f"tcp/{plain}") as beside,
        open_hostile_session(
            f"tcp/{plain}" if name is None else f"tls/{exposed}", mode, name and folders / name
        ) as session,
    ):
        rig = Rig(server)
        honest.subscribe("rig/**", lambda key, payload: inbox.append((key, payload)), lossless=False)
        beside.declare_subscriber("rig/**", lambda sample: inbox.append((str(sample.key_expr), bytes(sample.payload))))
        attempt = Attempt(session)
        # A link keeps its order: after the reply to a request everything before it has been received.
        answers = {key: attempt.answered(key) for key in map(example, KEYS)}
        history = attempt.history()
        # The rig's own configuration is not accessible either: only the session's own replies.
        own = {str(session.info.zid())}
        assert {str(reply.replier_id.zid) for reply in get_all_replies(session, "@/**") if reply.replier_id} <= own
        time.sleep(0.3)
        rig.publish()
        allowed = receivable(permissions)
        until(lambda: allowed <= attempt.received and allowed <= attempt.heartbeats)
        until(lambda: rig.heard >= keys_of(permissions, Action.SEND) and rig.shown >= keys_of(permissions, Action.SHOW))
        # Before any forged message, an honest client receives the rig's own messages or none.
        forged_tokens = {
            key
            for permission in PERMISSIONS
            if permission.action is Action.WATCH
            for key in honest.tokens(example(permission.keys[0]))
        }
        honest_replies = {honest.request(key) for key in keys_of(PERMISSIONS, Action.ASK)}
        selectors = ("rig/command/unknown", "rig/**", "rig/**/@adv/**?_max=1", "rig/sensors/unknown/@adv/**")
        victims = (honest.session, beside)
        replies = [reply for victim in victims for selector in selectors for reply in get_all_replies(victim, selector)]
        for token in attempt.tokens:
            token.undeclare()
        rig.announce()
        until(lambda: all(map(attempt.sees, keys_of(permissions, Action.WATCH))))
        tokens = {key for key in keys_of(PERMISSIONS, Action.WATCH) if attempt.sees(key)}
        until(lambda: len({key for key, _ in inbox}) >= len(receivable(PERMISSIONS)))
        assert {key for key, found in answers.items() if found} == keys_of(permissions, Action.ASK)
        assert attempt.received == allowed
        assert attempt.heartbeats == allowed
        assert history == allowed
        assert rig.heard == keys_of(permissions, Action.SEND)
        assert {key for key in rig.shown if key in map(example, KEYS)} == keys_of(permissions, Action.SHOW)
        assert tokens == keys_of(permissions, Action.WATCH)
        assert forged_tokens == set()
        assert honest_replies == {b"honest"}
        assert FORGED not in {bytes(reply.result.payload) for reply in replies}
        assert {payload for _, payload in inbox} == {b"honest"}, "nothing that a client puts reaches another"


@pytest.mark.parametrize(
    ("who", "why"),
    [
        ("others/operator", "of another authority"),
        ("expired", "expired"),
        ("server", "the rig's own, which is no client's"),
        (None, "none"),
    ],
    ids=["wrong authority", "expired", "the rig's", "no certificate"],
)
def test_a_client_without_a_valid_certificate_is_refused(who: str | None, why: str, folders: Path) -> None:
    plain, exposed = free_endpoint(), free_endpoint()
    holder = read_holder(folders / "server", server=True)
    with ZenohServer(plain, exposed=Exposure(exposed, holder)) as server:
        server.announce()
        for locator in (f"tls/{exposed}", f"tcp/{exposed}"):
            with pytest.raises(zenoh.ZError), open_hostile_session(locator, folder=who and folders / who):
                pytest.fail(f"let in by {locator}, though its certificate is {why}")
        # And an admitted client stays admitted.
        with open_hostile_session(f"tls/{exposed}", folder=folders / "viewer"):
            until(lambda: server.congestion().get("links_viewer") == 1)


def test_a_link_ends_when_its_certificate_expires(folders: Path, tmp_path: Path) -> None:
    plain, exposed = free_endpoint(), free_endpoint()
    signing = ec.generate_private_key(ec.SECP256R1())
    issue = CertificateIssuer(signing, timedelta(days=1))
    authority = issue.certificate(SIGNER, signing, None, [])

    def write(holder: str, by: CertificateIssuer, usage: x509.ObjectIdentifier) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        write_holder(
            tmp_path / holder, authority, by.certificate(holder, key, usage, [build_subject("127.0.0.1")]), key
        )

    write("server", issue, Usage.SERVER_AUTH)
    with ZenohServer(plain, exposed=Exposure(exposed, read_holder(tmp_path, server=True))) as server:
        for valid_s in (3, 30):  # on a busy machine the first connection may take longer than the shorter one
            write("viewer", CertificateIssuer(signing, timedelta(seconds=valid_s)), Usage.CLIENT_AUTH)
            with contextlib.suppress(zenoh.ZError), open_hostile_session(f"tls/{exposed}", folder=tmp_path / "viewer"):
                if server.congestion().get("links_viewer") == 1:
                    until(lambda: "links_viewer" not in server.congestion(), every_s=0.1)
                    return
        pytest.fail("not connected while the certificate was valid")


@pytest.mark.parametrize(("closes", "message"), [(False, "does not answer: it is stopped"), (True, "is not a rig")])
def test_a_server_that_is_no_rig_or_is_stopped_is_named(closes: bool, message: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        if closes:

            def close_all() -> None:
                with contextlib.suppress(OSError):
                    while True:
                        server.accept()[0].close()

            threading.Thread(target=close_all, daemon=True).start()
        endpoint = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(NoReplyError, match=f"^{endpoint} listens, but .*{message}"):
            ZenohClient(endpoint, wait_s=0.2)
        server.shutdown(socket.SHUT_RDWR)


def test_clients_report_the_reason_of_a_refusal(folders: Path) -> None:
    plain, exposed = free_endpoint(), free_endpoint()
    with ZenohServer(plain, exposed=Exposure(exposed, read_holder(folders / "server", server=True))) as server:
        server.answer("rig/command/hammer", lambda _: b"hit")
        server.answer("rig/status", lambda _: b"well")
        server.announce()
        with ZenohClient(exposed, tls=folders / "viewer") as viewer:
            assert viewer.request("rig/status") == b"well"
            assert str(viewer.connection).startswith("TLS as viewer, valid until ")
            assert str(viewer.connection).endswith("; the rig is the rig")
            denied = rf"^the rig at {exposed} denies rig/command/hammer to viewer$"
            with time_limit(PATIENCE_S), pytest.raises(NoReplyError, match=denied):
                viewer.request("rig/command/hammer", timeout_s=2 * PATIENCE_S)  # refused at once
            with pytest.raises(NoReplyError, match=rf"^the rig at {exposed} does not answer rig/parameters$"):
                viewer.request("rig/parameters", timeout_s=0.2)
        for endpoint, tls, message in (
            (exposed, None, "refuses this client without a certificate: an exposed rig needs --tls"),
            (
                exposed,
                folders / "others" / "viewer",
                r"refuses this client as viewer, by the keys in .*: .*\(keys of another rig",
            ),
            (plain, folders / "viewer", "refuses this client as viewer, .*: no TLS is spoken there"),
        ):
            with pytest.raises(NoReplyError, match=rf"^{endpoint} listens, but {message}"):
                ZenohClient(endpoint, wait_s=0.2, tls=tls)
    with pytest.raises(NoReplyError, match=f"^no rig answers at {exposed}"):
        ZenohClient(exposed, wait_s=0.2, tls=folders / "viewer")
    for folder in ("server", "expired", "nowhere"):
        with pytest.raises(InputError, match=r"^--tls must be a"):
            ZenohClient(exposed, tls=folders / folder)


@contextmanager
def serve_commands(endpoint: str, keys: Path) -> Iterator[RequestHandler]:
    """Serve a rig at an exposed address that accepts notes and joins, and replies with the name of the sender."""
    with ZenohServer(free_endpoint(), exposed=Exposure(endpoint, read_holder(keys, server=True))) as server:

        def accept() -> None:
            for pending in handler.take_commands():
                pending.answer({"accepted": True, "id": 1, "tick": 0, "time_s": 0.0, "sender": pending.sender})

        commands = ("note", "join")
        handler = RequestHandler(
            server, commands=commands, unsupported={}, running="it runs", wake=accept, on_warning=print
        )
        handler.open({"rig/status": lambda: {"state": "running"}})
        yield handler


def ask(session: zenoh.Session, command: str, **fields: Any) -> dict[str, Any] | None:
    replies = session.get(f"rig/command/{command}", payload=json.dumps(fields), timeout=PATIENCE_S)
    return next((json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok is not None), None)


def test_a_device_cannot_use_the_name_of_another(tmp_path: Path) -> None:
    keys, exposed = tmp_path / "keys", free_endpoint()
    create_keys(keys, keep_authority=True)
    for name in ("daq1", "guard"):
        add_device(keys, name, "operator")
    with serve_commands(exposed, keys) as handler, open_hostile_session(f"tls/{exposed}", folder=keys / "daq1") as daq1:
        until(lambda: ask(daq1, "note/daq1", text="a") is not None)
        for command in ("note", "note/guard", "note/*", "*/guard", "note/daq", "note/daq10"):
            assert ask(daq1, command, text="a") is None, command
        assert ask(daq1, "note/daq1", text="a", **{"from": "guard"}) == {
            "accepted": True, "id": 1, "tick": 0, "time_s": 0.0, "sender": "daq1",
        }  # fmt: skip
        refused = ask(daq1, "join/daq1", device="guard")
        assert refused is not None
        assert refused["error"] == "join.device must be daq1, the name in the certificate; received 'guard'"
        report = b'{"name": "guard", "received_index": 5}'
        for name in ("guard", "daq1", "daq10", "daq1"):
            daq1.put(f"rig/clients/{name}", report, congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: bool(handler.clients.rows(5, 1.0)))
        assert set(handler.clients.rows(5, 1.0)) == {"daq1"}
        # Our own client needs no settings: the rig names it as its certificate does.
        with ZenohClient(exposed, tls=keys / "guard") as guard:
            assert Console(guard, name="daq1", any_rig=True)._request("note", text="a")["sender"] == "guard"  # noqa: SLF001
            Reporter(guard, "a recorder").send(4, lost=0)
            until(lambda: set(handler.clients.rows(5, 1.0)) == {"daq1", "guard"})
        # A role that several clients share is not bound to a name, and cannot use the keys of a device.
        with open_hostile_session(f"tls/{exposed}", folder=keys / "operator") as shared:
            until(lambda: ask(shared, "note", text="a") is not None)
            assert ask(shared, "note/guard", text="a") is None


def test_a_withdrawn_certificate_is_denied_everything(tmp_path: Path) -> None:
    keys, old, exposed = tmp_path / "keys", tmp_path / "old", free_endpoint()
    create_keys(keys, keep_authority=True)
    add_device(keys, "daq1", "operator")
    add_device(keys, "daq2", "operator")
    authority = (keys / "server" / "authority.pem").read_bytes()
    shutil.copytree(keys / "daq1", old)
    remove_holder(keys, "daq1")
    remove_holder(keys, "operator")
    assert not (keys / "daq1").exists()
    add_device(keys, "daq1", "operator")  # a certificate of the same name does not admit the earlier one
    assert (keys / "daq1" / "authority.pem").read_bytes() == authority, "the others keep their certificates"
    with serve_commands(exposed, keys):
        for name in ("daq1", "daq2"):
            with ZenohClient(exposed, tls=keys / name) as client:
                assert client.request("rig/status") == b'{"state":"running"}'
        with (
            ZenohClient(exposed, tls=old) as client,
            pytest.raises(NoReplyError, match=r"allows nothing to operator@daq1\.[0-9a-f]{8}: its certificate was"),
        ):
            client.request("rig/status", timeout_s=0.5)
        with open_hostile_session(f"tls/{exposed}", folder=old) as session:
            for command in ("note", "note/daq1", "note/daq2"):
                assert ask(session, command, text="a") is None


def test_the_expiry_of_a_certificate_is_named(folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exposed, signing = free_endpoint(), ec.generate_private_key(ec.SECP256R1())
    issue, late = CertificateIssuer(signing, timedelta(days=1)), CertificateIssuer(signing, timedelta(minutes=-1))
    authority, expired = issue.certificate(SIGNER, signing, None, []), datetime.now(UTC) - timedelta(minutes=1)
    for holder, by, usage in (("server", late, Usage.SERVER_AUTH), ("viewer", issue, Usage.CLIENT_AUTH)):
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = by.certificate(holder, key, usage, [build_subject("127.0.0.1")])
        write_holder(tmp_path / holder, authority, certificate, key)
    when = r"expired on \d{4}-\d\d-\d\d \d\d:\d\d UTC"
    # A rig and a client refuse their own; a client names that of the rig.
    for folder, is_server in ((tmp_path, True), (folders / "expired", False)):
        with pytest.raises(InputError, match=rf"^--tls must be a certificate that is valid .*, {when}$"):
            read_holder(folder, server=is_server)
    holder = Holder(tmp_path / "server", "the rig", expired, ("viewer",))
    with (
        ZenohServer(free_endpoint(), exposed=Exposure(exposed, holder)),
        pytest.raises(NoReplyError, match=rf"refuses this client as viewer, .*: the rig's certificate {when}$"),
    ):
        ZenohClient(exposed, wait_s=0.2, tls=tmp_path / "viewer")
    # A certificate that expires later: the rig has closed the link.
    with serve_commands(exposed, folders):
        client = ZenohClient(exposed, tls=folders / "viewer")
        assert client.request("rig/status") == b'{"state":"running"}'
    with client, monkeypatch.context() as patched:
        patched.setattr(client, "_holder", Holder(folders / "viewer", "viewer", expired, ()))
        with pytest.raises(NoReplyError, match=rf"refuses the certificate in .*viewer, {when}$"):
            client.request("rig/status", timeout_s=0.2)


def test_an_exposed_rig_limits_links_and_message_size(folders: Path) -> None:
    plain, exposed = free_endpoint(), free_endpoint()
    sizes: list[int] = []
    with ExitStack() as stack:
        holder = read_holder(folders / "server", server=True)
        server = stack.enter_context(ZenohServer(plain, exposed=Exposure(exposed, holder)))
        server.subscribe_reports("rig/clients/*", lambda _, payload: sizes.append(len(payload)))
        session = stack.enter_context(open_hostile_session(f"tls/{exposed}", folder=folders / "recorder"))
        for size in (100, 500_000, 2 << 20, 101):
            session.put("rig/clients/a", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: bool(sizes) and sizes[-1] == 101)
        assert sizes == [100, 500_000, 101]
        for _ in range(31):
            stack.enter_context(open_hostile_session(f"tls/{exposed}", folder=folders / "viewer"))
        with pytest.raises(zenoh.ZError), open_hostile_session(f"tls/{exposed}", folder=folders / "viewer"):
            pytest.fail("there is a bound")


@pytest.mark.parametrize("busy", ["plain", "exposed"])
def test_without_its_ports_no_rig_opens(busy: str, folders: Path) -> None:
    ends = {"plain": free_endpoint(), "exposed": free_endpoint()}
    exposed = Exposure(ends["exposed"], read_holder(folders / "server", server=True))
    field = {"plain": "listen", "exposed": "expose"}[busy]
    with (
        ZenohServer(ends[busy]),
        pytest.raises(InputError, match=rf"^{field} must be a free address .*'{ends[busy]}'"),
        ZenohServer(ends["plain"], exposed=exposed),
    ):
        pytest.fail("opened without a port")


def test_the_table_has_each_key_once_per_verb_and_distinct_roles() -> None:
    pairs = [(permission.action, key) for permission in PERMISSIONS for key in permission.keys]
    assert len(set(pairs)) == len(pairs)
    assert len({get_permissions(name) for name in (None, STRANGER, *NAMES)}) == len(NAMES) + 2
    assert is_allowed("viewer", Action.RECEIVE, "rig/sensors/probes")
    assert not is_allowed("viewer", Action.RECEIVE, "rig/truth/state")
    assert is_allowed("viewer" + WITH_TRUTH, Action.RECEIVE, "rig/truth/state")
    assert not is_allowed(STRANGER + WITH_TRUTH, Action.RECEIVE, "rig/truth/state")
