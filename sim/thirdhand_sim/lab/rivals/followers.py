"""Followers of moving hands in `motion`: the service's own core, and rivals at the same limits.

All use the same skill, inverse kinematics and joint limiter; they differ only in the smoothing
between these.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np
from ruckig import InputParameter, Ruckig, Synchronization, Trajectory

from thirdhand.contract.records import SIDES, Flag
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import Event, Tick, Vector
from thirdhand.core.limiter.stage import Limiter
from thirdhand.core.separation import FARTHEST_REPORTED_M
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.closed_loop import START_NS, hand_event
from thirdhand_sim.lab.open_loop import frames, targets
from thirdhand_sim.lab.people.moving_hands import PERIOD_S, Moving
from thirdhand_sim.lab.results import Array

SETTLE_TICKS = 1500  # before a sequence the tool moves to its first target
RESTING_EVERY = 5  # ticks from one sample to the next during that motion


class Followed(NamedTuple):
    """The tool's path (N, 3) [m], the joints' velocities (N, J) [rad/s], the tool's largest speed
    [m/s], and the share of ticks in which a limit is reached.
    """

    tool: Array
    joints: Array
    top_speed: float
    limited: float
    estimate: Array | None = None  # (N, 2, 3) estimated hands
    target: Array | None = None
    setpoint: Array | None = None


Follower: TypeAlias = Callable[[Moving], Followed]


def ours(skill: Skill, settings: Settings, tuning: Tuning = TUNING) -> Follower:
    """The service's core, tick by tick. As the rivals, it does not hold for hands far from the
    demonstrations, and keeps no distance from people and obstacles.
    """
    skill = replace(skill, threshold=math.inf)
    settings = msgspec.structs.replace(
        settings,
        people=msgspec.structs.replace(settings.people, clearance=-FARTHEST_REPORTED_M),
        obstacles=msgspec.structs.replace(settings.obstacles, clearance=-FARTHEST_REPORTED_M),
    )

    def follow(hands: Moving) -> Followed:
        records = frames(skill, _ticks(hands), settings, tuning)[SETTLE_TICKS:]
        speed = np.linalg.norm(np.diff(records["tool"], axis=0), axis=1) / PERIOD_S
        limited = float(np.mean(records["flags"] & Flag.SPEED_LIMITED > 0))
        paths = (records[name] for name in ("hands", "target", "setpoint"))
        return Followed(
            records["tool"], records["joint_velocities"], float(speed.max()), limited, *paths
        )

    return follow


def _ticks(hands: Moving) -> Iterator[Tick]:
    """Hands at rest at their start, then the tracker's samples, at the tick of their arrival."""
    count = len(hands.stamps)
    resting = np.arange(-SETTLE_TICKS, 0, RESTING_EVERY) * PERIOD_S
    stamps = np.concatenate([resting, hands.stamps])
    samples = np.vstack([np.tile(hands.truth[0], (len(resting), 1)), hands.samples])
    late = np.zeros((len(stamps), 2))
    if hands.late is not None:
        late[:] = hands.late[np.arange(-len(resting), count) % count]
        late[: len(resting)] = np.where(np.isinf(late[: len(resting)]), 0.0, late[: len(resting)])
    inboxes: list[list[Event]] = [[] for _ in range(SETTLE_TICKS + len(hands.truth))]
    for stamp, position, waits in zip(stamps, samples, late, strict=True):
        for side, part, wait in zip(SIDES, (position[:3], position[3:]), waits, strict=True):
            came = stamp + wait
            tick = (
                SETTLE_TICKS + math.ceil(came / PERIOD_S - 1e-9)
                if came < math.inf
                else len(inboxes)
            )
            if tick < len(inboxes):
                x, y, z = part.tolist()
                since_ns = round(1e9 * (stamp + SETTLE_TICKS * PERIOD_S))
                inboxes[tick].append(hand_event(side, (x, y, z), START_NS + since_ns))
    for k, inbox in enumerate(inboxes):
        yield Tick(k, tuple(inbox))


class _Chain:
    """Inverse kinematics and joint limiter behind a rival's setpoints."""

    def __init__(self, skill: Skill, settings: Settings) -> None:
        self.skill = skill
        self.settings = settings
        # Rivals plan no stop: the speed of a tool far from its target is not reduced.
        self.arm = ArmStage(settings, robot_description(settings))
        self.arm.parameters["closing_braking"] = settings.tool.acceleration / 2
        self.arm.parameters["closing_speed"] = settings.tool.max_speed
        self.arm.parameters["far_speed"] = 0.5 * settings.tool.max_speed
        self.arm.parameters["far_damping"] = 0.0
        self.limiter = Limiter(settings.joints, settings.period_s)
        self.orientation = skill.orientation

    def targets(self, samples: Array) -> Array:
        """Targets (M, 3) [m] of the skill for samples (M, 6)."""
        return targets(self.skill, samples, self.settings)

    def start(self, position: Vector) -> tuple[Vector, Vector, Vector]:
        """Joints at rest with the tool at a position."""
        q = np.array(self.settings.arm.posture)
        dq, ddq = np.zeros((2, len(q)))
        for _ in range(2000):
            solution = self.arm.step(q, position, np.zeros(3), self.orientation)
            q, dq, ddq = self.limiter.step(q, dq, ddq, solution.velocity)[:3]
        return q, 0 * dq, 0 * ddq

    def follow(self, setpoints: Array) -> Followed:
        """The tool led by setpoints (N, 2, 3): position and velocity."""
        q, dq, ddq = self.start(setpoints[0, 0])
        tool = np.empty((len(setpoints), 3))
        joints = np.empty((len(setpoints), len(q)))
        limited = 0
        for k, (position, velocity) in enumerate(setpoints):
            # Ours also passes on the acceleration. A time-optimal acceleration jumps, so rivals do
            # not.
            solution = self.arm.step(q, position, velocity, self.orientation, moving=dq)
            q, dq, ddq = self.limiter.step(q, dq, ddq, solution.velocity)[:3]
            tool[k] = self.arm.at(q).position
            joints[k] = dq
            limited += solution.speed_limited
        return _followed(tool, joints, limited)._replace(setpoint=setpoints[:, 0])


