"""Access control on a network: the common name of a certificate is a role. A daemon that has a
certificate allows each role what is listed here, and nothing else.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

from thirdhand.contract import channels, ros2

DAEMON = "daemon"
ROUTER = "router"
HEADSET = "headset"
HANDS = ("hands/left", "hands/right")
WISHES = ("clutch", "gripper/wish")
POLICY_WISHES = ("tool/wish", "gripper/wish")
ARM = ("joints/state", "joints/guided", "gripper/state")
TOOL = ("tool/pose",)
OBJECTS = ("objects",)
TOPICS = (*ros2.HEARD, *ros2.SAID)
# certificates of a role; access control compares whole names, so all are listed
MOST_OF_A_ROLE = 99
STATUS_OF_ALL = [channels.key("**", "status")]
# messages with which a session notices others
LIVELINESS_TOKENS = ["liveliness_token"]
LIVELINESS_QUERIES = ["liveliness_query", "declare_liveliness_subscriber"]
LIVELINESS = [*LIVELINESS_TOKENS, *LIVELINESS_QUERIES]


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
    "policy": Role(
        "may publish wishes for the tool and the gripper, and receive everything that is published",
        POLICY_WISHES,
        hears=True,
        hears_inputs=True,
    ),
    HEADSET: Role(
        "may publish hands, clutch and wishes, send requests, receive all outputs, and serve a "
        "page to browsers",
        (*HANDS, *WISHES, *POLICY_WISHES[:1]),
        hears=True,
        asks=True,
    ),
    "arm": Role(
        "may publish joint states and the tool, and receive all outputs", (*ARM, *TOOL), hears=True
    ),
    "bench": Role(
        "may do what tracker and arm may, like the simulated bench",
        (*HANDS, *WISHES, *POLICY_WISHES[:1], *ARM, *TOOL, *OBJECTS),
        hears=True,
    ),
    "operator": Role("may send requests, and receive all outputs", hears=True, asks=True),
    "observer": Role("may receive all outputs", hears=True),
    "recorder": Role(
        "may receive what trackers and the arm publish, for demonstrations", hears_inputs=True
    ),
    ROUTER: Role(
        "may forward everything, and must enforce the roles itself",
        (*HANDS, *WISHES, *POLICY_WISHES[:1], *ARM, *TOOL, *OBJECTS),
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
    rules = _Rules(cell, ros2_domain, more_topics)
    allowed = rules.by_role()
    valid = {role: [name for name in names(role) if name not in revoked] for role in allowed}
    granted = [role for role in allowed if valid[role]]  # an empty list would mean everybody
    return {
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules.rules,
            "subjects": [{"id": role, "cert_common_names": valid[role]} for role in granted],
            "policies": [{"subjects": [role], "rules": allowed[role]} for role in granted],
        }
    }


class _Rules:
    """Rules of Zenoh's access control for one cell. Each right is a list of their names."""

    def __init__(
        self, cell: str, ros2_domain: int | None, more_topics: Collection[ros2.Topic]
    ) -> None:
        self.rules: list[dict[str, Any]] = []
        self._cell = cell
        self._ros2_domain = ros2_domain
        self._more_topics = more_topics

    def by_role(self) -> dict[str, list[str]]:
        """The names of the rules that each role has."""
        hear = self._hear()
        record = self._both(
            "record", ["declare_subscriber"], ["put"], self._streams((*HANDS, *ARM, *TOOL))
        )
        requests = [channel.key for channel in channels.CHANNELS if channel.queryable]
        ask = self._both("ask", ["query"], ["declare_queryable", "reply"], self._keys(requests))
        hear += self._hear_latched()
        see = self._see()
        neighbours = self._neighbours()

        allowed = {}
        for name, role in ROLES.items():
            allowed[name] = see + role.hears * hear + role.hears_inputs * record + role.asks * ask
            allowed[name] += (name == ROUTER) * neighbours
            if role.publishes:
                published = self._streams(role.publishes)
                allowed[name] += self._both(
                    f"{name} publish", ["put"], ["declare_subscriber"], published
                )
        allowed[DAEMON] = neighbours
        return allowed

    def _both(
        self, name: str, ingress: list[str], egress: list[str], key_exprs: list[str]
    ) -> list[str]:
        """The names of two new rules: these messages are allowed to come in and to go out."""
        for flow, messages in (("ingress", ingress), ("egress", egress)):
            rule = {"id": f"{name} {flow}", "permission": "allow", "flows": [flow]}
            self.rules.append(rule | {"messages": messages, "key_exprs": key_exprs})
        return [f"{name} ingress", f"{name} egress"]

    def _keys(self, suffixes: Iterable[str]) -> list[str]:
        return [channels.key(self._cell, suffix) for suffix in suffixes]

    def _streams(self, suffixes: tuple[str, ...]) -> list[str]:
        """The keys of streams, in the cell and in the ROS 2 domain."""
        keys = self._keys(suffixes)
        if self._ros2_domain is None:
            return keys
        candidates = (channels.BY_KEY[suffix] for suffix in suffixes)
        topics = [
            *(ros2.of_channel(self._cell, channel) for channel in candidates if channel in TOPICS),
            *(topic for topic in self._more_topics if topic.channel in suffixes),
        ]
        return keys + [ros2.key(self._ros2_domain, topic) for topic in topics]

    def _viewer_topics(self) -> dict[str, ros2.Topic]:
        """The topics for viewers in the ROS 2 domain, by key."""
        return {
            ros2.key(self._ros2_domain or 0, topic): topic
            for topic in self._more_topics
            if topic.channel.startswith("/")
        }

    def _hear(self) -> list[str]:
        """The right to receive all outputs."""
        outputs = tuple(channel.key for channel in channels.CHANNELS if channel.direction == "out")
        heard = [*self._streams(outputs), *self._viewer_topics()]
        return self._both("hear", ["declare_subscriber"], ["put"], heard)

    def _hear_latched(self) -> list[str]:
        """The right to receive topics for viewers that were published earlier."""
        keys = [key for key, topic in self._viewer_topics().items() if topic.latched]
        latched = [key_expr for key in keys for key_expr in (key, ros2.kept(key))]
        if not latched:
            return []
        asking = [*LIVELINESS_QUERIES, "query", "declare_subscriber"]
        answers = [*LIVELINESS_TOKENS, "declare_queryable", "reply", "put"]
        return self._both("hear what is latched", asking, answers, latched)

    def _see(self) -> list[str]:
        """The right to see the daemons of all cells, which may be connected to this one."""
        see = self._both("see", ["query"], ["declare_queryable", "reply"], STATUS_OF_ALL)
        see += self._both(
            "see who lives", LIVELINESS_QUERIES, LIVELINESS_TOKENS, [channels.PRESENCE_OF_ALL]
        )
        if self._ros2_domain is not None:
            tokens = [ros2.all_tokens(self._ros2_domain)]
            see += self._both("see topics", LIVELINESS, LIVELINESS, tokens)
        return see

    def _neighbours(self) -> list[str]:
        """The right to notice other daemons, and to pass on requests of their status."""
        answers = ["query", "reply", "declare_queryable"]
        return [
            *self._both("neighbours", LIVELINESS, LIVELINESS, [channels.PRESENCE_OF_ALL]),
            *self._both("neighbours' status", answers, answers, STATUS_OF_ALL),
        ]
