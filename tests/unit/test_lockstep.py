"""Devices under test in lockstep: effect of each command, and no device blocks a rig for ever."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from drivers.can.devices import DeviceKind, NoteKind, device_frame, note_frame, sender_frame
from drivers.can.gateway.commands import Commands
from drivers.can.signals import CommandKind, command_frame, default_messages
from drivers.console import AcceptedStep, Console
from rig.base import wire
from rig.base.errors import RefusedError
from rig.cli.commands.run import status_parts
from rig.serve import service
from rig.serve.health import Guard
from rig.serve.pacing import FreeRun, Lockstep
from rig.serve.transport.memory import MemoryClient
from tests.unit.service_fake import FakeSimulation
from tests.unit.test_service import BLOCK, Running
from tests.waiting import PATIENCE_S, until


@contextmanager
def running(duration_s: float | None = None) -> Iterator[Running]:
    with Running(FakeSimulation(duration_s=duration_s), Lockstep()) as rig:
        yield rig


class Steps:
    """Steps that a tester requests on a separate thread."""

    def __init__(self, rig: Running, *ticks: int) -> None:
        self.replies: list[AcceptedStep] = []
        self._thread = threading.Thread(target=lambda: self.replies.extend(rig.console.step(each) for each in ticks))
        self._thread.start()

    def join(self) -> list[AcceptedStep]:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        return self.replies


class Device(Console):
    """A device that handles each block as instructed."""

    def __init__(self, rig: Running, name: str) -> None:
        super().__init__(MemoryClient(rig.server), name=name)
        self.ends: list[dict[str, Any]] = []
        self._client.subscribe(wire.BLOCK, lambda _, payload: self.ends.append(wire.decode_document(payload)))

    def wait(self, blocks: int) -> int:
        until(lambda: len(self.ends) >= blocks)
        return self.ends[-1]["tick"]


def events_of(rig: Running) -> list[tuple[int, str, str]]:
    return [(event["tick"], event["device"], event["state"]) for event in rig.listener.named("device")]


def test_a_block_waits_for_all_devices_and_their_commands_are_exact() -> None:
    with running() as rig:
        one, two = Device(rig, "one"), Device(rig, "two")
        assert (one.join().tick, two.join().tick) == (0, 0)
        steps = Steps(rig, 2 * BLOCK)
        assert one.wait(1) == BLOCK
        assert one.hammer().tick == BLOCK
        one.done(BLOCK)
        one.done(BLOCK)  # the second report changes nothing
        assert rig.service.status()["tick"] == BLOCK
        assert two.speed(3.0).tick == BLOCK
        two.done(BLOCK)
        assert one.wait(2) == 2 * BLOCK
        assert steps.replies == []
        two.done(2 * BLOCK)
        one.done(2 * BLOCK)
        (reply,) = steps.join()
        assert (reply.tick, reply.lost) == (2 * BLOCK, {})
        assert [row["tick"] for row in rig.console.status()["devices"]] == [2 * BLOCK, 2 * BLOCK]
        one.leave()
        two.leave()
        assert rig.console.step(BLOCK).tick == 3 * BLOCK
        ends = one.ends
    assert [(end["block"], end["tick"], end["time_s"]) for end in ends] == [(1, BLOCK, 0.01), (2, 2 * BLOCK, 0.02)]
    assert ends[1]["messages"].items() >= {wire.sensor_key("probes"): 1, wire.truth_key("state"): 1}.items()
    order = rig.listener.order
    assert order[order.index(wire.BLOCK) - 1] == wire.truth_key("energy"), "after all of the block"
    assert events_of(rig) == [
        (0, "one", "joined"), (0, "two", "joined"), (2 * BLOCK, "one", "left"), (2 * BLOCK, "two", "left"),
    ]  # fmt: skip
    assert rig.summary["commands"] == 8, "what is done once a block is not counted"


def test_a_device_that_hangs_is_removed_and_the_rig_continues() -> None:
    with running() as rig:
        well, ill = Device(rig, "well"), Device(rig, "ill")
        well.join()
        ill.join(patience_s=0.05)
        steps = Steps(rig, 2 * BLOCK)
        well.done(well.wait(1))
        well.done(well.wait(2))
        (reply,) = steps.join()
        reason = f"it did not finish the block that ends at tick {BLOCK} within 0.05 s"
        assert reply.lost == {"ill": reason}
        assert {row["name"]: (row["state"], row["reason"]) for row in rig.console.status()["devices"]} == {
            "well": ("joined", None),
            "ill": ("lost", reason),
        }
        with pytest.raises(RefusedError, match=rf"one that has joined \(it was removed: {reason}\)"):
            ill.done(BLOCK)
        assert ill.join().tick == 2 * BLOCK, "it may come again"
        ill.leave()
        steps = Steps(rig, BLOCK)
        well.done(well.wait(3))
        assert steps.join()[0].lost == {}, "the second report has no effect"
    (lost,) = [event for event in rig.listener.named("device") if event["state"] == "lost"]
    assert (lost["tick"], lost["reason"]) == (BLOCK, reason)


@pytest.mark.parametrize("secret", [{}, {"secret": "invented"}])
@pytest.mark.parametrize(
    ("command", "fields"), [("done", {"tick": 7}), ("done", {"tick": BLOCK}), ("done", {"block": 5}), ("leave", {})]
)
def test_a_message_of_another_client_neither_ends_a_block_nor_removes_the_device(
    command: str, fields: dict[str, Any], secret: dict[str, str]
) -> None:
    with running() as rig:
        device = Device(rig, "guard")
        device.join()
        steps = Steps(rig, BLOCK)
        device.wait(1)
        forged = {"from": "guard", "device": "guard", **fields, **secret}
        reply = rig.listener.client.request(wire.command_key(command), wire.encode_document(forged))
        received = "another one" if secret else "none"
        must = f"{command}.secret must be that with which guard has joined; received {received}"
        assert wire.decode_document(reply)["error"] == must
        (row,) = rig.console.status()["devices"]
        assert (row["state"], row["tick"], row["reason"]) == ("joined", 0, None)
        device.done(BLOCK)
        assert steps.join()[0].lost == {}
        device.leave()
    assert "secret" not in str(rig.listener.events) + str(rig.listener.statuses)


def test_a_device_without_a_secret_takes_part_as_before() -> None:
    with running() as rig:
        request = rig.listener.client.request
        for command, fields in (("join", {}), ("done", {"tick": 0}), ("leave", {})):
            reply = request(wire.command_key(command), wire.encode_document({"device": "old", **fields}))
            assert wire.decode_document(reply)["accepted"]


def test_the_patience_of_all_devices_together_is_limited() -> None:
    with running() as rig:
        console = rig.console
        console.join("debugged", patience_s=3500.0)
        with pytest.raises(RefusedError, match=r"patience_s must be at most 100 s, what the joined devices leave of"):
            console.join("b", patience_s=101.0)
        console.join("b", patience_s=100.0)
        console.leave("debugged")
        console.join("c", patience_s=3500.0)


def test_a_rig_that_waits_names_the_device_in_status_event_and_output(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "_WAIT_WARNING_S", 0.01)
    with running() as rig:
        device = Device(rig, "guard")
        device.join(patience_s=3600.0)
        steps = Steps(rig, BLOCK)
        device.wait(1)
        until(lambda: any("waits" in event["text"] for event in rig.listener.named("warning")))
        until(lambda: "the rig waits for guard (0 s)" in rig.console.status()["warnings"])
        assert "the rig waits for guard (0 s)" in status_parts(rig.service.status())
        device.done(BLOCK)
        steps.join()
        assert not any(
            "waits" in text for text in [*rig.console.status()["warnings"], *status_parts(rig.service.status())]
        )


def test_a_command_for_another_rig_is_refused() -> None:
    with running() as rig:
        fields = wire.encode_document({"rig": "the one before", "speed_hz": 1.0})
        reply = wire.decode_document(rig.listener.client.request(wire.command_key("speed"), fields))
        assert reply["error"] == "speed was sent to another rig, which ran here before: connect again"
        assert rig.console.status()["commands"] == 0


@pytest.mark.parametrize("end_tick", [BLOCK - 1, 2 * BLOCK, 2**62])
def test_a_device_that_reports_a_future_block_is_removed(end_tick: int) -> None:
    with running() as rig:
        device = Device(rig, "a")
        device.join()
        steps = Steps(rig, BLOCK)
        device.wait(1)
        with pytest.raises(
            RefusedError,
            match=rf"done must be with tick {BLOCK}, the end of the last block \(1\); received tick {end_tick}",
        ):
            device.done(end_tick)
        (reply,) = steps.join()
        reason = f"it reported the end of tick {end_tick}; the current block ends at tick {BLOCK}"
        assert reply.lost == {"a": reason}
        assert rig.console.step(BLOCK).lost == {}


def test_a_device_that_leaves_within_a_step_does_not_block_others() -> None:
    with running() as rig:
        device = Device(rig, "a")
        device.join()
        steps = Steps(rig, 3 * BLOCK)
        device.wait(1)
        device.leave()
        assert [(each.tick, each.lost) for each in steps.join()] == [(3 * BLOCK, {})]
        assert len(device.ends) == 1, "no report without devices"


def test_the_last_step_is_answered_when_all_devices_are_done() -> None:
    with running(duration_s=0.02) as rig:
        device = Device(rig, "a")
        device.join()
        steps = Steps(rig, 2 * BLOCK)
        device.done(device.wait(1))
        device.wait(2)
        assert steps.replies == []
        assert device.note("the last").tick == 2 * BLOCK
        device.done(2 * BLOCK)
        assert steps.join()[0].tick == 2 * BLOCK
        rig.join()
        assert rig.summary["reason"] == "completed"


def test_a_stop_does_not_wait_for_devices() -> None:
    with running() as rig:
        device = Device(rig, "a")
        device.join(patience_s=3600.0)
        caught: list[BaseException] = []

        def step() -> None:
            try:
                rig.console.step(BLOCK)
            except RefusedError as error:
                caught.append(error)

        thread = threading.Thread(target=step)
        thread.start()
        device.wait(1)
        device.stop()
        thread.join(PATIENCE_S)
        rig.join()
        assert rig.summary["reason"] == "stopped"
        assert "a run that ended: stopped" in str(caught[0])


@pytest.mark.parametrize(
    ("command", "fields", "says"),
    [
        ("join", {"device": "a"}, "join.device must be a name under which no other device has joined; received"),
        ("join", {"device": "b", "patience_s": 0}, "join.patience_s must be greater than 0"),
        ("join", {"device": "b\n"}, "join.device must be a line of 1 to 100 printable characters"),
        ("join", {"device": "  "}, "join.device must be a line of 1 to 100 printable characters, not all blank"),
        ("join", {}, "join.device must be given"),
        ("done", {"device": "b", "tick": 0}, "done.device must be one that has joined; received 'b'"),
        ("done", {"device": "a", "tick": -1}, "done.tick must be greater than or equal to 0"),
        ("done", {"device": "a", "tick": 1.0}, "done.tick must be a valid integer"),
        ("done", {"device": "a"}, "done must be given by either a tick or a block"),
        ("done", {"device": "a", "tick": 0, "block": 0}, "done must be given by either a tick or a block"),
        ("leave", {"device": "b"}, "leave.device must be one that has joined"),
    ],
)
def test_malformed_or_unknown_reports_are_refused_without_effect(
    command: str, fields: dict[str, Any], says: str
) -> None:
    with running() as rig:
        Device(rig, "a").join()
        reply = rig.listener.client.request(wire.command_key(command), wire.encode_document(fields))
        assert says in wire.decode_document(reply)["error"]
        assert [row["state"] for row in rig.console.status()["devices"]] == ["joined"]


def test_devices_are_waited_for_only_in_lockstep() -> None:
    with (
        Running(FakeSimulation(duration_s=None), FreeRun()) as rig,
        pytest.raises(RefusedError, match="join must be sent to a rig that runs with --pace lockstep; received"),
    ):
        rig.console.join()


def test_lost_devices_are_removed_first_when_there_are_too_many() -> None:
    with running() as rig:
        console = rig.console
        for n in range(64):
            console.join(f"device {n}")
        with pytest.raises(RefusedError, match="one of at most 64 devices"):
            console.join("one more")
        with pytest.raises(RefusedError, match="the end of the last block"):
            console.done(7, "device 5")
        console.join("one more")
        names = [row["name"] for row in rig.console.status()["devices"]]
        assert (len(names), names[-1]) == (64, "one more")
        assert "device 5" not in names


def test_commands_of_two_devices_at_one_tick_are_ordered_by_name() -> None:
    with running() as rig:
        first, second = Device(rig, "a"), Device(rig, "b")
        first.join()
        second.join(patience_s=0.3)
        steps = Steps(rig, BLOCK)
        second.wait(1)
        numbers: list[int] = []

        def command() -> None:
            numbers.extend((second.speed(2.0).id, second.note("two").id))
            second.done(BLOCK)

        thread = threading.Thread(target=command)
        thread.start()
        time.sleep(0.4)  # a device that waits for others is not late
        assert first.speed(1.0).id == 4
        assert rig.console.note("of nobody that has joined").id == 5
        assert numbers == []
        first.done(BLOCK)
        thread.join(PATIENCE_S)
        assert numbers == [6, 7]
        assert steps.join()[0].lost == {}
    assert [event["request"] for event in rig.listener.named("command")[-2:]] == [{"speed_hz": 1.0}, {"speed_hz": 2.0}]


@contextmanager
def commands_of(rig: Running) -> Iterator[Commands]:
    commands = Commands(
        MemoryClient(rig.server), lambda **_: None, lambda node: None, timeout_s=1.0, guard=Guard("commands")
    )
    thread = threading.Thread(target=commands.send_all, daemon=True)
    thread.start()
    try:
        yield commands
    finally:
        commands.close()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_notes_and_commands_of_devices_on_a_bus_are_ordered_by_name_and_never_hold_up_a_done() -> None:
    message = default_messages().by_name["Device"]
    speed = [command_frame(CommandKind.SPEED, counter, speed_hz=float(counter)) for counter in (1, 2, 3)]
    with running() as rig, commands_of(rig) as commands:
        for node in (3, 7):
            commands.take(*device_frame(message, DeviceKind.JOIN, node))
        until(lambda: len(rig.console.status()["devices"]) == 2)
        steps = Steps(rig, BLOCK)
        until(lambda: rig.console.status()["tick"] == BLOCK)
        commands.take(*note_frame(message, NoteKind.DANGER, 7, channel="disk_x", value=512.0))
        commands.take(*sender_frame(message, 7, speed[0][1]))
        commands.take(*speed[0])
        commands.take(*device_frame(message, DeviceKind.DONE, 7, block=1))
        commands.take(*sender_frame(message, 3, command_frame(CommandKind.SPEED, 2, speed_hz=9.0)[1]))
        commands.take(*speed[1])  # another command than the announced one: of nobody, and not held up
        until(lambda: commands.accepted == 1)
        assert [row.started for row in commands.waiting] == [True, False, False], "one after another"
        time.sleep(1.1)  # longer than a command may wait for its reply
        commands.time_out()
        assert not rig.listener.named("note")
        commands.take(*sender_frame(message, 3, speed[2][1]))
        commands.take(*speed[2])
        commands.take(*note_frame(message, NoteKind.TRIP, 3))
        commands.take(*device_frame(message, DeviceKind.DONE, 3, block=1))
        assert steps.join()[0].lost == {}
        assert not commands.refused
    notes = [(each["from"], each["text"], each["tags"], each["tick"]) for each in rig.listener.named("note")]
    assert notes == [("CAN 3", "trip", ["trip"], BLOCK), ("CAN 7", "danger disk_x 512", ["danger"], BLOCK)]
    sent = [(each["from"], each["request"]["speed_hz"]) for each in rig.listener.named("command")
            if each["command"] == "speed"]  # fmt: skip
    assert sent == [("CAN", 2.0), ("CAN 3", 3.0), ("CAN 7", 1.0)]


def test_a_stop_that_a_device_has_announced_follows_its_notes() -> None:
    message = default_messages().by_name["Device"]
    stop = command_frame(CommandKind.STOP, 1)
    with running() as rig, commands_of(rig) as commands:
        for node in (3, 7):
            commands.take(*device_frame(message, DeviceKind.JOIN, node))
        until(lambda: len(rig.console.status()["devices"]) == 2)

        def trip() -> None:
            until(lambda: rig.console.status()["tick"] == BLOCK)
            for kind in (NoteKind.DANGER, NoteKind.TRIP):
                commands.take(*note_frame(message, kind, 7))
            commands.take(*sender_frame(message, 7, stop[1]))
            commands.take(*stop)
            until(lambda: [row.started for row in commands.waiting] == [True, False, False])
            commands.take(*device_frame(message, DeviceKind.DONE, 3, block=1))

        thread = threading.Thread(target=trip)
        thread.start()
        with pytest.raises(RefusedError, match="a run that ended: stopped"):
            rig.console.step(BLOCK)
        thread.join(PATIENCE_S)
    events = [(each["event"], each.get("text") or each["command"]) for each in rig.listener.events
              if each.get("from") == "CAN 7" and each["event"] != "device"]  # fmt: skip
    assert events == [("note", "danger"), ("note", "trip"), ("command", "stop")]


def test_an_invalid_note_on_a_bus_is_counted_and_has_no_effect() -> None:
    message = default_messages().by_name["Device"]
    with running() as rig, commands_of(rig) as commands:
        identifier, data = note_frame(message, NoteKind.DANGER, 7, channel="disk_x")
        for wrong in (data[:7] + b"\0", data[:7], data[:2] + b"\xff" + data[3:]):
            commands.take(identifier, wrong)
        assert dict(commands.refused) == {"bad_checksum": 2, "bad_length": 1}
        commands.take(identifier, data)
        until(lambda: len(rig.listener.named("note")) == 1)
    assert [each["from"] for each in rig.listener.named("note")] == ["CAN 7"]


def test_a_stop_refuses_waiting_requests() -> None:
    with running() as rig:
        first, second = Device(rig, "a"), Device(rig, "b")
        first.join()
        second.join()
        caught: list[str] = []

        def refused(ask: Callable[[], object]) -> threading.Thread:
            def ask_it() -> None:
                try:
                    ask()
                except RefusedError as error:
                    caught.append(str(error))

            thread = threading.Thread(target=ask_it)
            thread.start()
            return thread

        step = refused(lambda: rig.console.step(BLOCK))
        second.wait(1)
        speed = refused(lambda: second.speed(2.0))
        time.sleep(0.1)  # it comes, and waits
        rig.console.stop()
        step.join(PATIENCE_S)
        speed.join(PATIENCE_S)
    assert len(caught) == 2
    assert all("a run that ended: stopped" in each for each in caught)


def test_in_lockstep_no_command_is_refused_by_the_clock_on_the_wall() -> None:
    with running() as rig:
        assert [rig.console.note("again").id for _ in range(1000)] == list(range(1, 1001))
