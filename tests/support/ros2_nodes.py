"""ROS 2 nodes beside a cell, and sessions with certificates that may receive its topics."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore

from support.certificates import make_certificates
from thirdhand.client import endpoints, open_session
from thirdhand.contract import ros2
from thirdhand.contract.roles import access_control
from thirdhand.daemon.single_instance import NETWORK_BOUNDS

TYPES = get_typestore(Stores.ROS2_JAZZY)


def typed(kind: str) -> dict[str, str]:
    """The arguments of a node for a type of messages."""
    text, _ = TYPES.generate_msgdef(kind, ros_version=2)
    return {
        "msg_type": kind,
        "msg_definition": text,
        "type_hash": f"RIHS01_{ros2.TYPE_HASHES[kind]}",
    }


def port(router: str, domain: int) -> dict[str, Any]:
    """The arguments by which a node finds its domain, for a router's endpoint."""
    return {
        "domain_id": domain,
        "router_ip": "127.0.0.1",
        "router_port": int(router.rpartition(":")[2]),
    }


def header(types: dict[str, Any], frame: str = "") -> Any:
    """A header with the present time, of a node's types."""
    second_ns = 10**9
    stamp = types["builtin_interfaces/msg/Time"](*divmod(time.time_ns(), second_ns))
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


@contextlib.contextmanager
def guarded(
    folder: Path, cell: str, domain: int, topics: Sequence[ros2.Topic], *roles: str
) -> Iterator[tuple[zenoh.Session, ...]]:
    """The session of a daemon with certificates, and a client's session for each role."""
    secrets = make_certificates(folder)
    more = {**NETWORK_BOUNDS, **access_control(cell, (), domain, topics)}
    with contextlib.ExitStack() as closing:
        listening = open_session(
            listen=["tls/127.0.0.1:0"], certificate=secrets / "daemon", more=more
        )
        daemon = closing.enter_context(listening)
        clients = [
            open_session(connect=endpoints(daemon), certificate=secrets / role) for role in roles
        ]
        yield daemon, *map(closing.enter_context, clients)
