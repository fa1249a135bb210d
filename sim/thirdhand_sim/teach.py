"""`python -m thirdhand_sim.teach`: demonstrations of the soldering scene, as MCAP files with equal
bytes for equal seeds, or published live for `thirdhand record`.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from thirdhand.cli.usage import option
from thirdhand.client import ClientSettings, Publisher, client_settings
from thirdhand.contract import cdr
from thirdhand.contract.channels import ENDPOINT
from thirdhand.contract.explain import exit_code_of, in_words
from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.contract.requests import ViaPoint
from thirdhand.settings.file_content import SettingsError
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.takes.demonstration_reader import write_demonstration
from thirdhand_sim import made_tasks, sessions
from thirdhand_sim.people import Places
from thirdhand_sim.scene import TOOL_FROM_HAND, TOOL_ORIENTATION, Scene, SceneError
from thirdhand_sim.script import Array, Clock, HandScript, Teacher

RADIUS_M = 0.03  # radius of via-points
MIN_VIA_POINT_STD_M = 0.001  # least standard deviation of via-points
TEACH_EXAMPLE = """example:
  python -m thirdhand_sim.teach --live --count 1 & thirdhand record take-1 --until rest
  python -m thirdhand_sim.teach --output demonstrations --count 6
  thirdhand learn demonstrations/demonstration-*.mcap --output soldering.npz
"""
REST_BEFORE_S = 0.5  # rest before a published demonstration
REST_AFTER_S = 3.0  # rest after a published demonstration
TRAY = (0.95, -0.15, 0.12)  # [m] the left hand visits this place twice
RIGHT_REST = (0.95, 0.35, 0.07)  # [m] the right hand rests here
VISITED = made_tasks.TaskScene(
    np.array([(0.60, -0.30, 0.07), TRAY, (0.70, 0.02, 0.22), TRAY, (0.75, -0.42, 0.25)]),
    np.array([RIGHT_REST, RIGHT_REST, (0.78, 0.20, 0.20), RIGHT_REST, RIGHT_REST]),
    np.array(
        [
            (0.42, -0.28, 0.35),
            (0.62, -0.20, 0.30),
            (0.50, 0.15, 0.25),
            (0.38, -0.05, 0.40),
            (0.45, 0.30, 0.22),
        ]
    ),
    np.zeros((5, 3)),
)


def demonstrate(
    scene: Scene, *, seed: int, rate_hz: int = 100, begin_s: int = 0, gripper: bool = False
) -> Demonstration:
    """One demonstration of a scene at `rate_hz`: tracked hands, the measured tool, and if `gripper`
    the closure of the gripper.
    """
    script = HandScript(scene, seed=seed)
    teacher = Teacher(scene, seed=seed)
    steps = np.arange(round(scene.duration_s * rate_hz) + 1)
    times = (steps / rate_hz).tolist()
    hands = [script.sample(t) for t in times]
    return Demonstration(
        begin_s * 1_000_000_000 + steps * 1_000_000_000 // rate_hz,
        np.array([left for left, _ in hands]),
        np.array([right for _, right in hands]),
        np.array([teacher.sample(t) for t in times]),
        gripper=np.array([teacher.closure(t) for t in times]) if gripper else None,
    )


def demonstrations(
    scene: Scene, *, count: int, seed: int, gripper: bool = False
) -> list[Demonstration]:
    """`count` demonstrations of a scene, one a minute; each is independent of `count`."""
    return [
        demonstrate(scene, seed=1000 * seed + number, begin_s=60 * number, gripper=gripper)
        for number in range(1, count + 1)
    ]


def by_people(people: int) -> list[Demonstration]:
    """Two demonstrations of each modelled person, with things in their nominal places and moved,
    and with via-points.
    """
    return [
        recorded(demonstration, begin_s=60 * number)
        for number, demonstration in enumerate(sessions.demonstrations(people))
    ]


def recorded(shown: sessions.SessionDemonstration, *, begin_s: int = 1) -> Demonstration:
    """A demonstration of a session in the service's format."""
    count = len(shown.times)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    turned = np.tile(TOOL_ORIENTATION, (count, 1))
    return Demonstration(
        np.round(1e9 * (shown.times + begin_s)).astype(np.int64),
        np.hstack([shown.hands[:, :3], still]),
        np.hstack([shown.hands[:, 3:], still]),
        np.hstack([shown.tool, turned]),
        via_points=via_points_of(shown.places),
    )


