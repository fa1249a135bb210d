"""Scripted hands and the teacher's tool: minimum-jerk motions through a scene, in phase with each
other, from a seed.

The tool's position must be a function of the two hand positions alone, so everything moves by one
script clock. Demonstrations differ in the ends of the motions, not in their timing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from thirdhand.contract.messages import SceneObject
from thirdhand_sim.scene import HAND_ORIENTATION, TOOL_ORIENTATION, Scene

Array = npt.NDArray[np.float64]

PAUSE_RAMP_S = 0.3  # duration of stopping in a pause, and of accelerating after it
TREMOR_HZ = (8.0, 10.0)  # physiological tremor of a resting hand
TREMOR_WAVES = 6
GRIP_AT = 0.88  # the gripper begins to move at this share of a motion, as the hands arrive
GRIP_S = 0.25  # duration of opening or closing
# [m] Deviation of the tool in the middle of each motion: over the hand, the bench, and the board.
TOOL_ARCS = ((0.0, 0.0, 0.03), (0.03, 0.0, 0.05), (0.0, 0.0, 0.04))


class PointMotion(NamedTuple):
    """Position [m], velocity [m/s] and acceleration [m/s²] of a point, each (3,)."""

    position: Array
    velocity: Array
    acceleration: Array


class HandMotions(NamedTuple):
    """The motions of both hands at one time, without tremor and noise."""

    left: PointMotion
    right: PointMotion


class TaskProgress(NamedTuple):
    """The progress of the task: the index of the event that is observed, 0 to 2 (None: none is),
    and the number of events that are over.
    """

    observed: int | None
    over: int


class ScriptPause(NamedTuple):
    """A pause of the script: the hands begin to slow at `at_s` and are at full speed again
    `lasts_s` later (at least 0.6 s).

    With a `depth` of 1 they stop. With a depth of 2 they move back at the same speed, and then
    forward again.
    """

    at_s: float
    lasts_s: float
    depth: float = 1.0


class Clock:
    """Script time against elapsed time: a speed factor, and pauses that begin and end smoothly."""

    def __init__(self, *, speed: float = 1.0, pauses: Sequence[ScriptPause] = ()) -> None:
        if not 0.05 <= speed <= 20.0:
            raise ValueError(f"speed {speed} given, 0.05 to 20 accepted")
        for pause in pauses:
            if pause.lasts_s < 2 * PAUSE_RAMP_S:
                raise ValueError(
                    f"a pause of {pause.lasts_s} s given, at least {2 * PAUSE_RAMP_S} s needed to "
                    "stop and start"
                )
            if not 0.0 < pause.depth <= 2.0:
                raise ValueError(
                    f"a pause of depth {pause.depth} given, above 0 (slower) to 2 (back as fast) "
                    "accepted"
                )
        ordered = sorted(pauses)
        for earlier, other in itertools.pairwise(ordered):
            if other.at_s < earlier.at_s + earlier.lasts_s:
                raise ValueError(f"pauses at {earlier.at_s} s and {other.at_s} s overlap")
        self.speed = speed
        self.pauses = tuple(ordered)

    def at(self, t: float) -> tuple[float, float, float]:
        """Script time [s], its rate and the rate's derivative [1/s] after `t` seconds."""
        lost = 0.0
        slow = 0.0
        slow_rate = 0.0
        for at_s, lasts_s, depth in self.pauses:
            stop, stop_rate, stop_area = _ramp((t - at_s) / PAUSE_RAMP_S)
            go, go_rate, go_area = _ramp((t - at_s - lasts_s) / PAUSE_RAMP_S + 1.0)
            lost += depth * PAUSE_RAMP_S * (stop_area - go_area)
            slow += depth * (stop - go)
            slow_rate += depth * (stop_rate - go_rate) / PAUSE_RAMP_S
        return self.speed * (t - lost), self.speed * (1.0 - slow), -self.speed * slow_rate

    def elapsed(self, script_s: float) -> float:
        """Time [s] at which the script reaches `script_s` for the last time."""
        low = 0.0
        high = script_s / self.speed + sum(p.depth * p.lasts_s for p in self.pauses)
        last = max((p.at_s + p.lasts_s for p in self.pauses), default=0.0)
        if last < high and self.at(last)[0] < script_s:
            low = last  # after the last pause, script time only grows
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.at(middle)[0] < script_s else (low, middle)
        return high


class Path:
    """A minimum-jerk motion from point to point with rests between, through arcs where given."""

    def __init__(
        self,
        points: Sequence[Array],
        segments: Sequence[tuple[float, float]],
        *,
        arcs: Sequence[Sequence[float]] = (),
    ) -> None:
        self._begins = [begin for begin, _ in segments]
        self._lasts = [end - begin for begin, end in segments]
        self._points = [np.asarray(point, dtype=np.float64) for point in points]
        self._arcs = [np.asarray(arc, dtype=np.float64) for arc in arcs] or [np.zeros(3)] * len(
            segments
        )

    def at(self, script_s: float, rate: float = 1.0, rate_change: float = 0.0) -> PointMotion:
        """The point's motion at a script time [s], for the time's rate and rate of change [1/s]."""
        i = max((k for k, begin in enumerate(self._begins) if script_s >= begin), default=0)
        lasts = self._lasts[i]
        u = min(max((script_s - self._begins[i]) / lasts, 0.0), 1.0)
        start = self._points[i]
        chord = self._points[i + 1] - self._points[i]
        arc = self._arcs[i]
        v = 1.0 - u
        share = u**3 * (10 - 15 * u + 6 * u * u)
        d_share = 30 * u * u * v * v
        dd_share = 60 * u * v * (v - u)
        bump = 64 * (u * v) ** 3
        d_bump = 192 * (u * v) ** 2 * (v - u)
        dd_bump = 384 * u * v * ((v - u) ** 2 - u * v)
        d = (d_share * chord + d_bump * arc) / lasts
        dd = (dd_share * chord + dd_bump * arc) / lasts**2
        return PointMotion(
            start + share * chord + bump * arc, d * rate, dd * rate * rate + d * rate_change
        )


