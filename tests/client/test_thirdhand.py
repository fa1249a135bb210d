"""`import thirdhand` gives the classes of `thirdhand.client`, whatever extras are installed; and
the calls of a connection.
"""

from __future__ import annotations

import ast
import asyncio
import itertools
import math
import re
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from support.cell import serving, until
from support.cell_commands import python, started
from support.installed import isolated, unpacked, wheel_of
from support.paths import ROOT
from thirdhand.client import (
    Connection,
    Follower,
    SceneObject,
    Tracker,
    UnreachableError,
    ViaPoint,
    Watch,
    connect,
    endpoints,
    open_session,
)
from thirdhand.client.hands import HANDS_ATTRIBUTES, Hands
from thirdhand.client.streams import MAX_STAMP_NS, UNTURNED, Publisher, wait_until_heard
from thirdhand.contract import cdr, channels
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.messages import JointState, PoseStamped
from thirdhand.process.foreign_modules import EXTRAS

DEPENDENCIES = ("zenoh", "msgspec")
SAME = """
import sys, thirdhand
from thirdhand import client
assert len(client.__all__) > 25
assert all(getattr(thirdhand, name) is getattr(client, name) for name in client.__all__)
print(thirdhand.__file__, sorted({name.split(".")[0] for name in sys.modules} - sys.stdlib_module_names))
"""


@pytest.mark.parametrize("editable", [False, True])
def test_the_bare_distribution_is_the_client(editable: bool, tmp_path: Path) -> None:
    site = unpacked(wheel_of(ROOT, tmp_path, editable=editable), tmp_path / "site")
    done = isolated(site, SAME, *DEPENDENCIES)
    assert done.returncode == 0, done.stderr
    imported, _, modules = done.stdout.partition(" ")
    assert imported == str((ROOT / "service" if editable else site) / "thirdhand" / "__init__.py")
    assert set(ast.literal_eval(modules)) == {"__main__", "thirdhand", *DEPENDENCIES}
    metadata = (next(site.glob("*.dist-info")) / "METADATA").read_text(encoding="utf-8")
    needs = [
        line
        for line in metadata.splitlines()
        if line.startswith("Requires-Dist: ") and ";" not in line
    ]
    assert [line.split()[1].partition(">")[0] for line in needs] == ["eclipse-zenoh", "msgspec"]


BESIDE_A_CELL = [
    "serve",
    "follow simulated",
    "status",
    "doctor",
    "via-points list",
    "correct",
    "metrics",
    "bundle",
    "bench",
    "report a.mcap",
    "replay a.mcap",
    "view a.mcap",
]


@pytest.mark.parametrize(
    ("command", "extra"),
    [("serve", "cell"), ("learn take.mcap --output skill.npz", "cell"), ("sim", "sim")],
)
def test_a_command_whose_extra_is_missing_says_what_to_install(
    command: str, extra: str, tmp_path: Path
) -> None:
    site = unpacked(wheel_of(ROOT, tmp_path), tmp_path / "site")
    code = (
        f"import sys\nsys.argv[1:] = {command.split()}\nfrom thirdhand.__main__ import "
        "main\nsys.exit(main())"
    )
    done = isolated(site, code, *DEPENDENCIES)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert f"installed: pip install 'thirdhand[{extra}]'" in done.stderr


def test_extras_in_messages_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert EXTRAS.keys() <= project["optional-dependencies"].keys()


def test_a_control_machine_has_all_that_its_commands_import() -> None:
    """The extras that docs/operate.md installs are enough for the commands beside a cell."""
    (installed,) = re.findall(
        r"'\.\[([\w,]+)\]'", (ROOT / "docs" / "operate.md").read_text(encoding="utf-8")
    )
    present = {*installed.split(","), "lerobot"}  # Rerun brings pyarrow
    lacking = [modules for extra, modules in EXTRAS.items() if extra not in present]
    missing = [module for modules in lacking for module in modules]
    code = (
        "import importlib, sys\n"
        f"sys.modules |= dict.fromkeys({missing})\n"
        "from thirdhand.command_line import parser\n"
        f"for words in {BESIDE_A_CELL}:\n"
        "    importlib.import_module(parser().parse_args(words.split()).run.rpartition('.')[0])\n"
    )
    done = python(code)
    assert done.returncode == 0, done.stderr