def via_points_of(places: Places) -> tuple[ViaPoint, ...]:
    """The via-points of the task in the order of the tool's motion, with their standard deviations
    per axis: the error of the places (3-D rms) / sqrt(3).
    """
    p = places
    std = max(places.std_m / math.sqrt(3.0), MIN_VIA_POINT_STD_M)
    named = (
        ("start", p.left_start, p.right_start, p.robot_start),
        ("handover", p.handover, p.right_start, p.handover + TOOL_FROM_HAND),
        ("glass", p.board, p.iron, p.glass),
        ("soldering", p.board, p.right_final, p.carry),
    )
    rows = [
        {
            "name": name,
            **{
                part: np.round(position, 6).tolist()
                for part, position in zip(("left", "right", "tool"), ends, strict=True)
            },
            "std": std,
            "radius": RADIUS_M,
            "follow": "left" if name == "handover" else "none",
        }
        for name, *ends in named
    ]
    return msgspec.convert(rows, tuple[ViaPoint, ...])


def perform(
    scene: Scene,
    *,
    seed: int,
    connect: Sequence[str],
    cell: str,
    speed: float,
    wait_s: float,
    rate_hz: int = 100,
) -> bool:
    """Publish one demonstration of the soldering scene, see `publish`."""
    script = HandScript(scene, seed=seed, speed=speed)
    teacher = Teacher(scene, seed=seed, clock=Clock(speed=speed))

    def poses(t: float) -> tuple[Array, ...]:
        return (*script.sample(t), teacher.sample(t))

    return publish(
        poses,
        script.duration_s,
        REST_BEFORE_S / speed,
        connect=connect,
        cell=cell,
        wait_s=wait_s,
        rate_hz=rate_hz,
    )


def perform_visits(
    number: int, *, connect: Sequence[str], cell: str, speed: float, wait_s: float
) -> bool:
    """Publish a person's run of the task that visits a via-point twice, see `publish`."""
    demonstration = visits(number)
    times = demonstration.period_s * np.arange(len(demonstration.tool)) / speed

    def poses(t: float) -> tuple[Array, ...]:
        row = int(np.clip(np.searchsorted(times, t), 0, len(times) - 1))
        positions = (
            [np.interp(t, times, column) for column in part[:, :3].T] for part in demonstration[1:4]
        )
        return tuple(
            np.append(position, part[row, 3:])
            for position, part in zip(positions, demonstration[1:4], strict=True)
        )

    return publish(
        poses, float(times[-1]), REST_BEFORE_S / speed, connect=connect, cell=cell, wait_s=wait_s
    )


def visits(number: int) -> Demonstration:
    """A demonstration of that task; each number, from 1 on, is another person."""
    return made_tasks.run(made_tasks.TAUGHT, number - 1, 0, scene=VISITED).demonstration()


def publish(
    poses: Callable[[float], Sequence[Array]],
    lasts_s: float,
    before_s: float,
    *,
    connect: Sequence[str],
    cell: str,
    wait_s: float,
    rate_hz: int = 100,
) -> bool:
    """Publish hands and tool in real time, as a tracker does, while the hands have subscribers: at
    first they rest for `before_s`, and at the end for REST_AFTER_S. `poses` gives the poses at a
    time [s] after the begin, (7,) each.

    Returns True if both hands had a subscriber until the end. Raises UnreachableError.
    """
    with client_settings(connect=connect, cell=cell).session(timeout_s=wait_s) as session:
        names = ("hands/left", "hands/right", "tool/pose")
        publishers = [Publisher(session, cell, name) for name in names]
        until = time.monotonic() + wait_s
        of_hands = publishers[:2]
        while not _are_heard(of_hands):
            if time.monotonic() > until:
                return False
            time.sleep(0.02)
        begin = time.monotonic() + before_s
        step = 0
        while _are_heard(of_hands):
            t = time.monotonic() - begin
            if t > lasts_s + REST_AFTER_S:
                return True
            stamp_ns = time.time_ns()
            for publisher, pose in zip(publishers, poses(t), strict=True):
                row = pose.tolist()
                publisher.put(
                    cdr.encode_pose(PoseStamped(stamp_ns, BASE, tuple(row[:3]), tuple(row[3:])))
                )
            step += 1
            time.sleep(max(0.0, begin - before_s + step / rate_hz - time.monotonic()))
        return t >= lasts_s


def _are_heard(publishers: list[Publisher]) -> bool:
    """True if each publisher has a subscriber."""
    return all(publisher.is_heard for publisher in publishers)


