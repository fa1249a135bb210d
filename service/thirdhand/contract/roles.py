"""Access control on a network: the common name of a certificate is a role. A daemon that has a
certificate allows each role what is listed here, and nothing else.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

from thirdhand.contract import channels, ros2

DAEMON = "daemon"
ROUTER = "router"
HEADSET = "headset"
HANDS = ("hands/left", "hands/right")
WISHES = ("clutch", "gripper/wish")
ARM = ("joints/state", "joints/guided", "gripper/state")
TOOL = ("tool/pose",)
OBJECTS = ("objects",)
TOPICS = (*ros2.HEARD, *ros2.SAID)
# certificates of a role; access control compares whole names, so all are listed
MOST_OF_A_ROLE = 99


class Role(NamedTuple):
    """Rights of the holder of a certificate in a cell."""

    about: str
    publishes: tuple[str, ...] = ()
    hears: bool = False  # receives everything that the daemon publishes
    # sends any request; all roles may request the status of every cell, and list daemons
    asks: bool = False
    hears_inputs: bool = False  # receives what trackers and the arm publish


ROLES = {
    "tracker": Role(
        "may publish hands, clutch, gripper, objects, and the tool in demonstrations",
        (*HANDS, *WISHES, *TOOL, *OBJECTS),
    ),
    HEADSET: Role(
        "may publish hands, clutch and gripper, send requests, receive all outputs, and serve a "
        "page to browsers",
        (*HANDS, *WISHES),
        hears=True,
        asks=True,
    ),
    "arm": Role(
        "may publish joint states and the tool, and receive all outputs", (*ARM, *TOOL), hears=True
    ),
    "bench": Role(
        "may do what tracker and arm may, like the simulated bench",
        (*HANDS, *WISHES, *ARM, *TOOL, *OBJECTS),
        hears=True,
    ),
    "operator": Role("may send requests, and receive all outputs", hears=True, asks=True),
    "observer": Role("may receive all outputs", hears=True),
    "recorder": Role(
        "may receive what trackers and the arm publish, for demonstrations", hears_inputs=True
    ),
    ROUTER: Role(
        "may forward everything, and must enforce the roles itself",
        (*HANDS, *WISHES, *ARM, *TOOL, *OBJECTS),
        hears=True,
        asks=True,
        hears_inputs=True,
    ),
}


def names(role: str) -> tuple[str, ...]:
    """The accepted names of a role's certificates: `tracker`, `tracker-2` to `tracker-99`."""
    return (role, *(f"{role}-{number}" for number in range(2, MOST_OF_A_ROLE + 1)))


def access_control(
    cell: str,
    revoked: Collection[str] = (),
    ros2_domain: int | None = None,
    more_topics: Collection[ros2.Topic] = (),
) -> dict[str, Any]:
    """Zenoh's settings with which a daemon of this cell enforces the roles, and rejects
    certificates with `revoked` names. The rights of a role hold in a ROS 2 domain too, for the
    cell's own topics and `more_topics`.
    """

    def keys(suffixes: tuple[str, ...], *, topics: bool = False) -> list[str]:
        expressions = [channels.key(cell, suffix) for suffix in suffixes]
        if topics and ros2_domain is not None:
            candidates = (channels.BY_KEY[suffix] for suffix in suffixes)
            also = (ros2.of_channel(cell, channel) for channel in candidates if channel in TOPICS)
            expressions += [ros2.key(ros2_domain, topic) for topic in also]
            expressions += [
                ros2.key(ros2_domain, topic) for topic in more_topics if topic.channel in suffixes
            ]
        return expressions

    heard = keys(
        tuple(channel.key for channel in channels.CHANNELS if channel.direction == "out"),
        topics=True,
    )
    asked = keys(tuple(channel.key for channel in channels.CHANNELS if channel.queryable))
    rules: list[dict[str, Any]] = []

    def allow(name: str, flow: str, messages: list[str], key_exprs: list[str]) -> str:
        rule = {"id": f"{name} {flow}", "permission": "allow", "flows": [flow]}
        rules.append(rule | {"messages": messages, "key_exprs": key_exprs})
        return str(rule["id"])

    def both(name: str, ingress: list[str], egress: list[str], key_exprs: list[str]) -> list[str]:
        return [
            allow(name, "ingress", ingress, key_exprs),
            allow(name, "egress", egress, key_exprs),
        ]

    viewer_topics = {
        ros2.key(ros2_domain or 0, topic): topic
        for topic in more_topics
        if topic.channel.startswith("/")
    }
    latched = [
        key_expr
        for key, topic in viewer_topics.items()
        if topic.latched
        for key_expr in (key, ros2.kept(key))
    ]
    hear = both("hear", ["declare_subscriber"], ["put"], [*heard, *viewer_topics])
    record = both(
        "record", ["declare_subscriber"], ["put"], keys((*HANDS, *ARM, *TOOL), topics=True)
    )
    ask = both("ask", ["query"], ["declare_queryable", "reply"], asked)

    # All roles see the daemons of all cells, which may be connected to this one.
    status = [channels.key("**", "status")]
    present = [channels.PRESENCE_OF_ALL]
    tokens = ["liveliness_token"]
    queries = ["liveliness_query", "declare_liveliness_subscriber"]
    if latched:
        asking = [*queries, "query", "declare_subscriber"]
        hear += both(
            "hear what is latched", asking, [*tokens, "declare_queryable", "reply", "put"], latched
        )
    see = both("see", ["query"], ["declare_queryable", "reply"], status)
    see += both("see who lives", queries, tokens, present)
    alive = [*tokens, *queries]
    answers = ["query", "reply", "declare_queryable"]
    if ros2_domain is not None:
        see += both("see topics", alive, alive, [ros2.all_tokens(ros2_domain)])
    # daemons notice each other, and pass on to each other who asks for a status
    neighbours = both("neighbours", alive, alive, present) + both(
        "neighbours' status", answers, answers, status
    )

    allowed = {}
    for name, role in ROLES.items():
        allowed[name] = see + role.hears * hear + role.hears_inputs * record + role.asks * ask
        allowed[name] += (name == ROUTER) * neighbours
        if role.publishes:
            published = keys(role.publishes, topics=True)
            allowed[name] += both(f"{name} publish", ["put"], ["declare_subscriber"], published)
    allowed[DAEMON] = neighbours
    valid = {role: [name for name in names(role) if name not in revoked] for role in allowed}
    granted = [role for role in allowed if valid[role]]  # an empty list would mean everybody
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": [{"id": role, "cert_common_names": valid[role]} for role in granted],
            "policies": [{"subjects": [role], "rules": allowed[role]} for role in granted],
        }
    }