# --- a connection --------------------------------------------------------------------------------


@pytest.fixture
def cell(listener: zenoh.Session) -> Iterator[Connection]:
    """A connection to it."""
    with Connection(open_session(connect=endpoints(listener)), "bench") as connected:
        yield connected


GREEN = (0.0, 0.5, 0.0, 1.0)
BOX = SceneObject(
    "board", "box", "base", (0.6, 0.0, 0.01), (0.0, 0.0, 0.0, 1.0), (0.1, 0.2, 0.01), GREEN
)
TURNED = (0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8)
PUBLISHED: dict[str, tuple[Callable[[Connection], None], dict[str, Any]]] = {
    "both hands": (
        lambda cell: cell.hands(left=(0.1, 0.2, 0.3), right=TURNED, stamp_ns=5, frame_id="headset"),
        {
            "hands/left": PoseStamped(5, "headset", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0)),
            "hands/right": PoseStamped(5, "headset", (0.1, 0.2, 0.3), (0.0, 0.6, 0.0, 0.8)),
        },
    ),
    "a hand": (
        lambda cell: cell.hands(right=[0, 1, 2], stamp_ns=6),
        {"hands/right": PoseStamped(6, "base", (0.0, 1.0, 2.0), (0.0, 0.0, 0.0, 1.0))},
    ),
    "the tool": (
        lambda cell: cell.tool(TURNED, stamp_ns=7),
        {"tool/pose": PoseStamped(7, "base", (0.1, 0.2, 0.3), (0.0, 0.6, 0.0, 0.8))},
    ),
    "the gripper": (
        lambda cell: cell.gripper(0.25, stamp_ns=8),
        {"gripper/state": JointState(8, ("gripper",), (0.25,), ())},
    ),
    "the joints": (
        lambda cell: cell.joints(["a", "b"], [0.5, -1], [0.0, 2.0], stamp_ns=9),
        {"joints/state": JointState(9, ("a", "b"), (0.5, -1.0), (0.0, 2.0))},
    ),
    "the joints without velocities": (
        lambda cell: cell.joints(("a",), (0.5,), stamp_ns=9),
        {"joints/state": JointState(9, ("a",), (0.5,), ())},
    ),
    "a pressed clutch": (lambda cell: cell.clutch(True), {"clutch": True}),
    "the gripper that a person wants": (
        lambda cell: cell.wish_gripper(1.0, stamp_ns=8),
        {"gripper/wish": 1.0},
    ),
    "objects": (
        lambda cell: cell.objects([BOX], stamp_ns=9),
        {"objects": (BOX,)},
    ),
}


@pytest.mark.parametrize(("call", "messages"), PUBLISHED.values(), ids=PUBLISHED)
def test_one_call_publishes_what_is_then_received(
    call: Callable[[Connection], None],
    messages: dict[str, Any],
    cell: Connection,
    listener: zenoh.Session,
) -> None:
    watches = {suffix: Watch(listener, "bench", suffix, timeout_s=10) for suffix in messages}
    call(cell)
    assert {suffix: next(watch) for suffix, watch in watches.items()} == messages
    for watch in watches.values():
        watch.close()