def main(arguments: list[str] | None = None) -> int:
    """Make or publish demonstrations; exit code 0, 1 on failure, 2 on bad usage."""
    p = _parser()
    args = p.parse_args(arguments)
    _check(p, args)
    try:
        scene = Scene.load(args.scene) if args.scene else Scene()
        reach = client_settings(connect=args.connect, cell=args.cell)
        if args.via_points:
            points = msgspec.json.encode({"op": "add", "points": visits(1).via_points})
            args.via_points.write_bytes(msgspec.json.format(points) + b"\n")
            return 0
        if args.live:
            return _perform_all(scene, args, reach)
        args.output.mkdir(parents=True, exist_ok=True)
        seed = scene.seed if args.seed is None else args.seed
        takes = by_people(args.count)
        if not args.people:
            takes = demonstrations(scene, count=args.count, seed=seed, gripper=args.gripper)
        for number, taught in enumerate(takes, start=1):
            path = args.output / f"demonstration-{number}.mcap"
            write_demonstration(path, taught, cell=reach.cell)
            print(path)
    except (SettingsError, SceneError, OSError) as error:
        print(f"python -m thirdhand_sim.teach: {in_words(error)}", file=sys.stderr)
        return exit_code_of(error)
    return 0


def _parser() -> argparse.ArgumentParser:
    """The options."""
    p = argparse.ArgumentParser(
        prog="python -m thirdhand_sim.teach",
        description=(
            "Demonstrations of the soldering scene with hands and tool at 100 Hz, as MCAP files or "
            "live."
        ),
        epilog=TEACH_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    option(p, "--output", "DIR", "folder for demonstration-1.mcap and so on; made if missing")
    live = "publish them instead, each from the first subscriber of the hands on"
    p.add_argument("--live", action="store_true", help=live)
    connect = f"Zenoh endpoint ($THIRDHAND_CONNECT, else {ENDPOINT})"
    option(p, "--connect", "EP", connect, action="append", type=str)
    option(p, "--speed", "X", "the relative speed of the motions", 1.0, type=float)
    option(p, "--wait", "S", "wait this long for a subscriber", 60.0)
    option(p, "--count", None, "the number of demonstrations", 6, type=int)
    option(p, "--seed", None, "the seed of their scatter (default: the scene's)", type=int)
    option(
        p,
        "--scene",
        "FILE",
        "a TOML file with places [x, y, z] in metres (default: the nominal scene)",
    )
    people = "two demonstrations each by modelled people, with moved things and via-points"
    p.add_argument("--people", action="store_true", help=people)
    visit = (
        "another task, between five named via-points, with one visited twice; with --live or "
        "--via-points"
    )
    p.add_argument("--visits", action="store_true", help=visit)
    option(
        p, "--via-points", "FILE", "with --visits: write its via-points for `record --via-points`"
    )
    option(p, "--cell", "NAME", "prefix of topics and keys ($THIRDHAND_CELL, else thirdhand)")
    p.add_argument("--gripper", action="store_true", help="include the closure of the gripper")
    return p


def _check(p: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """End with bad usage if options are out of range or exclude each other."""
    if not 1 <= args.count <= 999:
        p.error(f"--count {args.count}: 1 to 999 accepted")
    if (args.seed or 0) < 0:
        p.error(f"--seed {args.seed}: 0 or more accepted")
    if [args.live, args.output is not None, args.via_points is not None].count(True) != 1:
        p.error("exactly one of --output DIR, --live and --via-points FILE needed")
    if args.visits == (args.output is not None) and (args.visits or args.via_points):
        p.error("--visits needs --live or --via-points, and --via-points needs --visits")
    if args.live and args.people:
        p.error("--people needs --output, not --live")
    fastest = 20 if args.live else 1
    slowest = 0.05 if args.live else 1
    if not slowest <= args.speed <= fastest:
        p.error(f"--speed {args.speed}: 0.05 to 20 accepted, with --live")


def _perform_all(scene: Scene, args: argparse.Namespace, reach: ClientSettings) -> int:
    """Publish all demonstrations; exit code 1 if one had no subscriber until its end."""
    seed = scene.seed if args.seed is None else args.seed
    for number in range(1, args.count + 1):
        to = {
            "connect": reach.connect,
            "cell": reach.cell,
            "speed": args.speed,
            "wait_s": args.wait,
        }
        heard = (
            perform_visits(number, **to)
            if args.visits
            else perform(scene, seed=1000 * seed + number, **to)
        )
        if not heard:
            print(
                f"python -m thirdhand_sim.teach: demonstration {number} had no subscriber until "
                "its end",
                file=sys.stderr,
            )
            return 1
        print(f"demonstration {number} of {args.count} published", file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
