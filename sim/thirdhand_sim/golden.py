"""`python -m thirdhand_sim.golden`: the golden session, 20 s in one process with everything that
the core must handle.

Without options it makes a new session. With `--refresh` it keeps the ticks and computes the frames
again, after an intended change of behaviour.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import itertools
import math
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from thirdhand.cli.usage import option
from thirdhand.contract import cdr
from thirdhand.contract.explain import in_words
from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.core.controller import Controller, Tap, outgoing, run
from thirdhand.core.frame import Event, Frame, Tick, differences, order
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.recordings.recording import Recorder, Recording
from thirdhand.recordings.replay import ticks
from thirdhand.recordings.steps import checksum
from thirdhand.settings.config import Settings, robot_description
from thirdhand.settings.whole_file import whole
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded
from thirdhand.skills.via_points import adapted
from thirdhand_sim.bench import Bench
from thirdhand_sim.closed_loop import START_NS, ClosedLoop, hand_event, joints_event
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

WHOLE_EVERY = 500  # [ticks] interval of whole frames; the others have a checksum
# Resolutions of tracker [m] and joint encoders [rad, rad/s]: finer noise would enlarge the file.
TRACKED = 2.0**-15
ENCODED = 2.0**-14
ENCODED_SPEED = 2.0**-10
SESSION_S = 20.0
MOVED_SCENE = Scene(handover=(0.66, -0.22, 0.33))
# Times of the session's events, or their begins and ends.
TEACH_S = 0.5  # the via-points of the scene are taught
BEGIN_S = 2.0  # the script begins
DROPOUT_S = (6.5, 7.2)  # the left hand is out of sight
HOLD_S = (9.0, 9.6)  # the operator holds and resumes
BAD_S = (10.0, 10.5)  # each sample of the left hand follows an invalid one
AWAY_S = (13.2, 13.8)  # the left hand is far away from the demonstrations
RETEACH_S = 14.5  # a moved handover is taught


class GoldenSession:
    """The golden session: a bench in closed loop, with events at fixed times."""

    def __init__(self, bench: Bench, skill: StoredSkill) -> None:
        self._bench = bench
        self._adopted = {
            self._tick(TEACH_S): adapted(skill, bench.scene.via_points(), tolerance=TOLERANCE_M),
            self._tick(RETEACH_S): adapted(skill, MOVED_SCENE.via_points(), tolerance=TOLERANCE_M),
        }
        self._orders = {self._tick(HOLD_S[0]): "hold", self._tick(HOLD_S[1]): "resume"}
        self.loop = ClosedLoop(bench, direct=self._direct, spoil=self._spoil)

    def _tick(self, t: float) -> int:
        return round(t / self._bench.period_s)

    def ticks(self) -> Iterator[Tick]:
        """The ticks of the session, with some missed deadlines."""
        jump = 0
        for tick in itertools.islice(self.loop.ticks(), self._tick(SESSION_S)):
            events = [_as_measured(event) for event in tick.inbox]
            k = tick.index
            if k in self._adopted:
                events.append(Event("skill", self._adopted[k].file, self._adopted[k].for_loop()))
            if k in self._orders:
                events.append(order(self._orders[k]))
            if k % 1777 == 1776:
                jump += 3
            yield Tick(k + jump, tuple(events))

    def _direct(self, bench: Bench) -> None:
        if bench.tick == self._tick(BEGIN_S):
            bench.begin()
        if bench.finished:
            bench.turn_back()

    def _spoil(self, event: Event) -> tuple[Event, ...]:
        """Remove, spoil or displace samples of the left hand in parts of the session."""
        pose = event.value
        t = self._bench.tick * self._bench.period_s
        if event.kind != "hands/left":
            return (event,)
        if DROPOUT_S[0] <= t < DROPOUT_S[1]:
            return ()
        if BAD_S[0] <= t < BAD_S[1]:
            spoilt = (
                pose._replace(position=(math.nan, 0.0, 0.0)),
                pose._replace(orientation=(0.0, 0.0, 0.0, 0.0)),
                pose._replace(position=(1000.0 * pose.position[0], 0.0, 0.0)),
                pose._replace(stamp_ns=pose.stamp_ns - 10_000_000_000),
            )
            bad = spoilt[round(t * 100) % 4]
            return (Event(event.kind, cdr.encode_pose(bad), bad), event)
        if AWAY_S[0] <= t < AWAY_S[1]:
            x, y, z = pose.position
            return (hand_event("left", (x, y - 0.2, z + 0.5), pose.stamp_ns, pose.orientation),)
        return (event,)


def _as_measured(event: Event) -> Event:
    """A sample, rounded to the resolution of its sensor."""
    was = event.value
    if event.kind == "joints/state":
        position = _rounded(was.position, ENCODED)
        velocity = _rounded(was.velocity, ENCODED_SPEED)
        return joints_event(was.names, position, velocity, was.stamp_ns)
    now = was._replace(position=_rounded(was.position, TRACKED))
    return Event(event.kind, cdr.encode_pose(now), now)


def _rounded(values: tuple[float, ...], step: float) -> tuple[float, ...]:
    return tuple((np.round(np.array(values) / step) * step).tolist())


def record(
    path: Path,
    settings: Settings,
    skill: StoredSkill,
    source: Iterable[Tick],
    *,
    follow: Tap = lambda tick, frame: None,
) -> list[Frame]:
    """Run the core on ticks, record them with checksums of frames and commands and every 500th
    frame as a whole, and return the frames. `follow` is called with each tick and frame.
    """
    steps: list[tuple[Tick, Frame]] = []
    checksums: dict[int, int] = {}
    controller = Controller(settings, skill.for_loop(), urdf=robot_description(settings))
    start = controller.state

    def keep(tick: Tick, frame: Frame) -> None:
        steps.append((tick, frame))
        state = controller.state if tick.index % WHOLE_EVERY == 0 else None
        outputs = outgoing(frame, _time_ns(tick, settings), settings.joints.names)
        checksums[tick.index] = checksum(frame, outputs, state)

    run(controller, source, [keep, follow])
    table = np.zeros(max(checksums, default=-1) + 1, "<u4")
    table[[*checksums]] = [*checksums.values()]
    constants = controller.constants
    with Recorder(
        path,
        settings=settings,
        skill=skill.file,
        state=start,
        constants=constants,
        checksums=table.tobytes(),
    ) as recorder:
        for tick, frame in steps:
            whole_frame = frame if tick.index % WHOLE_EVERY == 0 else None
            recorder.write(tick, whole_frame, time_ns=_time_ns(tick, settings))
    return [frame for _, frame in steps]


def _time_ns(tick: Tick, settings: Settings) -> int:
    return START_NS + tick.index * round(settings.period_s * 1e9)


def make(path: Path, skill: StoredSkill) -> None:
    """Write a new golden session."""
    settings = Settings()
    scene = Scene()
    with Bench(HandScript(scene, seed=scene.seed), settings=settings) as bench:
        session = GoldenSession(bench, skill)
        record(path, settings, skill, session.ticks(), follow=session.loop.follow)


def refresh(path: Path) -> dict[str, float]:
    """Compute the frames of a golden session again from its ticks. Returns the number of changed
    ticks, and the largest change in each field of the frames that are recorded as a whole.
    """
    old = Recording.open(path)
    try:
        before = [step.frame for step in old.steps(whole=False) if step.frame is not None]
    except RecordingError:  # frames or states had another layout, and cannot be compared
        before = []
    with whole(path) as part:
        frames = record(part, old.settings, decoded(old.skill, origin=str(path)), ticks(old))
    now = {int(frame["tick"]): frame for frame in frames}
    checksums = Recording.open(path).checksums
    changed = sum(checksums.get(tick) != was for tick, was in old.checksums.items())
    changes = {"ticks": float(changed)} if changed else {}
    for was in before:
        for name, value in differences(was, now[int(was["tick"])]).items():
            changes[name] = float(np.fmax(changes.get(name, 0.0), value))
    return changes


def main(arguments: list[str] | None = None) -> int:
    """Make or refresh the golden session; exit code 0, 1 on failure, 2 on bad usage."""
    p = argparse.ArgumentParser(
        prog="python -m thirdhand_sim.golden",
        description="The golden session: every later version must decide the same in it.",
        epilog="example:\n  python -m thirdhand_sim.golden --output recordings/golden.mcap "
        "--skill recordings/soldering.npz\n  python -m thirdhand_sim.golden --refresh",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    option(p, "--output", "FILE", "the recording", Path("recordings/golden.mcap"))
    option(p, "--skill", "FILE", "the skill", Path("recordings/soldering.npz"))
    about = (
        "keep the ticks, compute the frames again, print the number of changed ticks and the "
        "largest changes"
    )
    p.add_argument("--refresh", action="store_true", help=about)
    args = p.parse_args(arguments)
    try:
        if args.refresh:
            changes = refresh(args.output)
            print(
                "\n".join(
                    f"{name:<24} changed: {value:.4g}" for name, value in sorted(changes.items())
                )
                or "nothing changed"
            )
        else:
            make(args.output, decoded(args.skill.read_bytes(), origin=str(args.skill)))
            print(args.output)
    except (OSError, RecordingError, SkillError) as error:
        print(f"python -m thirdhand_sim.golden: {in_words(error)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
