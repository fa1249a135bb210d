"""`python -m sim.golden`: the golden session, about 20 s in process with everything in it that the core has to cope with.

Made anew it is a new session; with `--refresh` its ticks are kept and only the frames are computed again, for a change of behaviour that is meant.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from service import wire
from service.config import Settings
from service.controller import Controller, Tap, run
from service.frame import Event, Frame, Record, Tick, differences
from service.recording import Recorder, Recording, RecordingError
from service.replay import ticks
from service.skill import Skill, SkillError
from sim.bench import Bench
from sim.hands import HandScript
from sim.scene import Scene

START_NS = 1_000_000_000_000
STATE_EVERY = 500  # ticks
SECONDS = 20.0
MOVED = Scene(handover=(0.66, -0.22, 0.33))
# What happens when [s].
TEACH_S, BEGIN_S, DROPOUT_S, HOLD_S, BAD_S, AWAY_S, RETEACH_S = 0.5, 2.0, (6.5, 7.0), (9.0, 9.6), (10.0, 10.5), (13.2, 13.8), 14.5


def session(bench: Bench, skill: Skill, newest: list[Frame], period_s: float) -> Iterator[Tick]:
    """The ticks of the session, closed over the bench by the frames that come of them."""
    nominal = skill.adapted(bench.scene.places(), tolerance=0.05)
    moved = skill.adapted(MOVED.places(), tolerance=0.05)
    at = {round(TEACH_S / period_s): nominal, round(RETEACH_S / period_s): moved}
    orders = {round(HOLD_S[0] / period_s): "hold", round(HOLD_S[1] / period_s): "resume"}
    jump = 0
    for k in range(round(SECONDS / period_s)):
        t = k * period_s
        if k == round(BEGIN_S / period_s):
            bench.begin()
        if bench.finished:
            bench.turn_back()
        commanded = bool(newest) and bool(newest[-1]["commanded"])
        seen = bench.step(newest[-1]["joints"].tolist(), newest[-1]["joint_velocities"].tolist()) if commanded else bench.step()
        stamp_ns = START_NS + k * round(period_s * 1e9)
        inbox = []
        if k % 5 == 0:
            inbox += _hands(bench, t, stamp_ns)
            joints = wire.JointState(stamp_ns, wire.JOINT_NAMES, seen.joints, seen.joint_velocities)
            inbox.append(Event("joints/state", wire.encode_joints(joints), joints))
        if k in at:
            inbox.append(Event("skill", at[k].to_bytes(), at[k]))
        if k in orders:
            inbox.append(Event(orders[k], wire.encode_string("{}"), None))
        if k % 1777 == 1776:  # deadlines that were missed
            jump += 3
        yield Tick(k + jump, tuple(inbox))


def _hands(bench: Bench, t: float, stamp_ns: int) -> list[Event]:
    """Both hands' samples at one time: in parts of the session one is missing, spoilt or far away."""
    events = []
    for side, values in zip(("left", "right"), (pose.tolist() for pose in bench.script.sample(bench.time_s)), strict=True):
        pose = wire.PoseStamped(stamp_ns, wire.BASE, tuple(values[:3]), tuple(values[3:]))
        if side == "left":
            if DROPOUT_S[0] <= t < DROPOUT_S[1]:
                continue
            if BAD_S[0] <= t < BAD_S[1]:
                spoilt = (
                    pose._replace(position=(math.nan, 0.0, 0.0)),
                    pose._replace(orientation=(0.0, 0.0, 0.0, 0.0)),
                    pose._replace(position=(1000.0 * pose.position[0], 0.0, 0.0)),
                    pose._replace(stamp_ns=stamp_ns - 10_000_000_000),
                )
                bad = spoilt[round(t * 100) % 4]
                events.append(Event("hands/left", wire.encode_pose(bad), bad))
                events.append(Event("hands/left", wire.encode_pose(pose), pose))
            if AWAY_S[0] <= t < AWAY_S[1]:
                pose = pose._replace(position=(pose.position[0], pose.position[1] - 0.2, pose.position[2] + 0.5))
        events.append(Event(f"hands/{side}", wire.encode_pose(pose), pose))
    return events


def record(path: Path, settings: Settings, skill: Skill, source: Iterator[Tick], frames: list[Frame], *, state: Record | None = None) -> None:
    """Runs the core on ticks and writes what came of it; `frames` grows as it runs."""
    controller = Controller(settings, skill, state)
    with Recorder(path, settings=settings, skill=skill.to_bytes(), state=controller.state) as recorder:

        def keep(tick: Tick, frame: Frame) -> None:
            frames.append(frame)
            after = controller.state if len(frames) % STATE_EVERY == 0 else None
            recorder.write(tick, frame, time_ns=START_NS + tick.index * round(settings.period_s * 1e9), state=after)

        taps: list[Tap] = [keep]
        run(controller, source, taps)


def make(path: Path, skill: Skill) -> None:
    """Writes a new golden session."""
    settings, frames = Settings(), list[Frame]()
    scene = Scene()
    with Bench(HandScript(scene, seed=scene.seed), rate_hz=settings.rate_hz) as bench:
        record(path, settings, skill, session(bench, skill, frames, settings.period_s), frames)


def refresh(path: Path) -> dict[str, float]:
    """Computes the frames of a golden session anew from its ticks; the largest change in each field that changed."""
    old = Recording.open(path)
    first = next(old.steps())
    before = [step.frame for step in old.steps() if step.frame is not None]
    frames: list[Frame] = []
    beside = path.with_suffix(".new")
    skill = Skill.from_bytes(old.skill, origin=str(path))
    record(beside, old.settings, skill, ticks(old), frames, state=first.state if first.frame is None else None)
    beside.replace(path)
    changes: dict[str, float] = {}
    for was, now in zip(before, frames, strict=True):
        for name, value in differences(was, now).items():
            changes[name] = float(np.fmax(changes.get(name, 0.0), value))
    return changes


def main(arguments: list[str] | None = None) -> int:
    """The exit code: 0, 1 on failure, 2 on bad usage."""
    p = argparse.ArgumentParser(
        prog="python -m sim.golden",
        description="The golden session: what every later version must decide alike.",
        epilog="example:\n  python -m sim.golden --output recordings/golden.mcap --skill recordings/soldering.npz\n  python -m sim.golden --refresh",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--output", metavar="FILE", type=Path, default=Path("recordings/golden.mcap"), help="the recording (default: %(default)s)")
    p.add_argument("--skill", metavar="FILE", type=Path, default=Path("recordings/soldering.npz"), help="the skill (default: %(default)s)")
    p.add_argument("--refresh", action="store_true", help="keep the ticks, compute the frames anew, print the largest change per field")
    args = p.parse_args(arguments)
    try:
        if args.refresh:
            changes = refresh(args.output)
            print("\n".join(f"{name:<24} changed by at most {value:.3g}" for name, value in sorted(changes.items())) or "nothing changed")
        else:
            make(args.output, Skill.from_bytes(args.skill.read_bytes(), origin=str(args.skill)))
            print(args.output)
    except (OSError, RecordingError, SkillError) as error:
        print(f"python -m sim.golden: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
