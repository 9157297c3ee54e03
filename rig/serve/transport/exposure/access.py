"""Permissions of clients: the single table from which zenoh's rules and their documentation are generated.

Everything not listed is denied: a client may not publish blocks, events or status, answer requests or delete anything.
A rule applies to one direction: a key that may be received may not be published.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from rig.base import wire


class Action(StrEnum):
    """Action of a client on a key."""

    ASK = "ask"
    RECEIVE = "receive"
    SEND = "send"
    WATCH = "watch"
    SHOW = "show"


class Permission(NamedTuple):
    """Keys and the action allowed on them."""

    title: str
    action: Action
    keys: tuple[str, ...]


DOCUMENTS = Permission("documents and status", Action.ASK, (wire.CATALOGUE, wire.PARAMETERS, wire.SCENE, wire.STATUS))
STREAMS = Permission(
    "samples, events, status, ends of blocks",
    Action.RECEIVE,
    (f"{wire.SENSORS}/**", wire.EVENTS, wire.STATUS, wire.BLOCK),
)
PRESENCE = Permission("the rig's token", Action.WATCH, (wire.ALIVE,))
REPORTS = Permission("reports of clients", Action.SEND, (f"{wire.CLIENTS}/*",))
COMMANDS = Permission("commands, notes", Action.ASK, (f"{wire.COMMAND}/*",))
TRUTH = Permission("truth", Action.RECEIVE, (f"{wire.TRUTH}/**",))
INSTRUMENTS = (
    Permission("instruments' replies", Action.ASK, (f"{wire.ROOT}/instruments/*/request",)),
    Permission("instruments' data", Action.RECEIVE, (f"{wire.ROOT}/instruments/*/data",)),
)
CAN = (
    Permission("requests to a CAN hub", Action.ASK, (f"{wire.ROOT}/can/*/*",)),
    Permission("frames on a CAN bus", Action.RECEIVE, (f"{wire.ROOT}/can/*/bus",)),
    Permission("frames for a CAN bus", Action.SEND, (f"{wire.ROOT}/can/*/offer/*",)),
    Permission("the CAN hub's token", Action.WATCH, (f"{wire.ROOT}/can/*/alive",)),
    Permission("tokens of CAN nodes", Action.SHOW, (f"{wire.ROOT}/can/*/node/*",)),
)
PERMISSIONS = (DOCUMENTS, STREAMS, PRESENCE, REPORTS, COMMANDS, TRUTH, *INSTRUMENTS, *CAN)

PLAIN = "plain"
"""Role of all connections without TLS, which have no identity."""
_VIEWER = (DOCUMENTS, STREAMS, PRESENCE)
ROLES: Mapping[str, tuple[Permission, ...]] = {
    "operator": (*_VIEWER, REPORTS, COMMANDS),
    "recorder": (*_VIEWER, REPORTS),
    "viewer": _VIEWER,
}
"""Permissions by the role in a certificate."""
WITH_TRUTH = "+truth"
"""Suffix of a role in a certificate's name that grants access to the truth."""
ROLE_NAMES = tuple(name for role in ROLES for name in (role, role + WITH_TRUTH))
"""Common names of the certificates that any number of clients may share."""
DEVICE_NAME = r"[A-Za-z0-9]([A-Za-z0-9-]{0,30}[A-Za-z0-9])?"
"""Regular expression of a device's name; it is one part of a key."""

_MESSAGES: Mapping[Action, Mapping[str, list[str]]] = {
    Action.ASK: {"ingress": ["query"], "egress": ["declare_queryable", "reply"]},
    Action.RECEIVE: {"egress": ["put", "declare_queryable", "reply"]},
    Action.SEND: {"ingress": ["put"], "egress": ["declare_subscriber"]},
    Action.WATCH: {"ingress": ["liveliness_query", "declare_liveliness_subscriber"], "egress": ["liveliness_token"]},
    Action.SHOW: {"ingress": ["liveliness_token"], "egress": ["declare_liveliness_subscriber"]},
}
"""Zenoh messages that each action needs, incoming and outgoing."""
_ALL_KEYS, _CACHES = f"{wire.ROOT}/**", f"{wire.ROOT}/**/@adv/**"
_SUBSCRIBER_RULES = {"subscribe": (["declare_subscriber"], [_ALL_KEYS, _CACHES]), "fetch": (["query"], [_CACHES])}
"""A client that may receive at all may subscribe to anything; each outgoing message is checked."""
_DECLARED = "declared for devices"


def get_permissions(name: str | None) -> tuple[Permission, ...]:
    """Return the permissions by the common name of a certificate; None is a connection without TLS."""
    if name is None:
        return PERMISSIONS
    granted = name.partition("@")[0]
    role = granted.removesuffix(WITH_TRUTH)
    permissions = (*ROLES.get(role, ()), *((TRUTH,) if role in ROLES and role != granted else ()))
    if (device := get_device(name)) is None:
        return permissions
    bound = {REPORTS: f"{wire.CLIENTS}/{device}", COMMANDS: f"{wire.COMMAND}/*/{device}"}
    return tuple(
        Permission(f"{each.title} of {device}", each.action, (bound[each],)) if each in bound else each
        for each in permissions
    )


def get_device(name: str | None) -> str | None:
    """Return the device in the common name of a certificate, `ROLE@DEVICE.NUMBER`; None if it names no device."""
    return (name or "").partition("@")[2].rpartition(".")[0] or None


def bind_key(name: str | None, key: str) -> str:
    """Return the key under which the holder of a certificate sends a command or a report."""
    if (device := get_device(name)) is not None and key.startswith(f"{wire.CLIENTS}/"):
        return f"{wire.CLIENTS}/{device}"
    return f"{key}/{device}" if device is not None and key.startswith(f"{wire.COMMAND}/") else key


def is_allowed(name: str | None, action: Action, key: str) -> bool:
    """Return whether an action on a key is allowed; arguments as of `get_permissions`."""
    import zenoh

    return any(
        zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))
        for permission in get_permissions(name)
        if permission.action is action
        for pattern in permission.keys
    )


def rules(allowed: Sequence[str]) -> dict[str, Any]:
    """Return the table as zenoh's `access_control` for the rig's session; ingress is data from clients.

    Args:
        allowed: Common names of the certificates that have permissions.
    """
    names = [None, *allowed]
    rules = {
        f"{flow} {permission.title}": (flow, messages, _add_cache_keys(permission))
        for permission in dict.fromkeys(each for name in names for each in get_permissions(name))
        for flow, messages in _MESSAGES[permission.action].items()
    }
    rules |= {name: ("ingress", *rule) for name, rule in _SUBSCRIBER_RULES.items()}
    # A device sends what the rig has declared to receive: for all devices, not for each one.
    declared = [wire.command_key("*/*"), *REPORTS.keys]
    rules[_DECLARED] = ("egress", ["declare_queryable", "declare_subscriber"], declared)
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
                    *_SUBSCRIBER_RULES,
                    *([_DECLARED] if get_device(name) else []),
                    *(
                        f"{flow} {permission.title}"
                        for permission in get_permissions(name)
                        for flow in _MESSAGES[permission.action]
                    ),
                ],
            }
            for name in names
        ],
    }


def _add_cache_keys(permission: Permission) -> list[str]:
    # `**` does not match chunks that begin with `@`, as in the keys of caches and their heartbeats.
    caches = [f"{key}/@adv/**" for key in permission.keys] if permission.action is Action.RECEIVE else []
    return [*permission.keys, *caches]
