"""The page on keys, messages and units, made from the channel table and the codec.

`rig keys` shows it; rig/KEYS.md is its committed copy.
"""

from __future__ import annotations

from typing import Any

from rig import wire
from rig.channels import Channel
from rig.commands import COMMANDS
from rig.faults import described
from rig.kernels import signals
from rig.sampling import SensorChoice
from rig.scenes import rig_table
from rig.transport.access import DOORS, PLAIN, ROLES, TRUTH, Verb

_DOCUMENTS = {
    wire.EVENTS: (
        "published: `event` (start, command, hammer, speed, release, fault, clear, note, warning, end), `tick`, "
        "`time_s`, `wall_s` and the event's own fields; `end` carries `reason` and is the last"
    ),
    wire.STATUS: (
        "published twice a second and on request: state, pace, lateness, overruns, real-time factor, queue, clients, "
        "spin, engine, energy residual (its error estimate), warnings; in real time `utc`: a tick, the UTC at which "
        "it was due by the host's clock, and how well the two are known to each other"
    ),
    wire.CATALOGUE: "on request: the channel table with calibration, truth tables with units",
    wire.PARAMETERS: "on request: every parameter with value, unit, source and kind",
    wire.SCENE: "on request: the scene as it runs, with its seed, and as `taken` the commands sent to it so far "
    "(the newest 500 kB; `forgotten` counts those before); `replayed` where a recording is played in part, or changed",
    f"{wire.CLIENTS}/NAME": "sent by clients twice a second, and with `done` when they leave; shown in the status: "
    "how far they have come, null where nothing came yet; `room`: rows that one can hold, which a replay in a burst "
    "does not exceed. The status shows 64, first those that get on; who gets on no more is not waited for",
}
_OTHER_COMMANDS = {
    "stop": "no fields; ends the run",
    "step": "`ticks`: how far to go; only at `--pace lockstep`, and for a replay that is paused (there also `blocks`)",
    "pause": "no fields; only for a recording that is replayed, as are the next three",
    "resume": "no fields",
    "seek": "`time_s`: where to go on, in the recording's simulated time",
    "rate": "`rate` from 0.01 to 1000: recorded seconds a second",
    "note": "`text` and `tags` (a list of words); does nothing, but is published as an event, and so recorded",
}

_VERBS = {
    Verb.ASK: "send a request and get the reply",
    Verb.RECEIVE: "subscribe, and fetch from the rig's cache what was missed",
    Verb.SEND: "put",
    Verb.WATCH: "see the token appear and vanish",
    Verb.SHOW: "show a token of one's own",
}


def page() -> str:
    """The page as Markdown."""
    parts = (_blocks, _truth, _documents, _slow_subscribers, _access, _ports)
    return "\n".join(line for part in parts for line in part())


def _blocks() -> list[str]:
    table = rig_table()
    lines = [
        "# Keys, messages and units",
        "",
        "Made from the channel table by `rig keys --markdown > rig/KEYS.md`; do not edit by hand.",
        "",
        "Everything travels over zenoh on 127.0.0.1 (port 7460 by default), and with `--expose HOST --tls DIR` by TLS "
        "(port 7463 by default); no router, no multicast. "
        "Simulated time is an integer tick of 1 us.",
        "",
        "## Blocks",
        "",
        f"A block is one CDR message (little-endian). `{wire.SAMPLE_SCHEMA}` carries ADC counts, "
        f"`{wire.TRUTH_SCHEMA}` values of the model:",
        "",
        "```",
        *wire.SCHEMAS[wire.SAMPLE_SCHEMA].splitlines(),
        "```",
        "",
        f"In `{wire.TRUTH_SCHEMA}` the last field is `float64[] values`. "
        "A step of `index` other than the rows of the block before is a gap.",
        "volts = counts x 2 adc_v / 2^adc_bits; value = (volts - bias) / sensitivity. "
        "One dimension lies behind the other: row after row.",
        "",
    ]
    for group in table.groups.values():
        lines += [
            f"### `{wire.sensor_key(group.name)}`: {group.title}",
            "",
            f"{group.rate_hz} Hz by default. Values: {group.channels[0].kind}.",
            "",
            "| column | channel | unit | V per unit | bias, V | range, V | low-pass, Hz | high-pass, Hz | noise, V rms "
            "| converter | what |",
            "|---|---|---|---|---|---|---|---|---|---|---|",
            *(_channel_row(column, channel) for column, channel in enumerate(group.channels)),
            "",
        ]
    return lines


