"""Sessions in process: the core, driven tick by tick by the bench or by hands only, faster than
real time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from support.wam import JOINT_NAMES, URDF
from thirdhand.contract import cdr
from thirdhand.contract.messages import GRIPPER, JointState
from thirdhand.contract.records import SIDES
from thirdhand.core.controller import Controller, run, start_state
from thirdhand.core.frame import Event, Frame, Record, Tick, Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import Recorder
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.closed_loop import hand_event, joints_event
from thirdhand_sim.script import HandScript

ASSUMED = msgspec.structs.replace(
    Settings(), arm=msgspec.structs.replace(Settings().arm, source="assumed")
)
# positions of resting hands [m]
LEFT = (0.98, -0.32, 0.06)
RIGHT = (0.98, 0.32, 0.06)


def hand(side: str, position: tuple[float, float, float], stamp_ns: int) -> Event:
    """A hand's sample as an event."""
    return hand_event(side, position, stamp_ns)


def arm(
    joints: tuple[float, ...], stamp_ns: int, velocities: tuple[float, ...] = (0.0,) * 7
) -> Event:
    """The arm's sample as an event."""
    return joints_event(JOINT_NAMES, joints, velocities, stamp_ns)


def clutch(is_pressed: bool) -> Event:
    """A message of the clutch as an event."""
    return Event("clutch", cdr.encode_bool(is_pressed), is_pressed)


def wish(closure: float) -> Event:
    """A wish for the gripper as an event."""
    data = cdr.encode_joints(JointState(0, (GRIPPER,), (closure,), ()))
    return Event("gripper/wish", data, cdr.decode_closure(data))


def seen(hands: Vector, k: int) -> tuple[Event, ...]:
    """Samples of both hands (2, 3) [m] that arrive in tick k."""
    return tuple(
        hand(side, tuple(position.tolist()), k + 1)
        for side, position in zip(SIDES, hands, strict=True)
    )


def nothing(k: int) -> tuple[Event, ...]:
    """No event in tick k."""
    return ()


def led(
    hands: Iterable[Vector],
    extra: Callable[[int], tuple[Event, ...]] = nothing,
    *,
    first: int = 0,
    every: int = 5,
) -> Iterator[Tick]:
    """Ticks with the hands at positions (T, 2, 3) [m], some of which a tracker samples."""
    for k, positions in enumerate(hands, first):
        yield Tick(k, (*(seen(positions, k) if k % every == 0 else ()), *extra(k)))


def ticks_of(script: HandScript, *, wait_s: float = 1.5, tail_s: float = 0.5) -> Iterator[Tick]:
    """Ticks with the script's hands, which rest at their start for a while."""
    hands_at = script_hands(script, wait_s=wait_s)
    return led(hands_at(k) for k in range(round((wait_s + script.duration_s + tail_s) / 0.002)))


def resting(
    first: int, count: int, extra: Callable[[int], tuple[Event, ...]] = nothing, *, every: int = 5
) -> list[Tick]:
    """Ticks with both hands resting at their start."""
    return list(led(np.tile((LEFT, RIGHT), (count, 1, 1)), extra, first=first, every=every))


def frames(controller: Controller, ticks: Iterable[Tick]) -> np.ndarray:
    """The frames (T,) of a controller that steps through ticks."""
    out: list[Frame] = []
    run(controller, ticks, [lambda _, frame: out.append(frame)])
    return np.array(out)


def assert_limits_hold(seen: np.ndarray, cell: Settings = ASSUMED) -> None:
    """Assert that every number is finite, that joints are within their limits or move inwards, and
    that speeds, accelerations, jerks and consecutive commands are as their limits allow.
    """
    limits = cell.joints
    dt = cell.period_s
    for name in seen.dtype.names or ():
        assert np.isfinite(seen[name]).all(), name
    sent = seen[seen["commanded"] == 1]
    q, dq, ddq = (sent[name] for name in ("joints", "joint_velocities", "joint_accelerations"))
    outside = np.maximum(np.maximum(q - limits.upper, limits.lower - q), 0.0)
    assert (np.diff(outside, axis=0, prepend=outside[:1]) <= 0.0).all(), "outside the limits"
    assert (np.abs(dq) <= limits.velocity).all(), "speed"
    assert (np.abs(ddq) <= np.array(limits.acceleration) * (1 + 1e-9)).all(), "acceleration"
    assert (np.abs(np.diff(ddq, axis=0)) / dt <= np.array(limits.jerk) * (1 + 1e-6)).all(), "jerk"
    moved = np.diff(q, axis=0) - 0.5 * dt * (dq[1:] + dq[:-1])
    assert (np.abs(moved) <= 2e-9 + 0.25 * np.array(limits.jerk) * dt**3).all(), "a jump"