class HandScript:
    """The user's two hands in one scene: they take the board, bring board and iron to the soldering
    place, and put the iron to the board.

    The ends of the motions have errors with standard deviation `offset_std` [m] per axis, drawn
    once from the seed. A tracker adds tremor and its own noise.
    """

    ready = True  # a script can begin at any time

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int,
        speed: float = 1.0,
        pauses: Sequence[ScriptPause] = (),
        offset_std: float = 0.008,
        tremor_rms: float = 0.0005,
        noise_std: float = 0.0005,
    ) -> None:
        self.scene = scene
        self.seed = seed
        self.clock = Clock(speed=speed, pauses=pauses)
        self.duration_s = self.clock.elapsed(scene.duration_s)
        ends, tremor, self._noise = (
            np.random.default_rng(s) for s in np.random.SeedSequence([seed, 0]).spawn(3)
        )
        left_start, handover, soldering, right_start, iron, final = (
            np.array(point) + offset_std * ends.standard_normal(3)
            for point in (
                scene.left_start,
                scene.handover,
                scene.soldering,
                scene.right_start,
                scene.iron,
                scene.right_final,
            )
        )
        self._left = Path([left_start, handover, soldering, soldering], scene.segments)
        self._right = Path([right_start, right_start, iron, final], scene.segments)
        self._noise_std = noise_std
        self._tremor_hz = tremor.uniform(*TREMOR_HZ, (TREMOR_WAVES, 6))
        self._tremor_phase = tremor.uniform(0.0, 2 * math.pi, (TREMOR_WAVES, 6))
        self._tremor_size = tremor_rms * math.sqrt(2.0 / TREMOR_WAVES)

    def begin(self) -> None:
        """Do nothing: a script depends on time alone."""

    def progress(self, t: float, reached: int) -> TaskProgress:
        """The progress at a time `t` [s]: each event is observed in the rest after its motion, the
        last one until the end, however many have been `reached`.
        """
        script_s = self.clock.at(t)[0]
        first, second, third = self.scene.dwells
        rests = (first, second, (third[0], math.inf))
        observed = (i for i, (begin, end) in enumerate(rests) if begin <= script_s <= end)
        return TaskProgress(next(observed, None), (script_s > first[1]) + (script_s > second[1]))

    def places(self) -> tuple[SceneObject, ...]:
        """No places: nobody has to find them in a viewer."""
        return ()

    def truth(self, t: float) -> HandMotions:
        """The motions of both hands at a time `t` [s] after the script's begin; at rest before and
        after the script.
        """
        now = self.clock.at(max(t, 0.0))
        return HandMotions(self._left.at(*now), self._right.at(*now))

    def sample(self, t: float) -> tuple[Array, Array]:
        """The tracked poses of the left and the right hand, (7,) each: x y z [m] and quaternion x y
        z w.

        Tremor is a function of `t`; each call draws new noise from the seed's sequence.
        """
        hands = self.truth(t)
        shake = self._tremor_size * np.sin(
            2 * math.pi * self._tremor_hz * t + self._tremor_phase
        ).sum(axis=0)
        shake += self._noise_std * self._noise.standard_normal(6)
        return (
            np.concatenate((hands.left.position + shake[:3], HAND_ORIENTATION)),
            np.concatenate((hands.right.position + shake[3:], HAND_ORIENTATION)),
        )


class Teacher:
    """The tool that a person leads in a demonstration, in phase with the hands of the same
    clock.
    """

    def __init__(
        self, scene: Scene, *, seed: int, clock: Clock | None = None, offset_std: float = 0.008
    ) -> None:
        ends = np.random.default_rng([seed, 1])
        points = [
            np.array(point) + offset_std * ends.standard_normal(3)
            for point in (scene.robot_start, scene.offer, scene.glass, scene.carry)
        ]
        self._clock = clock or Clock()
        self._path = Path(points, scene.segments, arcs=TOOL_ARCS)
        self._opens, self._closes = (
            begin + GRIP_AT * (end - begin) for begin, end in scene.segments[:2]
        )

    def truth(self, t: float) -> PointMotion:
        """The tool's motion at a time `t` [s] after the script's begin."""
        return self._path.at(*self._clock.at(max(t, 0.0)))

    def sample(self, t: float) -> Array:
        """The tool's pose (7,): x y z [m] and quaternion x y z w."""
        return np.concatenate((self.truth(t).position, TOOL_ORIENTATION))

    def closure(self, t: float) -> float:
        """Closure of the gripper, 0 open to 1 closed: it opens at the handover and closes at the
        glass.
        """
        script_s = self._clock.at(max(t, 0.0))[0]
        return (
            1.0
            - _ramp((script_s - self._opens) / GRIP_S)[0]
            + _ramp((script_s - self._closes) / GRIP_S)[0]
        )


def _ramp(u: float) -> tuple[float, float, float]:
    """A smooth step from 0 to 1 for u in [0, 1], its derivative and its integral from 0."""
    if u <= 0.0:
        return 0.0, 0.0, 0.0
    if u >= 1.0:
        return 1.0, 0.0, u - 0.5
    return u * u * (3 - 2 * u), 6 * u * (1 - u), u**3 - 0.5 * u**4