def _followed(tool: Array, joints: Array, limited: int) -> Followed:
    speed = np.linalg.norm(np.diff(tool, axis=0), axis=1) / PERIOD_S
    return Followed(tool, joints, float(speed.max()), limited / len(tool))


def _newest(hands: Moving) -> Array:
    """Index of the newest sample at each tick (N,)."""
    arrival_ticks = np.ceil(hands.stamps / PERIOD_S - 1e-9)
    return np.maximum(
        np.searchsorted(arrival_ticks, np.arange(len(hands.truth)), side="right") - 1, 0
    )


def one_euro(hands: Moving, least_hz: float, beta: float) -> Array:
    """Samples after a One-Euro filter (Casiez, Roussel and Vogel, CHI 2012), each hand by its
    speed.
    """
    out = np.empty_like(hands.samples)
    x = hands.samples[0].copy()
    speed = np.zeros(6)
    out[0] = x
    for k in range(1, len(out)):
        interval = hands.stamps[k] - hands.stamps[k - 1]
        speed += _share(1.0, interval) * (
            (hands.samples[k] - hands.samples[k - 1]) / interval - speed
        )
        for hand in (slice(0, 3), slice(3, 6)):
            cut_hz = least_hz + beta * float(np.linalg.norm(speed[hand]))
            x[hand] += _share(cut_hz, interval) * (hands.samples[k, hand] - x[hand])
        out[k] = x
    return out


def _share(cut_hz: float, interval_s: float) -> float:
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cut_hz * interval_s))


def chase(skill: Skill, settings: Settings, *, least_hz: float, beta: float) -> Follower:
    """A One-Euro filter, then Ruckig to the newest target, assumed at rest."""
    tool = settings.tool
    axis_speed = tool.max_speed / math.sqrt(3)

    def follow(hands: Moving) -> Followed:
        chain = _Chain(skill, settings)
        targets = chain.targets(one_euro(hands, least_hz, beta))[_newest(hands)]
        limits = [axis_speed] * 3, [tool.acceleration] * 3, [tool.jerk] * 3
        return chain.follow(_by_ruckig(targets, limits)[:, :2])

    return follow


def servo(skill: Skill, settings: Settings, *, coefficient: float) -> Follower:
    """The pipeline of MoveIt Servo: inverse kinematics of the newest target, then a Butterworth
    filter and Ruckig on the joints.

    The filter is the first-order one of its plug-in, with its coefficient.
    """
    joints = settings.joints
    limits = list(joints.velocity), list(joints.acceleration), list(joints.jerk)

    def follow(hands: Moving) -> Followed:
        chain = _Chain(skill, settings)
        targets = chain.targets(hands.samples)[_newest(hands)]
        q = chain.start(targets[0])[0]
        before = q
        low = q.copy()
        setpoints = np.empty((len(targets), len(q)))
        limited = 0
        for k, target in enumerate(targets):
            solution = chain.arm.step(q, target, np.zeros(3), chain.orientation)
            limited += solution.speed_limited
            q = q + PERIOD_S * solution.velocity
            low = (q + before - (1.0 - coefficient) * low) / (1.0 + coefficient)
            before = q
            setpoints[k] = low
        moved = _by_ruckig(setpoints, limits)
        return _followed(
            np.array([chain.arm.at(q).position for q in moved[:, 0]]), moved[:, 1], limited
        )

    return follow


def unsmoothed(skill: Skill, settings: Settings) -> Follower:
    """The newest sample's target, passed to the inverse kinematics without smoothing."""

    def follow(hands: Moving) -> Followed:
        chain = _Chain(skill, settings)
        targets = chain.targets(hands.samples)[_newest(hands)]
        return chain.follow(np.stack([targets, np.zeros_like(targets)], axis=1))

    return follow


def truth(skill: Skill, settings: Settings) -> Follower:
    """The target of the true hands, passed to the inverse kinematics: errors of the arm only."""

    def follow(hands: Moving) -> Followed:
        chain = _Chain(skill, settings)
        targets = chain.targets(hands.truth)
        return chain.follow(np.stack([targets, np.gradient(targets, PERIOD_S, axis=0)], axis=1))

    return follow


def _by_ruckig(wanted: Array, limits: tuple[list[float], list[float], list[float]]) -> Array:
    """States (N, 3, D) of a time-optimal motion to each of the positions (N, D), assumed at
    rest.
    """
    size = wanted.shape[1]
    solver = Ruckig(size, PERIOD_S)
    question = InputParameter(size)
    profile = Trajectory(size)
    question.synchronization = Synchronization.No
    question.max_velocity, question.max_acceleration, question.max_jerk = limits
    question.target_velocity = question.target_acceleration = [0.0] * size
    state = np.stack([wanted[0], np.zeros(size), np.zeros(size)])
    out = np.empty((len(wanted), 3, size))
    since = 0
    for k, position in enumerate(wanted):
        if k == 0 or (position != wanted[k - 1]).any():
            question.current_position, question.current_velocity, question.current_acceleration = (
                state.tolist()
            )
            question.target_position = position.tolist()
            solver.calculate(question, profile)
            since = k
        state = np.array(profile.at_time((k - since + 1) * PERIOD_S))
        out[k] = state
    return out