def record(
    path: Path,
    skill: Skill,
    ticks: Iterable[Tick],
    *,
    states_every: int | None = None,
    change: Callable[[Frame], None] = lambda frame: None,
    **more: Any,
) -> Path:
    """A recording of a cell whose arm does not report its joints, with states and changed frames
    where they are requested.
    """
    controller = Controller(ASSUMED, skill, urdf=URDF)
    start = controller.state
    with Recorder(path, settings=ASSUMED, skill=skill.file, state=start, **more) as recorder:

        def write(tick: Tick, frame: Frame) -> None:
            is_whole = states_every and tick.index % states_every == 0
            changed = frame.copy()
            change(changed)
            recorder.write(
                tick,
                changed,
                time_ns=tick.index * 2_000_000,
                state=controller.state if is_whole else None,
            )

        run(controller, ticks, [write])
    return path


class Loop:
    """A controller and an arm that is at its command, which reports its joints and their velocities
    through `reports`. `hands` gives the positions of the hands in a tick; None: unseen.
    """

    def __init__(
        self, cell: Settings, skill: Skill, start: Vector | tuple[float, ...] | None = None
    ) -> None:
        self.controller = Controller(cell, skill, urdf=robot_description(cell))
        self.joints = np.array(cell.arm.posture if start is None else start)
        self.speed = np.zeros(len(self.joints))
        self.reports: Callable[[Vector, Vector], tuple[Vector, Vector]] = lambda q, dq: (q, dq)
        self.hands: Callable[[int], Vector] | None = lambda k: np.array((LEFT, RIGHT))
        self.index = 0
        self.steps: list[tuple[Tick, Frame]] = []
        self._names = cell.joints.names

    @property
    def frames(self) -> np.ndarray:
        """All frames (T,) so far."""
        return np.array([frame for _, frame in self.steps])

    def step(self, *events: Event, is_heard: bool = True) -> Frame:
        """One tick; the hands are sampled in every fifth tick."""
        k = self.index
        inbox = list(seen(self.hands(k), k)) if self.hands is not None and k % 5 == 0 else []
        if is_heard:
            joints, speed = (tuple(part.tolist()) for part in self.reports(self.joints, self.speed))
            inbox.append(joints_event(self._names, joints, speed, stamp_ns(k)))
        tick = Tick(k, (*inbox, *events))
        frame = self.controller.step(tick)
        self.steps.append((tick, frame))
        self.index += 1
        if frame["commanded"]:
            self.joints = frame["joints"].copy()
            self.speed = frame["joint_velocities"].copy()
        return frame

    def run(
        self, ticks: int, events: Mapping[int, Event] | None = None, *, every: int = 1
    ) -> np.ndarray:
        """The frames of further ticks, with events by the number of their tick in this run. The arm
        reports every `every` ticks, or never.
        """
        events = events or {}
        for k in range(ticks):
            self.step(
                *([events[k]] if k in events else []),
                is_heard=bool(every) and self.index % every == 0,
            )
        return self.frames[-ticks:]


def stamp_ns(k: int) -> int:
    """The stamp of an arm's report in tick k."""
    return 10**12 + 2_000_000 * k


def script_hands(script: HandScript, *, wait_s: float = 1.5) -> Callable[[int], Vector]:
    """Positions of both hands (2, 3) [m] in each tick of 2 ms; at first they rest for a while."""
    return lambda k: np.array(script.sample(max(0.0, 0.002 * k - wait_s)))[:, :3]


def assert_replays(
    path: Path,
    cell: Settings,
    skill: Skill,
    steps: list[tuple[Tick, Frame]],
    state: Record | None = None,
) -> None:
    """Assert that ticks and frames, recorded from a state on, replay identically."""
    state = start_state(cell, skill) if state is None else state
    with Recorder(path, settings=cell, skill=skill.file, state=state) as recorder:
        for tick, frame in steps:
            recorder.write(tick, frame, time_ns=stamp_ns(tick.index))
    assert replay(path).text() == f"{len(steps)} ticks, {len(steps)} frames identical"
