"""Eight daemons and their clients on one Zenoh router, and as ROS 2 sees them."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

from support.cell import LEFT, RIGHT, until
from support.many_cells import ROS2_DOMAIN
from support.paths import RECORDINGS, ROOT
from support.ros2_nodes import header, port, typed
from support.wam import JOINT_NAMES
from thirdhand.client import (
    Client,
    Publisher,
    Tracker,
    UnreachableError,
    cells,
    endpoints,
    open_session,
)
from thirdhand.command_line import main
from thirdhand.contract import cdr, channels, requests
from thirdhand.contract.messages import PoseStamped

NAMES = tuple(f"lab/bench{i}" for i in range(1, 9))


class Lab(NamedTuple):
    """A router's endpoint, a client session of it, and the process of eight daemons."""

    endpoint: str
    session: zenoh.Session
    daemons: subprocess.Popen[str]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with open_session(listen=["tcp/127.0.0.1:0"], more={"mode": "router"}) as router:
        (endpoint,) = endpoints(router)
        command = [
            sys.executable,
            str(ROOT / "tests" / "support" / "many_cells.py"),
            str(tmp_path_factory.mktemp("lab")),
            endpoint,
        ]
        process = subprocess.Popen(
            [*command, *NAMES], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert {process.stdout.readline().strip() for _ in NAMES} == set(NAMES)
            with open_session(connect=[endpoint]) as session:
                yield Lab(endpoint, session, process)
        finally:
            process.kill()
            process.communicate()


def test_play_succeeds_only_where_the_daemon_counts_the_hands(
    lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    play = [
        "play",
        str(RECORDINGS / "demonstration-6.mcap"),
        "--speed",
        "50",
        "--connect",
        lab.endpoint,
    ]
    assert main([*play, "--cell", NAMES[1]]) == 0
    assert "of the left hand, " in (output := capsys.readouterr().err)
    assert "the daemon's loop received" in output
    client = Client(lab.session, NAMES[1])
    status = client.status()
    assert status.received["hands/left"] > 3
    assert set(status.hand_age_ms) == {"left", "right"}
    assert status.rejected.get("not_finite", 0) == 0
    stuck = requests.encode_json(status)
    with pytest.raises(UnreachableError, match="nobody listens to nowhere/hands/left"):
        Tracker(lab.session, "nowhere", timeout_s=0.1)
    with (
        _answering(lab, "stuck/status", stuck),
        lab.session.liveliness().declare_token(channels.presence("stuck", str(lab.session.zid()))),
        lab.session.declare_subscriber("stuck/hands/*", lambda sample: None),
    ):
        assert main([*play, "--cell", "stuck"]) == 1
    assert "the daemon received 0 of " in capsys.readouterr().err


@contextlib.contextmanager
def _answering(lab: Lab, key: str, answer: bytes) -> Iterator[None]:
    """A queryable that answers on a key as a Zenoh storage does, while the context lasts."""
    queryable = lab.session.declare_queryable(
        key, lambda query: query.reply(key, answer), complete=True
    )
    yield
    queryable.undeclare()


# --- ROS 2 ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ros(lab: Lab) -> Iterator[dict[str, Any]]:
    """Host and port at which a ROS 2 node finds the domain."""
    yield port(lab.endpoint, ROS2_DOMAIN)
    ZenohSession.get_instance().close()


def test_ros2_moves_the_hands_and_hears_the_commands(lab: Lab, ros: dict[str, Any]) -> None:
    cell = NAMES[4]
    modes = list[Any]()
    commands = list[Any]()
    statuses = list[Any]()
    topics = {f"/{cell}/joints/command": ("sensor_msgs/msg/JointState", commands.append)}
    topics |= {f"/{cell}/status": ("std_msgs/msg/String", statuses.append)}
    listening = [
        ROS2Subscriber(topic, callback=take, **typed(kind), **ros)
        for topic, (kind, take) in topics.items()
    ]
    pose = typed("geometry_msgs/msg/PoseStamped")
    hands = [ROS2Publisher(f"/{cell}/hands/{side}", **pose, **ros) for side in ("left", "right")]
    store = hands[0].session_mgr.store.types
    place, point, turn = (
        store[f"geometry_msgs/msg/{name}"] for name in ("Pose", "Point", "Quaternion")
    )

    def follows() -> bool:
        base_header = header(store, "base")
        for hand, (x, y, z) in zip(hands, (LEFT, RIGHT), strict=True):
            hand.publish(
                header=base_header,
                pose=place(
                    position=point(x=x, y=y, z=z), orientation=turn(x=0.0, y=0.0, z=0.0, w=1.0)
                ),
            )
        modes[:] = [json.loads(status.data)["mode"] for status in statuses]
        return "follow" in modes

    until(follows)
    for node in (*listening, *hands):
        node.close()
    assert tuple(commands[-1].name) == JOINT_NAMES
    assert len(commands[-1].position) == len(commands[-1].velocity) == 7
    final_status = Client(lab.session, cell).status()
    assert final_status.received.keys() == {"hands/left", "hands/right", "objects"}
    assert final_status.rejected.keys() <= {"repeated", "older", "ahead"}


def test_a_daemon_that_ends_is_gone_from_every_list(
    lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    """This must be the file's last test: all daemons end."""
    lab.daemons.kill()
    lab.daemons.wait()
    until(lambda: not cells(lab.session))
    assert main(["status", "--all", "--connect", lab.endpoint]) == 1
    assert "no daemon is alive on this network" in capsys.readouterr().err
    with pytest.raises(UnreachableError, match="nobody answers on"):
        Client(lab.session, NAMES[0], timeout_s=1.0).status()


# --- sessions ------------------------------------------------------------------------------------


SAYS_ALL = """{
  // what a user may say, and what the service does not let it
  mode: "client",
  listen: { endpoints: ["tcp/0.0.0.0:0"] },
  connect: { endpoints: ["tcp/127.0.0.1:1"] },
  scouting: { multicast: { enabled: true }, gossip: { enabled: true } },
  transport: { link: { tx: { lease: 1234 }, tls: { root_ca_certificate: "/nowhere" } } },
  namespace: "elsewhere",
}"""


def test_what_is_safe_goes_before_a_zenoh_configuration(lab: Lab, tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(SAYS_ALL)
    with open_session(connect=[lab.endpoint], zenoh_config=file) as session:
        assert list(session.info.routers_zid())
        assert endpoints(session) == ()
        publisher = Publisher(session, "cell", "hands/left")
        came = []
        with lab.session.declare_subscriber(
            "cell/hands/left", lambda sample: came.append(str(sample.key_expr))
        ):
            until(
                lambda: (
                    publisher.put(cdr.encode_pose(PoseStamped(1, "", LEFT, (0.0, 0.0, 0.0, 1.0))))
                    or came
                )
            )
    assert set(came) == {"cell/hands/left"}  # not on other keys
    with pytest.raises(
        UnreachableError, match=r"nobody answers at tcp/127\.0\.0\.1:1: is a daemon, `thirdhand rec"
    ):
        open_session(otherwise=[lab.endpoint], zenoh_config=file, timeout_s=0.3)
    with open_session(
        listen=["tcp/127.0.0.1:0"], zenoh_config=file, more={"mode": "peer"}
    ) as listening:
        assert endpoints(listening)[0].startswith("tcp/127.0.0.1:")
        assert not list(listening.info.routers_zid())