def _truth() -> list[str]:
    truth_hz = SensorChoice().truth_rate_hz
    lines = [
        f"### `{wire.EDGES}`: exact keyphasor edges",
        "",
        f"`{wire.TRUTH_SCHEMA}` of one column: ticks from the block's `tick`, with their fraction. "
        "`index` counts edges; no block where there was none.",
        "",
        "## Truth",
        "",
        "What no instrument could know, on keys of its own: for method developers, never for a DAQ.",
        "",
    ]
    lines += [
        f"### `{wire.FAULTS}`",
        "",
        "JSON, before the blocks that it is about: `fault` and `clear` as among the events, and `blocks`, of each "
        "stretch of a stream that a fault of blocks meets `key`, `row` (true number of its first row), `rows`, "
        "`faults`, and `sent`: nothing where it is not sent, else of each time `index` and `tick` that it is sent "
        "with, `due` (tick) and `doors`.",
        "",
    ]
    known = {signal.name: signal for signal in signals.ROW}
    for name, columns in signals.TRUTH.items():
        lines += [
            f"### `{wire.truth_key(name)}`",
            "",
            f"{truth_hz} Hz by default.",
            "",
            "| column | name | unit | what |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {n} | `{column}` | {known[column].unit} | {known[column].label} |" for n, column in enumerate(columns)
        ]
        lines.append("")
    return lines


def _documents() -> list[str]:
    lines = [
        "## Documents (JSON)",
        "",
        "| key | what |",
        "|---|---|",
        *(f"| `{key}` | {what} |" for key, what in _DOCUMENTS.items()),
        "",
    ]
    lines += [
        "## Commands",
        "",
        "Requests are JSON objects on their key; "
        'the reply is `{"accepted": true, "id", "command", "tick", "time_s"}` with the simulated time at which the '
        'command takes effect, or `{"accepted": false, "error"}` with the limit in the text, '
        "where one field is wrong also in `field` and `must`. `from` may name the sender. "
        "Requests, and what clients report, are UTF-8 of at most 10 000 bytes, with the fields named here and no "
        "others, each once, numbers as finite numbers; a command that is not in this table is refused as well.",
        "",
        "| key | fields |",
        "|---|---|",
    ]
    for name, command in COMMANDS.items():
        fields = "; ".join(_field(key, field) for key, field in command.model_fields.items() if key != "command")
        fields = fields.replace("`what`", "`kind` and its numbers, below")
        lines.append(f"| `{wire.command_key(name)}` | {fields or 'no fields'} |")
    lines += [f"| `{wire.command_key(name)}` | {what} |" for name, what in _OTHER_COMMANDS.items()]
    lines += [
        "",
        "A fault begins at the first row at or behind its tick; the reply adds its number `fault`, its `channels` and "
        "`first_row` by group, as do the events `fault` and `clear`. Once it has ended, what comes is as if it had "
        "never been. One of blocks asks for a group. x is what the sensor feels [the channel's unit], v the "
        "conditioner's output [V], c the "
        "converter's counts, t the time since it began [s], u(n) and g(n) uniform and normal numbers by row, sample, "
        "slot or turn, of the scene's seed.",
        "",
        "| kind | stage | what it does | numbers | on | at |",
        "|---|---|---|---|---|---|",
        *(f"| `{name}` | {' | '.join(rest)} |" for name, *rest in described(rig_table())),
        "",
        f"A liveliness token stands at `{wire.ALIVE}` while the rig runs.",
        "",
    ]
    return lines


def _slow_subscribers() -> list[str]:
    return [
        "## What a slow subscriber misses",
        "",
        "The rig does not wait for subscribers: what finds a link full is dropped for that link, so a plain zenoh "
        "subscriber that is slow, or is stopped, loses messages, and nothing tells it but a step of `index` and of the "
        "number of the message (`source_info.source_sn`, from 0 for each key, without a gap). `rig record`, "
        "`drivers.daq` and `rig.transport.zenoh.ZenohClient.subscribe` fetch what is missing by themselves; "
        "zenoh's AdvancedSubscriber does so too.",
        "",
        "Anybody else asks the rig's cache, which holds the last 3000 messages of each key, 30 s at blocks of 10 ms:",
        "",
        "```python",
        "# ?_max=1 for the latest; without a ? all",
        f'selector = "{wire.sensor_key("probes")}/@adv/**?_sn=1200..1299"',
        "replies = session.get(",
        "    selector,",
        "    consolidation=zenoh.ConsolidationMode.NONE,  # else one reply a key",
        "    # They come on the key of the messages, not on that of the query.",
        "    accept_replies=zenoh.ReplyKeyExpr.ANY,",
        ")",
        "samples = [reply.ok for reply in replies if reply.ok]",
        "blocks = {one.source_info.source_sn: one.payload.to_bytes() for one in samples}",
        "```",
        "",
        "A number that is not among the replies is no longer kept. Ask for at most 200 messages at a time: while the "
        "cache answers, the publisher of that key waits. Take messages only where `source_info.source_id.zid` is the "
        "session that `session.info.peers_zid()` names, as a session of another client can publish on these keys too.",
        "",
    ]