AT: dict[str, Any] = dict.fromkeys(("left", "right", "tool"), (0.1, 0.2, 0.3))
WRONG: dict[str, tuple[Callable[[Connection], object], str]] = {
    "no hand": (lambda cell: cell.hands(), "no hand given; left, right or both needed"),
    "no clutch": (lambda cell: cell.clutch(1), "clutch: 1 given; True or False needed"),  # type: ignore[arg-type]
    "too far closed": (
        lambda cell: cell.gripper(1.5),
        r"closure: 1.5 given; 0 \(open\) to 1 \(closed\) needed",
    ),
    "a joint too few": (
        lambda cell: cell.joints(["a", "b"], [1]),
        "positions and velocities of 2 joints needed",
    ),
    "a joint in words": (lambda cell: cell.joints(["a"], ["up"]), "of 1 joints needed"),  # type: ignore[list-item]
    "a joint nowhere": (
        lambda cell: cell.joints(["a"], [math.nan]),
        r"joints: \[nan\] .* finite numbers needed",
    ),
    "no closure": (lambda cell: cell.gripper(None), r"closure: \[None\] given; 0 \(open\)"),  # type: ignore[arg-type]
    "a shape": (
        lambda cell: cell.objects([BOX._replace(shape="cone")]),
        "shape 'cone' given; one of box, ball, cyl",
    ),
    "no size": (
        lambda cell: cell.objects([BOX._replace(size=(0.1, 0.1, 0.0))]),
        "object 'board': .* or no size",
    ),
    "no object": (lambda cell: cell.objects([("a", "box")]), "a SceneObject needed"),  # type: ignore[list-item]
    "a channel": (
        lambda cell: cell.watch("tool/targets"),
        "channel 'tool/targets' given; one of hands/left, .*status",
    ),
    "a request": (lambda cell: cell.watch("hold"), "channel 'hold' given"),
    "bytes": (lambda cell: cell.tool(b"123"), "tool: b'123' given; x y z"),
    "seconds": (
        lambda cell: cell.hands(left=(1, 2, 3), stamp_ns=1.7e9),
        "stamp_ns: 1700000000.0 given; whole nanos",
    ),  # type: ignore[arg-type]
    "before 1970": (
        lambda cell: cell.tool((1, 2, 3), stamp_ns=-1),
        "stamp_ns: -1 given; whole nanoseconds",
    ),
    "after 2038": (
        lambda cell: cell.tool((1, 2, 3), stamp_ns=2**62),
        "stamp_ns: .* given; whole nanoseconds",
    ),
    "a frame with an end": (
        lambda cell: cell.tool((1, 2, 3), frame_id="a\0b"),
        "frame_id: .* given; a name",
    ),
    "objects that are none": (
        lambda cell: cell.objects(None),
        "objects: None given; SceneObjects needed",
    ),  # type: ignore[arg-type]
    "a point": (
        lambda cell: cell.teach("a", left=(1, 2), right=(1, 2, 3), tool=(1, 2, 3)),
        "left: 2 numbers given; x",
    ),
    "a deviation": (
        lambda cell: cell.teach("a", **AT, std=np.ones(2)),
        "std: .* given; a number from 1e-05 to 1 accepted",
    ),
    "a radius": (
        lambda cell: cell.teach("a", **AT, radius=1j),
        "radius: '1j' given; a number from 0 to 0.2 accepted",
    ),
    "a direction": (
        lambda cell: cell.teach("a", **AT, orientation=5),
        "orientation: 5 given; 4 numbers needed",
    ),
    "a field": (lambda cell: cell.teach("a", **AT, stdd=1), "stdd.*did you mean std"),
    "a lone point": (
        lambda cell: cell.add(ViaPoint("a", **AT)),  # type: ignore[arg-type]
        "points: ViaPoint.* given; a list of ViaPoints needed",
    ),
    "a point in a dict": (
        lambda cell: cell.add([{"name": "a"}]),  # type: ignore[list-item]
        r"points: \[{'name': 'a'}\] given; a list of ViaPoints",
    ),
    "a joint switched on": (lambda cell: cell.joints(["a"], [True]), "finite numbers needed"),
    "a short position": (
        lambda cell: cell.objects([BOX._replace(position=(0, 0))]),  # type: ignore[arg-type]
        "object 'board': position: 2 numbers given; x y z",
    ),
    "a long colour": (
        lambda cell: cell.objects([BOX._replace(colour=(1e300, 0, 0, 1))]),
        "object 'board': a colour of red, green",
    ),
    "an object by number": (
        lambda cell: cell.objects([BOX._replace(name=5)]),  # type: ignore[arg-type]
        "object 5 given; a text as its name needed",
    ),
    "no shape": (
        lambda cell: cell.objects([BOX._replace(shape=[])]),  # type: ignore[arg-type]
        r"shape \[\] given; one of box",
    ),
    "a long step": (
        lambda cell: cell.wish_chunk([TURNED], step_s=1e300),
        r"step_s: 1e\+300 given; seconds needed, 0 to 1e\+06",
    ),
    "no step": (lambda cell: cell.wish_chunk([TURNED], step_s=0), "step_s: 0 given; a duration"),
    "a chunk beyond 2038": (
        lambda cell: cell.wish_chunk([TURNED] * 2, step_s=1, stamp_ns=MAX_STAMP_NS - 1),
        "stamp_ns: .* given; whole nanoseconds",
    ),
    "no wish": (lambda cell: cell.wish_chunk([], step_s=0.1), "poses: none given; at least one"),
    "a wish alone": (
        lambda cell: cell.wish_chunk(5, step_s=0.1),  # type: ignore[arg-type]
        "poses: 5 given; a list needed",
    ),
    "a wait in words": (
        lambda cell: cell.watch("status", timeout_s="1"),  # type: ignore[arg-type]
        "timeout_s: '1' given; seconds needed",
    ),
    "an unknown request": (
        lambda cell: cell.ask("nothing"),
        "request 'nothing' given; one of status, via_points, .* accepted",
    ),
}


