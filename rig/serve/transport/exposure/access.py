"""Permissions of clients: the single table from which zenoh's rules and their documentation are generated.

Everything not listed is denied: a client may not publish blocks, events or status, answer requests or delete anything.
A rule applies to one direction: a key that may be received may not be published.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, NamedTuple

from rig.base import wire


class Verb(StrEnum):
    """Action of a client on a key."""

    ASK = "ask"
    RECEIVE = "receive"
    SEND = "send"
    WATCH = "watch"
    SHOW = "show"


class Door(NamedTuple):
    """Keys and the action allowed on them."""

    what: str
    verb: Verb
    keys: tuple[str, ...]


DOCUMENTS = Door("documents and status", Verb.ASK, (wire.CATALOGUE, wire.PARAMETERS, wire.SCENE, wire.STATUS))
STREAMS = Door(
    "samples, events, status, ends of blocks",
    Verb.RECEIVE,
    (f"{wire.SENSORS}/**", wire.EVENTS, wire.STATUS, wire.BLOCK),
)
PRESENCE = Door("the rig's token", Verb.WATCH, (wire.ALIVE,))
REPORTS = Door("reports of clients", Verb.SEND, (f"{wire.CLIENTS}/*",))
COMMANDS = Door("commands, notes", Verb.ASK, (f"{wire.COMMAND}/*",))
TRUTH = Door("truth", Verb.RECEIVE, (f"{wire.TRUTH}/**",))
INSTRUMENTS = (
    Door("instruments' replies", Verb.ASK, (f"{wire.ROOT}/instruments/*/request",)),
    Door("instruments' data", Verb.RECEIVE, (f"{wire.ROOT}/instruments/*/data",)),
)
CAN = (
    Door("requests to a CAN hub", Verb.ASK, (f"{wire.ROOT}/can/*/*",)),
    Door("frames on a CAN bus", Verb.RECEIVE, (f"{wire.ROOT}/can/*/bus",)),
    Door("frames for a CAN bus", Verb.SEND, (f"{wire.ROOT}/can/*/offer/*",)),
    Door("the CAN hub's token", Verb.WATCH, (f"{wire.ROOT}/can/*/alive",)),
    Door("tokens of CAN nodes", Verb.SHOW, (f"{wire.ROOT}/can/*/node/*",)),
)
DOORS = (DOCUMENTS, STREAMS, PRESENCE, REPORTS, COMMANDS, TRUTH, *INSTRUMENTS, *CAN)

PLAIN = "plain"
"""Connections without TLS, which cannot be distinguished."""
_VIEWER = (DOCUMENTS, STREAMS, PRESENCE)
ROLES: Mapping[str, tuple[Door, ...]] = {
    "operator": (*_VIEWER, REPORTS, COMMANDS),
    "recorder": (*_VIEWER, REPORTS),
    "viewer": _VIEWER,
}
"""Permissions by the role in a certificate."""
WITH_TRUTH = "+truth"
"""Suffix of a role in a certificate's name that grants access to the truth."""

_MESSAGES: Mapping[Verb, Mapping[str, list[str]]] = {
    Verb.ASK: {"ingress": ["query"], "egress": ["declare_queryable", "reply"]},
    Verb.RECEIVE: {"egress": ["put", "declare_queryable", "reply"]},
    Verb.SEND: {"ingress": ["put"], "egress": ["declare_subscriber"]},
    Verb.WATCH: {"ingress": ["liveliness_query", "declare_liveliness_subscriber"], "egress": ["liveliness_token"]},
    Verb.SHOW: {"ingress": ["liveliness_token"], "egress": ["declare_liveliness_subscriber"]},
}
"""Zenoh messages that each action needs, incoming and outgoing."""
_ANYTHING, _CACHES = f"{wire.ROOT}/**", f"{wire.ROOT}/**/@adv/**"
_TO_RECEIVE = {"subscribe": (["declare_subscriber"], [_ANYTHING, _CACHES]), "fetch": (["query"], [_CACHES])}
"""A client that may receive at all may subscribe to anything; each outgoing message is checked."""


def doors_of(name: str | None) -> tuple[Door, ...]:
    """Return the permissions by the common name of a certificate; None is a connection without TLS."""
    if name is None:
        return DOORS
    role = name.removesuffix(WITH_TRUTH)
    return (*ROLES.get(role, ()), *((TRUTH,) if role in ROLES and role != name else ()))


def allows(name: str | None, verb: Verb, key: str) -> bool:
    """Return whether an action on a key is allowed; arguments as of `doors_of`."""
    import zenoh

    return any(
        zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))
        for door in doors_of(name)
        if door.verb is verb
        for pattern in door.keys
    )


def rules() -> dict[str, Any]:
    """Return the table as zenoh's `access_control` for the rig's session; ingress is data from clients."""
    rules = {
        f"{flow} {door.what}": (flow, messages, _with_cache(door))
        for door in DOORS
        for flow, messages in _MESSAGES[door.verb].items()
    }
    rules |= {name: ("ingress", *rule) for name, rule in _TO_RECEIVE.items()}
    names = [None, *(name for role in ROLES for name in (role, role + WITH_TRUTH))]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
            for name, (flow, messages, keys) in rules.items()
        ],
        "subjects": [
            {"id": name, "link_protocols": ["tls"], "cert_common_names": [name]}
            if name
            else {"id": PLAIN, "link_protocols": ["tcp"]}
            for name in names
        ],
        "policies": [
            {
                "subjects": [name or PLAIN],
                "rules": [
                    *_TO_RECEIVE,
                    *(f"{flow} {door.what}" for door in doors_of(name) for flow in _MESSAGES[door.verb]),
                ],
            }
            for name in names
        ],
    }


def _with_cache(door: Door) -> list[str]:
    # `**` does not match chunks that begin with `@`, as in the keys of caches and their heartbeats.
    caches = [f"{key}/@adv/**" for key in door.keys] if door.verb is Verb.RECEIVE else []
    return [*door.keys, *caches]
