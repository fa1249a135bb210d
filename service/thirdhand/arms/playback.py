"""Playback of joint commands: smooth motion at a drive's own rate, also over an uneven network.

Commands are queued by tick number and played back with a delay that covers their jitter, by a cubic
through positions and velocities. The result passes the joints' limiter, so it holds the limits of
position, velocity, acceleration and jerk for any sequence of commands and losses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from statistics import fmean, median_low
from typing import NamedTuple, TypeAlias

import numpy as np

from kmp.compiled import compiled
from thirdhand.client import BRAKE_AFTER_S, Command, no_room_to_brake
from thirdhand.core.frame import Records, Vector, parameters
from thirdhand.core.intake.arm_samples import in_turn
from thirdhand.core.limiter.stage import Limited, Limiter
from thirdhand.settings.config import RATES_HZ, JointSettings

# a new sequence begins after this silence, or at a tick number this far from the last
REJOIN_AFTER_S = 0.1
# a new sequence must begin within this of the standing arm
REJOIN_RAD = 0.05
REJOIN_RADPS = 0.05
# a difference of stamps per tick outside shows that a clock was set
TICK_RANGE_S = (0.9 / RATES_HZ[1], 1.1 / RATES_HZ[0])
TICK_SAMPLES = 15  # the length of a tick is the mean over these samples
TICK_OUTLIER = 0.1  # samples that differ from their median by a larger share are left out
# with a longer delay the arm would brake before the newest command is played
MAX_DELAY_S = BRAKE_AFTER_S
POSITION_GAIN_HZ = 8.0  # velocity += 8 / s * position error
MAX_CORRECTION_RADPS = 0.25  # limit of that correction, for the error after a pause
VELOCITY_GAIN = 30.0  # [1/s] max. gain: acceleration += gain * velocity error
# gain <= sqrt(max. jerk / 1 rad/s): an error below 1 rad/s is corrected within the jerk limit
SETTLED_RADPS = 1.0
JERK_SHARE = 0.999  # share of the jerk limit that is used, because of rounding
CATCH_UP_S = 0.1  # the delay approaches the needed delay with this time constant
MAX_CATCH_UP_SHARE = 0.05  # approaching it changes the speed by at most this share
DELAY_DECAY = 0.005  # [s/s] the delay shrinks at this rate while commands arrive evenly
MAX_ELAPSED_S = 0.1  # a longer time between two steps is a clock that was set, and is ignored
CLOCK_SHARE = 0.02  # each step makes up this share of the loop's lateness
# a larger lateness is a pause of the loop, made up at once: it shows nothing about the network
LOOP_PAUSE_S = 0.005
EXTRAPOLATED_S = 0.004  # beyond the newest command the acceleration is held for this time
MIN_TIMED_RADPS = 0.01  # a slower motion does not show its duration
LIMIT_TOLERANCE = 1e-6  # [rad, rad/s] commands may exceed limits by rounding

SpeedLimits: TypeAlias = Callable[[Vector, Vector], tuple[Vector, Vector]]
"""Lowest and highest velocity (J,) [rad/s] of joints at a position and velocity (J,)."""


class Knot(NamedTuple):
    """A command in the queue; `time_s` is its time in the motion, which does not advance while a
    daemon misses its deadlines.
    """

    tick: int
    time_s: float
    values: Vector  # (2, J): position, velocity [rad, rad/s]


class Playback:
    """The motion of a drive in each of its periods, given the commands that arrived.

    `limits` are the drive's limits of position, velocity, acceleration and jerk; `speed_limits` may
    be lower, depending on the position. `period_s` is the drive's period, `position` (J,) [rad] the
    position at rest. The commands' period is measured, as the difference of their stamps per tick.
    The playback reads no clock, so a clock that is set does not disturb it.
    """

    def __init__(
        self,
        limits: JointSettings,
        position: Sequence[float] | Vector,
        *,
        period_s: float,
        speed_limits: SpeedLimits | None = None,
    ) -> None:
        # number of refused commands, and the reason of the last one
        self.refused = 0
        self.reason = ""
        self.tick_s = 0.0  # measured period of the commands; 0: not known yet
        self._period_s = period_s
        self._speed_limits = speed_limits
        self._limits = limits
        self._lower = np.array(limits.lower)
        self._upper = np.array(limits.upper)
        self._max_velocity = np.array(limits.velocity)
        max_jerk = np.array(limits.jerk)
        self._parameters = parameters(
            period_s=period_s,
            max_acceleration=np.array(limits.acceleration),
            # [rad/s²] change of acceleration in a period
            max_change=JERK_SHARE * period_s * max_jerk,
            velocity_gain=np.minimum(VELOCITY_GAIN, np.sqrt(max_jerk / SETTLED_RADPS)),
        )
        self._limiter = Limiter(limits, period_s)
        self._state = np.zeros((3, len(limits.names)))  # written position, velocity, acceleration
        self._state[0] = position
        self._knots: deque[Knot] = deque()
        self._newest: Knot | None = None  # newest command of the present sequence
        self._newest_stamp_ns = 0
        # lengths of ticks in the present sequence
        self._lengths_s: deque[float] = deque(maxlen=TICK_SAMPLES)
        # [s] time by counting steps, and the time at which the newest command arrived
        self._now = self._heard = 0.0
        self._lateness_s = 0.0  # time of the drive's clock that is not made up yet
        # [s] present and needed delay from the motion's time to the time of writing
        self._offset = self._needed = 0.0
        self._paused = False  # True if the loop paused before this step

        # compiles both ways of moving: a period has no time for that
        knots = Knot(0, 0.0, self._state[:2]), Knot(1, period_s, self._state[:2])
        self._knots.extend(knots)
        self._moved()
        self._knots.clear()
        self._moved()
        self._offset = self._needed = 0.0

    @property
    def following(self) -> bool:
        """True while commands are played back; else the arm brakes or stands."""
        return len(self._knots) > 1

    @property
    def too_slow(self) -> str:
        """A message if commands arrive too slowly to be followed; empty also after too few
        commands.
        """
        return no_room_to_brake(self.tick_s) if len(self._lengths_s) == TICK_SAMPLES else ""

    @property
    def delay_ticks(self) -> float:
        """Delay of the arm [ticks] behind the newest command at its arrival."""
        if self._newest is None or not self.tick_s:
            return 0.0
        return (self._newest.time_s + self._offset - self._heard) / self.tick_s

    def in_turn(self, position: Sequence[float] | Vector) -> Vector:
        """Measured joints (J,) [rad], continuous ones in the commanded turn, because a drive may
        wrap them at ±pi.
        """
        return in_turn(self._limits, np.array(position), self._state[0])

    def step(
        self,
        commands: Iterable[Command] = (),
        *,
        measured: Sequence[float] | Vector | None = None,
        elapsed_s: float = -1.0,
    ) -> Limited:
        """Position, velocity and acceleration (J,) [rad, rad/s, rad/s²] at the end of this period,
        given the commands that arrived since the last step.

        `measured` (J,) [rad] closes the loop over a drive that follows velocities. `elapsed_s` is
        the time since the last step, for a loop that is not punctual; without it, one period.
        """
        if measured is not None:
            self._state[0] = self.in_turn(measured)

        if 0.0 <= elapsed_s <= MAX_ELAPSED_S:
            self._lateness_s += elapsed_s - self._period_s
        self._paused = self._lateness_s > LOOP_PAUSE_S
        most = 0.1 * self._period_s
        made_up = (
            self._lateness_s
            if self._paused
            else min(max(CLOCK_SHARE * self._lateness_s, -most), most)
        )
        self._lateness_s -= made_up
        self._now += self._period_s + made_up

        for command in commands:
            if reason := self._take(command):
                self.refused = self.refused + 1
                self.reason = reason
        if self._paused and self._newest is not None and self._heard == self._now:
            self._needed = max(self._needed, self._now - self._newest.time_s)
        if self._now - self._heard > BRAKE_AFTER_S:
            self._knots.clear()

        moved = self._moved()
        self._state = np.stack(moved[:3])
        return moved

    def _moved(self) -> Limited:
        """The joints one period later."""
        q, dq, ddq = self._state
        return (
            self._limiter.step(q, dq, ddq, self._wanted())
            if self.following
            else self._limiter.stop(q, dq, ddq)
        )

    def _take(self, command: Command) -> str:
        """Queue a command; returns the reason if it is refused, else an empty text."""
        position = np.array(command.position)
        velocity = np.array(command.velocity)
        last = self._newest
        tick = command.tick if command.tick >= 0 or last is None else last.tick + 1
        ticks = 0 if last is None else tick - last.tick
        if reason := self._mistake(position, velocity):
            return reason

        if last is None or max(self._now - self._heard, abs(ticks) * self.tick_s) > REJOIN_AFTER_S:
            if reason := self._begin_sequence(position, velocity):
                return reason
            time_s = self._now
        elif ticks <= 0:
            return ""  # a late or repeated command is ignored
        else:
            if reason := self._measure_tick(last, position, command.stamp_ns, ticks):
                return reason
            time_s = last.time_s + self.tick_s * _steps(
                last, position, velocity, ticks, self.tick_s
            )

        self._update_needed_delay(time_s)
        self._newest = Knot(tick, time_s, np.stack((position, velocity)))
        self._heard = self._now
        self._newest_stamp_ns = command.stamp_ns
        if reason := no_room_to_brake(self.tick_s):
            self._knots.clear()
            return reason
        self._knots.append(self._newest)
        return ""

    def _mistake(self, position: Vector, velocity: Vector) -> str:
        """The reason why no arm could follow these joints (J,) [rad, rad/s]; empty: it could."""
        arm_position = self._state[0]
        if not position.shape == velocity.shape == arm_position.shape:
            return f"{len(position)} joints, {len(arm_position)} needed"
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            return "a joint that is not finite"
        outside = np.maximum(
            np.minimum(self._lower, arm_position) - position,
            position - np.maximum(self._upper, arm_position),
        )
        joint = outside.argmax()
        if outside[joint] > LIMIT_TOLERANCE:
            return f"joint {joint + 1} outside its limits: {position[joint]:.3f} rad"
        fast = np.abs(velocity) - self._max_velocity
        joint = fast.argmax()
        if fast[joint] > LIMIT_TOLERANCE:
            return f"joint {joint + 1} faster than its limit: {velocity[joint]:.3f} rad/s"
        return ""

    def _begin_sequence(self, position: Vector, velocity: Vector) -> str:
        """Begin a new sequence of commands where the arm stands; else return the reason."""
        deviations = np.abs(position - self._state[0]) / np.array(self._limits.per_rad)
        is_moving = self._state[1:].any() or np.abs(velocity).max() > REJOIN_RADPS
        if is_moving or deviations.max() > REJOIN_RAD:
            return (
                "a new sequence that does not begin where the arm stands: "
                f"{deviations.max():.3f} rad off, or moving"
            )
        self._knots.clear()
        self._lengths_s.clear()
        return ""

    def _measure_tick(self, last: Knot, position: Vector, stamp_ns: int, ticks: int) -> str:
        """Measure the length of a tick by a command that is stamped `ticks` after the last one; if
        it does not fit that one, return the reason.
        """
        lengths_s = self._lengths_s.copy()
        since_s = (stamp_ns - self._newest_stamp_ns) * 1e-9
        if TICK_RANGE_S[0] <= since_s / ticks <= TICK_RANGE_S[1]:
            lengths_s.append(since_s / ticks)
        tick_s = _mean_length(lengths_s) if lengths_s else self.tick_s
        if not tick_s:
            return (
                f"no length of a tick: stamped {1000 * since_s:.3g} ms and {ticks} ticks after "
                f"the command before, {1000 / RATES_HZ[1]:g} to {1000 / RATES_HZ[0]:g} ms a "
                "tick needed"
            )
        range_rad = self._max_velocity * ticks * tick_s + LIMIT_TOLERANCE
        if (np.abs(position - last.values[0]) > range_rad).any():
            return "a jump from the command before"
        self.tick_s = tick_s
        self._lengths_s = lengths_s
        return ""

    def _update_needed_delay(self, time_s: float) -> None:
        """Update the needed delay by a command for this time of the motion [s], which arrives now.
        The curve to it is known only now, but was needed at its begin.
        """
        if not self._knots:
            self._needed = self._offset = self._now - time_s
            return
        latest = self._now - time_s + MAX_DELAY_S
        begins_s = self._knots[-1].time_s
        # a single lost command does not increase the delay
        if time_s - begins_s < 2.5 * self.tick_s:
            begins_s = time_s - self.tick_s
        needed = self._needed if self._paused else self._now - begins_s
        self._needed = min(max(self._needed, needed), latest)
        self._offset = min(self._offset, latest)

    def _wanted(self) -> Vector:
        """Target velocities (J,) [rad/s] for this period."""
        slower = min(
            max((self._needed - self._offset) / CATCH_UP_S, -MAX_CATCH_UP_SHARE), MAX_CATCH_UP_SHARE
        )
        self._offset += slower * self._period_s
        self._needed -= DELAY_DECAY * self._period_s

        playhead_s = self._now - self._offset
        while len(self._knots) > 2 and self._knots[1].time_s <= playhead_s:
            self._knots.popleft()
        first = self._knots[0]
        second = self._knots[1]
        span = np.array((first.time_s, second.time_s, playhead_s, slower))
        velocities: Vector = np.empty_like(self._state[1])
        _aim(self._state, first.values, second.values, span, self._parameters, velocities)
        if self._speed_limits is not None:
            velocities = np.clip(velocities, *self._speed_limits(self._state[0], self._state[1]))
        return velocities


def _mean_length(lengths: deque[float]) -> float:
    """The mean of lengths without outliers."""
    middle = median_low(lengths)
    return fmean(length for length in lengths if abs(length - middle) <= TICK_OUTLIER * middle)


def _steps(last: Knot, position: Vector, velocity: Vector, ticks: int, tick_s: float) -> float:
    """Number of ticks by which the motion advanced since the last command, from its distance and
    mean velocity. It is less than the difference of tick numbers if deadlines were missed.
    """
    mean = 0.5 * (last.values[1] + velocity)
    if ticks == 1 or np.abs(mean).max() < MIN_TIMED_RADPS:
        return float(ticks)
    return float(np.clip((position - last.values[0]) @ mean / (mean @ mean * tick_s), 1.0, ticks))


@compiled
def _aim(
    state: Vector, first: Vector, second: Vector, span: Vector, parameters: Records, wanted: Vector
) -> None:
    """Write into `wanted` (J,) [rad/s] the joints' target velocities after this period.

    The target moves on the cubic Hermite curve between two commands (2, J): with u = t / T, the
    velocities v0 T, v1 T scaled by the duration T and the distance d,

        p = p0 + u (v0 T + u (3 d - 2 v0 T - v1 T + u (v0 T + v1 T - 2 d))).

    Beyond the commands it continues at constant acceleration for EXTRAPOLATED_S, then at constant
    velocity. Errors of position and velocity are fed back by POSITION_GAIN_HZ and VELOCITY_GAIN.

    span (4,): times [s] of both commands and of the playhead, and the relative slowing of the
    playhead.
    """
    config = parameters[0]
    lasts_s = span[1] - span[0]
    playhead_s = span[2] - span[0]
    inside_s = min(max(playhead_s, 0.0), lasts_s)
    beyond_s = playhead_s - inside_s
    u = inside_s / lasts_s
    held_s = min(max(beyond_s, -EXTRAPOLATED_S), EXTRAPOLATED_S)
    for i in range(len(wanted)):
        begin = lasts_s * first[1, i]
        end = lasts_s * second[1, i]
        distance = second[0, i] - first[0, i]
        bend = 3.0 * distance - 2.0 * begin - end
        twist = begin + end - 2.0 * distance
        position = first[0, i] + u * (begin + u * (bend + u * twist))
        velocity = (begin + u * (2.0 * bend + u * 3.0 * twist)) / lasts_s
        acceleration = (2.0 * bend + u * 6.0 * twist) / lasts_s**2
        position += beyond_s * velocity + held_s * (beyond_s - 0.5 * held_s) * acceleration
        velocity = (velocity + held_s * acceleration) * (1.0 - span[3])

        if held_s != beyond_s:
            acceleration = 0.0
        error = position - state[0, i] - velocity * config.period_s
        velocity += min(max(POSITION_GAIN_HZ * error, -MAX_CORRECTION_RADPS), MAX_CORRECTION_RADPS)
        acceleration += config.velocity_gain[i] * (
            velocity - acceleration * config.period_s - state[1, i]
        )
        change = min(max(acceleration - state[2, i], -config.max_change[i]), config.max_change[i])
        acceleration = min(
            max(state[2, i] + change, -config.max_acceleration[i]), config.max_acceleration[i]
        )
        wanted[i] = state[1, i] + config.period_s * acceleration