POSES: dict[str, tuple[Any, str]] = {
    "digits": ("123", "left: '123' given; x y z"),
    "texts of digits": (["1", "2", "3"], "left: .* given; x y z"),
    "a switch": ((True, 0, 0), "left: .* given; x y z"),
    "without order": ({1.0, 2.0, 3.0}, "left: .* given; x y z"),
    "by name": ({1: 1, 2: 2, 3: 3}, "left: .* given; x y z"),
    "too large": ([10**400, 0, 0], "left: .* given; x y z"),
    "without end": (itertools.count(), "more than 7 numbers"),
    "a table": (np.eye(3), "left: array.* given; x y z"),
}
WRONG |= {
    name: (lambda cell, value=value: cell.hands(left=value), error)
    for name, (value, error) in POSES.items()
}


@pytest.mark.parametrize(("call", "error"), WRONG.values(), ids=WRONG)
def test_a_wrong_value_is_refused_before_anything_is_sent(
    call: Callable[[Connection], object], error: str, cell: Connection
) -> None:
    """The refusal is immediate: there is no daemon, for which a valid call would wait."""
    with pytest.raises(ValueError, match=error):
        call(cell)


def test_a_tracker_and_a_follower_refuse_what_cannot_be_encoded(
    listener: zenoh.Session, cell: Connection
) -> None:
    with (
        Watch(listener, "bench", "hands/left"),
        Watch(listener, "bench", "hands/right"),
        Tracker(cell.session, "bench", timeout_s=10) as tracker,
        Follower(cell.session, ("a", "b"), "bench") as follower,
    ):
        positions: tuple[Any, ...] = (
            (0, 0),
            (0, 0, 0, 0),
            "abc",
            None,
            5,
            [[0, 0, 0]],
            ("x", "y", "z"),
        )
        for position in positions:
            with pytest.raises(ValueError, match=r"left hand: .* given; a position x y z"):
                tracker.publish("left", position)
        joints: tuple[Any, ...] = (
            ([1], [1, 2]),
            ([1, 2], [1]),
            ("ab", "cd"),
            ([1, 2, 3], [1, 2, 3]),
        )
        for position, velocity in joints:
            with pytest.raises(
                ValueError, match="given; positions and velocities of 2 joints needed"
            ):
                follower.tell(position, velocity)
        tracker.publish("left", np.zeros(3), np.array([0, 0, 0, 1.0]), stamp_ns=np.int64(5))  # type: ignore[arg-type]
        follower.tell(np.zeros(2), ())  # type: ignore[arg-type]


class Seen(Hands):
    """Hands that a test gives, once each."""

    rate_hz = 1000.0

    def __init__(self, *poses: Any) -> None:
        self.poses = [*poses]

    def read(self) -> Any:
        return self.poses.pop(0)


@pytest.fixture
def watched(listener: zenoh.Session) -> Iterator[tuple[Watch, Watch]]:
    """Both hands that arrive."""
    left = Watch(listener, "bench", "hands/left", timeout_s=10)
    right = Watch(listener, "bench", "hands/right", timeout_s=10)
    yield left, right
    left.close()
    right.close()