def _access() -> list[str]:
    return [
        "## Who may do what",
        "",
        "What is not in this table is denied to everybody: no client can put a block, an event or a status, answer a "
        "request, delete anything or show the rig's token. "
        "On the loopback nobody is asked who he is, so there is one column for all, "
        f"`{PLAIN}`; it also holds for `--expose HOST --plaintext`. "
        "With `--expose HOST --tls DIR` the role is the name in the client's certificate (`rig keys init`), and "
        "nobody is let in without one. `truth`: with a grant of its own (`rig keys init --truth ROLE`).",
        "",
        f"| what | keys | verb | {PLAIN} | {' | '.join(ROLES)} |",
        "|---|---|---|---|" + "---|" * len(ROLES),
        *(
            f"| {door.what} | {', '.join(f'`{key}`' for key in door.keys)} | {door.verb} | yes | "
            + " | ".join("yes" if door in doors else "truth" if door is TRUTH else "-" for doors in ROLES.values())
            + " |"
            for door in DOORS
        ),
        "",
        *(f"- {verb}: {what}" for verb, what in _VERBS.items()),
        "",
        "Denied requests get an empty reply, and denied subscriptions nothing: our own clients ask for the rig's token "
        "to tell that from a rig that is not there. Instruments and CAN buses are served on the loopback alone "
        "(from elsewhere: `ssh -L 7462:127.0.0.1:7462 HOST`).",
        "",
    ]


def _ports() -> list[str]:
    return [
        "## Other ports",
        "",
        "`rig twins` listens on 127.0.0.1:7462: requests to an instrument are queries, its data is published, under "
        "`rig/instruments/NAME/`. A CAN bus (`rig run --can zenoh:CHANNEL`, `rig can hub`) listens on 127.0.0.1:7461; "
        "its frames travel under `rig/can/CHANNEL/`. Both are for their drivers and python-can's interface `zenoh`: "
        "what they carry is described in drivers/instrument/protocol.py and drivers/can/bus/codec.py, the CAN "
        "frames in drivers/can/rig.dbc.",
        "",
        "On a bus a name belongs to whoever has joined under it for as long as it is there: `join` hands out a secret, "
        "and offers, `set`, `flush` and another `join` are taken with it only; what is tried without is counted and "
        "warned of. On the loopback that is no authentication: zenoh does not vouch for who sends, the secret travels "
        "in clear, every program of the machine may join, send what has a higher priority, and take up all "
        "places for other processes (never those of the rig and its own clients). None of these ports, nor "
        "`--can-socketcand`, listens on other hosts than 127.0.0.1, whatever is asked, as none knows a password; from "
        "another machine they are reached by `ssh -L PORT:127.0.0.1:PORT USER@HOST`.",
        "",
    ]


def _channel_row(column: int, channel: Channel) -> str:
    low, high = channel.range_v
    cells = (
        column,
        f"`{channel.name}`",
        channel.unit,
        f"{channel.sensitivity_v:g}",
        f"{channel.bias_v:g}",
        f"{low:g} to {high:g}",
        f"{channel.bandwidth_hz:g}",
        f"{channel.highpass_hz:g}",
        f"{channel.noise_v:g}",
        f"{channel.adc_bits} bit, +-{channel.adc_v:g} V",
        channel.label,
    )
    return f"| {' | '.join(map(str, cells))} |"


def _field(key: str, field: Any) -> str:
    limits = {
        kind: value
        for item in field.metadata
        for kind in ("ge", "le")
        if (value := getattr(item, kind, None)) is not None
    }
    text = f"`{key}`"
    if limits:
        text += " " + " ".join(f"{'from' if kind == 'ge' else 'to'} {value:g}" for kind, value in limits.items())
    if key == "direction":
        text += " x, y, -x, -y, or degrees from x toward y"
    if not field.is_required():
        text += f" (default {field.default})"
    return text
