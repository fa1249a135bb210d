"""Who may do what on a network: each certificate's common name tells a role, and a daemon with a
certificate of its own lets each role do what stands here and nothing else.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from service.contract import channels

DAEMON = "daemon"
HANDS = ("hands/left", "hands/right")
ARM = ("joints/state",)
THINGS = ("objects",)
MOST_OF_A_ROLE = 99  # certificates: access control compares whole names, so all that may be are listed


class Role(NamedTuple):
    """What the holder of a certificate may do in a cell."""

    about: str
    publishes: tuple[str, ...] = ()
    hears: bool = False  # all that the daemon publishes
    asks: bool = False  # any request


ROLES = {
    "tracker": Role("may publish hands and things", (*HANDS, *THINGS)),
    "arm": Role("may publish joint states, and hears commands", ARM, hears=True),
    "bench": Role("is tracker and arm in one, as the simulated bench is", (*HANDS, *ARM, *THINGS), hears=True),
    "operator": Role("may send requests, and hears all", hears=True, asks=True),
    "observer": Role("hears all", hears=True),
}


def names(role: str) -> tuple[str, ...]:
    """The names that certificates of a role may have: `tracker`, `tracker-2` to `tracker-99`."""
    return (role, *(f"{role}-{number}" for number in range(2, MOST_OF_A_ROLE + 1)))


def access_control(cell: str, revoked: Collection[str] = ()) -> dict[str, Any]:
    """Zenoh's settings by which a daemon of this cell keeps the roles apart, and lets certificates
    of the `revoked` names do nothing.
    """

    def keys(suffixes: tuple[str, ...]) -> list[str]:
        return [channels.key(cell, suffix) for suffix in suffixes]

    heard = keys(tuple(channel.key for channel in channels.CHANNELS if channel.direction == "out"))
    asked = keys(tuple(channel.key for channel in channels.CHANNELS if channel.queryable))
    rules: list[dict[str, Any]] = []

    def allow(name: str, flow: str, messages: list[str], key_exprs: list[str]) -> str:
        rule = {"id": f"{name} {flow}", "permission": "allow", "flows": [flow]}
        rules.append(rule | {"messages": messages, "key_exprs": key_exprs})
        return str(rule["id"])

    hear = [allow("hear", "ingress", ["declare_subscriber"], heard), allow("hear", "egress", ["put"], heard)]
    ask = [
        allow("ask", "ingress", ["query"], asked),
        allow("ask", "egress", ["declare_queryable", "reply"], asked),
    ]

    def policies() -> Iterator[tuple[str, list[str]]]:
        for name, role in ROLES.items():
            publish: list[str] = []
            if role.publishes:
                published = keys(role.publishes)
                publish.append(allow(f"{name} publish", "ingress", ["put"], published))
                publish.append(allow(f"{name} publish", "egress", ["declare_subscriber"], published))
            yield name, publish + role.hears * hear + role.asks * ask
        # two daemons see that they are two
        liveliness = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
        present, status = [channels.key(cell, "daemon/*")], keys(("status",))
        yield (
            DAEMON,
            [allow("neighbours", flow, liveliness, present) for flow in ("ingress", "egress")]
            + [
                allow("neighbours' status", flow, ["query", "reply", "declare_queryable"], status)
                for flow in ("ingress", "egress")
            ],
        )

    granted = [
        (role, valid, rules_of)
        for role, rules_of in policies()
        if (valid := [name for name in names(role) if name not in revoked])  # no name at all would mean everybody
    ]
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": role, "cert_common_names": valid} for role, valid, _ in granted],
            "policies": [{"subjects": [role], "rules": rules_of} for role, _, rules_of in granted],
        }
    }