BAD_POSES = [
    ((math.nan, 0, 0), "left: [nan, 0.0, 0.0] given; finite numbers needed"),
    ((0, 0, 0, 0, 0, 0, 2), "left: quaternion [0.0, 0.0, 0.0, 2.0] has norm 2; 1 needed"),
    ((0, 0), "left: 2 numbers given; x y z [m], or x y z and a quaternion"),
    (0.1, "left: 0.1 given; x y z [m], or x y z and a quaternion"),
]


@pytest.mark.parametrize(("pose", "message"), BAD_POSES)
def test_own_hands_say_once_what_is_no_pose_and_count(
    pose: Any,
    message: str,
    cell: Connection,
    watched: tuple[Watch, Watch],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As `Connection.hands` refuses it; the other hand is published."""
    hands = Seen(*[(pose, (0.1, 0.2, 0.3))] * 3)
    hands.publish(cell.session, "bench", is_over=lambda: not hands.poses)
    assert next(watched[1]).position == (0.1, 0.2, 0.3)
    first, last = capsys.readouterr().err.splitlines()
    assert message in first
    assert first.startswith("Seen.read: ")
    assert last == "3 poses of Seen.read were not published"
    with pytest.raises(ValueError, match=re.escape(message)):
        cell.hands(left=pose)


@pytest.mark.parametrize("hands", [None, 0.1, (None,), (None, None, None)])
def test_own_hands_that_are_not_two_are_refused(
    hands: Any, cell: Connection, watched: tuple[Watch, Watch]
) -> None:
    with pytest.raises(ExplainedError) as said:
        Seen(hands).publish(cell.session, "bench", is_over=lambda: False)
    assert f"Seen.read gives {hands!r}; the poses of the left and of the" in str(said.value)


def test_sigterm_ends_own_hands_with_exit_code_0(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import thirdhand\nclass Mine(thirdhand.Hands):\n  def read(self): return None, None\n"
    )
    with (
        serving(tmp_path) as daemon,
        started("hands", "--own", f"{file}:Mine", "--connect", daemon.endpoint) as command,
    ):
        assert command.stderr is not None
        assert "publishing the hands of" in command.stderr.readline()
        command.terminate()
        assert command.wait(10) == 0


def test_a_frame_that_the_cell_does_not_know_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hands = Seen()
    hands.frame_id = "nowhere"
    with serving(tmp_path) as daemon:
        hands.publish(daemon.session, is_over=lambda: True)
    message = "Seen.frame_id: 'nowhere' given; the cell accepts 'base', ''"
    assert capsys.readouterr().err.splitlines() == [message]


@pytest.mark.parametrize("value", [-1, 0, math.nan, 2000, None, True, "a" * 65])
@pytest.mark.parametrize("name", HANDS_ATTRIBUTES)
def test_attributes_of_own_hands_are_checked(
    name: str, value: Any, listener: zenoh.Session
) -> None:
    assert HANDS_ATTRIBUTES.keys() == Hands.__annotations__.keys()
    kind = type("Mine", (Seen,), {name: value})
    with pytest.raises(ExplainedError, match=f"Mine.{name}: .* given; .* needed"):
        kind().publish(listener, is_over=lambda: True)


def test_a_closed_connection_says_so_and_ends_its_watches(listener: zenoh.Session) -> None:
    with (
        Watch(listener, "bench", "hands/left"),
        Watch(listener, "bench", "hands/right"),
        connect(endpoints(listener)[0], cell="bench") as cell,
    ):
        cell.hands(left=(0, 0, 0))
        tracker = Tracker(cell.session, "bench", timeout_s=10)
        follower = Follower(cell.session, ("a",), "bench")
        received: list[list[Any]] = []
        watches = [cell.watch("tool/target"), cell.watch("status", timeout_s=60)]
        loops = [
            threading.Thread(target=lambda one=watch: received.append(list(one)), daemon=True)
            for watch in watches
        ]
        for loop in loops:
            loop.start()
        alone = cell.watch("tool/pose")
        alone.close()
        assert list(alone) == []
        cell.close()
        for loop in loops:
            loop.join(10)
        assert received == [[], []]
        calls: tuple[Callable[[], object], ...] = (
            lambda: cell.hands(left=(0, 0, 0)),
            lambda: cell.tool((0, 0, 0)),
            lambda: cell.clutch(True),
            cell.hold,
            cell.status,
            cell.via_points,
            lambda: cell.watch("status"),
            lambda: tracker.publish("left", (0, 0, 0)),
            lambda: follower.tell([0.0], [0.0]),
        )
        for call in calls:
            with pytest.raises(
                UnreachableError, match="the connection was closed in this program: open a new one"
            ):
                call()


FORGETS = """
def watch():
    return thirdhand.connect(sys.argv[1]).watch("tool/target", timeout_s=0.1)
print(next(watch()), next(watch()))
"""
OWN_SESSION = """
session = thirdhand.open_session(connect=sys.argv[1:])
print(*itertools.islice(thirdhand.Connection(session).watch("tool/target", timeout_s=0.1), 2))
"""
THREAD = """
watch = thirdhand.connect(sys.argv[1]).watch("tool/target", timeout_s=0.3)
threading.Thread(target=lambda: print(next(watch), next(watch))).start()
"""
AT_EXIT = """
watch = thirdhand.connect(sys.argv[1]).watch("tool/target", timeout_s=0.1)
atexit.register(lambda: print(next(watch), next(watch)))
"""
FORK = """
import os
watch = thirdhand.connect(sys.argv[1]).watch("tool/target", timeout_s=0.1)
if not os.fork():
    sys.exit(0)
os.wait()
print(next(watch), next(watch))
"""


@pytest.mark.parametrize("program", [FORGETS, OWN_SESSION, THREAD, AT_EXIT, FORK])
def test_a_program_that_closes_nothing_ends(listener: zenoh.Session, program: str) -> None:
    """With what its threads and its calls at exit do, also where an error ends it."""
    code = f"import atexit, itertools, sys, threading, thirdhand{program}sys.exit(3)"
    done = python(code, *endpoints(listener))
    assert (done.returncode, done.stdout, done.stderr) == (3, "None None\n", "")


def test_an_asynchronous_program_watches_too(listener: zenoh.Session) -> None:
    """Messages arrive in order while others work, silence is None, and closing ends the loop."""

    async def watched(sender: zenoh.Session) -> list[object]:
        seen: list[object] = []
        with Connection(listener, "async").watch("tool/setpoint", timeout_s=0.3) as watch:
            publisher = Publisher(sender, "async", "tool/setpoint")
            await asyncio.to_thread(until, lambda: publisher.is_heard)
            task = asyncio.create_task(anext(watch))
            await asyncio.sleep(0.05)
            assert not task.done()
            for number in range(3):
                publisher.put(
                    cdr.encode_pose(PoseStamped(number, "base", (0.1, 0.2, 0.3), UNTURNED))
                )
            seen.append((await task).stamp_ns)
            async for message in watch:
                seen.append(message and message.stamp_ns)
                if message is None:
                    watch.close()
            publisher.close()
        return seen

    with open_session(connect=endpoints(listener)) as sender:
        assert asyncio.run(watched(sender)) == [0, 1, 2, None]


def test_watch_yields_in_order_and_none_in_silence(
    cell: Connection, listener: zenoh.Session
) -> None:
    """A watch yields messages in order, None in silence, and skips messages that cannot be
    decoded.
    """
    encode = channels.BY_KEY["tool/setpoint"].codec.encode
    poses = [PoseStamped(n, "base", (0.0, 0.0, float(n)), (0.0, 0.0, 0.0, 1.0)) for n in range(3)]
    with cell.watch("tool/setpoint", timeout_s=1.0) as watch:
        assert next(watch) is None
        daemon = Publisher(listener, "bench", "tool/setpoint")
        wait_until_heard(daemon, timeout_s=10)
        daemon.put(b"nonsense")
        for pose in poses:
            daemon.put(encode(pose))
        assert list(itertools.islice(watch, 4)) == [*poses, None]
        assert (watch.rejected, watch.reason[:6]) == (1, "header")
