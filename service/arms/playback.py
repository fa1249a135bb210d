"""Playback of joint commands: smooth motion at a drive's own rate, whatever a network made of them.

Commands are queued by tick number and played back a little later: by a cubic through positions and
velocities, as much behind as they come unevenly. What is written passes the joints' limiter, so it
holds position, velocity, acceleration and jerk limits for any sequence of commands and losses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from statistics import fmean, median_low
from typing import NamedTuple, TypeAlias

import numpy as np

from kmp.compiled import compiled
from service.client import BRAKE_AFTER_S, Command, no_room_to_brake
from service.core.frame import Records, Vector, parameters
from service.core.intake.arm_samples import in_turn
from service.core.limiter.stage import Limited, Limiter
from service.settings.config import RATES_HZ, JointSettings

REJOIN_AFTER_S = 0.1  # a new sequence begins after this silence, or with a tick number this far from the last
REJOIN_RAD, REJOIN_RADPS = 0.05, 0.05  # a new sequence must begin this near to where the arm stands
TICK_RANGE_S = 0.9 / RATES_HZ[1], 1.1 / RATES_HZ[0]  # stamps farther or less apart per tick: a clock was set
TICK_SAMPLES = 15  # the length of a tick is the mean over these samples
TICK_OUTLIER = 0.1  # samples that differ from their median by a larger share are left out
MOST_DELAY_S = BRAKE_AFTER_S  # behind the newest command: beyond it the arm brakes all the same
FEEDBACK = 8.0  # [1/s] of a position error that becomes velocity ...
MOST_FEEDBACK_RADPS = 0.25  # ... and not more, as after a pause
DAMPING = 30.0  # [1/s] of a velocity error that becomes acceleration, at most ...
SETTLED_RADPS = 1.0  # ... and where this much of it needs no more jerk than there is
JERK_SHARE = 0.999  # of the greatest: rounding
CATCH_UP_S, MOST_CATCH_UP = 0.1, 0.05  # in which the delay becomes as needed; share of the speed that it may cost
FORGET = 0.005  # [s/s] by which the delay shrinks while commands come evenly
MOST_ELAPSED_S = 0.1  # between two steps; what is longer was a clock that stepped
CLOCK_SHARE = 0.02  # of the time that a loop is off, made up each step ...
PAUSE_S = 0.005  # ... and all of it after a pause, which tells nothing of the network
HELD_S = 0.004  # an acceleration, beyond the newest command
SLOW_RADPS = 0.01  # a slower motion does not tell how long it took
TOLERANCE = 1e-6  # of limits [rad, rad/s]: rounding of who commands

SpeedLimits: TypeAlias = Callable[[Vector, Vector], tuple[Vector, Vector]]
"""Least and greatest velocity (J,) [rad/s] of joints at a position and velocity (J,)."""


class Knot(NamedTuple):
    """A command in the queue; `time_s` is when in the motion it is, which stands still while a
    daemon misses its deadlines.
    """

    tick: int
    time_s: float
    values: Vector  # (2, J): position, velocity [rad, rad/s]


class Playback:
    """What a drive is to do in each of its periods, given the commands that came.

    `limits` are the drive's, of acceleration and jerk as well; an arm may be allowed less where it
    stands: `speed_limits`. `period_s` is the drive's, `position` (J,) [rad] where the arm stands at
    rest. The commands' period is measured: it is the difference of their stamps per tick. Nothing
    here reads a clock, so none can step.
    """

    def __init__(
        self,
        limits: JointSettings,
        position: Sequence[float] | Vector,
        *,
        period_s: float,
        speed_limits: SpeedLimits | None = None,
    ) -> None:
        self.refused, self.reason = 0, ""  # commands that were not followed, and why the last one was not
        self.tick_s = 0.0  # of the commands, as measured; 0: not known yet
        self._period_s, self._speed_limits, self._limits = period_s, speed_limits, limits
        self._lower, self._upper = np.array(limits.lower), np.array(limits.upper)
        self._max_velocity, max_jerk = np.array(limits.velocity), np.array(limits.jerk)
        self._parameters = parameters(
            period_s=period_s,
            max_acceleration=np.array(limits.acceleration),
            most_change=JERK_SHARE * period_s * max_jerk,  # [rad/s²] in a period
            damping=np.minimum(DAMPING, np.sqrt(max_jerk / SETTLED_RADPS)),
        )
        self._limiter = Limiter(limits, period_s)
        self._state = np.zeros((3, len(limits.names)))  # as written: position, velocity, acceleration
        self._state[0] = position
        self._knots: deque[Knot] = deque()
        self._newest: Knot | None = None  # of the sequence in force
        self._newest_stamp_ns = 0
        self._lengths_s: deque[float] = deque(maxlen=TICK_SAMPLES)  # of ticks, in the sequence in force
        self._now = self._heard = self._owed = 0.0  # [s] counted in steps; when the newest came; off the drive's clock
        self._offset = self._needed = 0.0
        here = Knot(0, 0.0, self._state[:2]), Knot(1, period_s, self._state[:2])
        self._knots.extend(here)
        self._moved()  # compiled now: there is no time for it in a period
        self._knots.clear()
        self._moved()
        self._paused = False  # the loop, before this step
        self._offset = self._needed = 0.0  # [s] from the motion's time to the time when it is written

    @property
    def following(self) -> bool:
        """Whether commands are played back; else the arm brakes, or stands."""
        return len(self._knots) > 1

    @property
    def too_slow(self) -> str:
        """Why commands come too slowly to be followed; empty where they do not, or too few came."""
        return no_room_to_brake(self.tick_s) if len(self._lengths_s) == TICK_SAMPLES else ""

    @property
    def delay_ticks(self) -> float:
        """How many ticks behind the newest command the arm is led, when that comes."""
        if self._newest is None or not self.tick_s:
            return 0.0
        return (self._newest.time_s + self._offset - self._heard) / self.tick_s

    def in_turn(self, position: Sequence[float] | Vector) -> Vector:
        """Measured joints (J,) [rad], the continuous ones in the turn in which they are led, as a
        drive may wrap them at ±pi.
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
        after what came since the last.

        `measured` (J,) [rad] closes the loop over a drive that takes velocities. `elapsed_s` since
        the last step keeps the pace of a loop that is not punctual; else each is one period.
        """
        if measured is not None:
            self._state[0] = self.in_turn(measured)
        if 0.0 <= elapsed_s <= MOST_ELAPSED_S:
            self._owed += elapsed_s - self._period_s
        self._paused = self._owed > PAUSE_S
        most = 0.1 * self._period_s
        made_up = self._owed if self._paused else min(max(CLOCK_SHARE * self._owed, -most), most)
        self._owed -= made_up
        self._now += self._period_s + made_up
        for command in commands:
            if reason := self._take(command):
                self.refused, self.reason = self.refused + 1, reason
        if self._paused and self._newest is not None and self._heard == self._now:
            self._needed = max(self._needed, self._now - self._newest.time_s)
        if self._now - self._heard > BRAKE_AFTER_S:
            self._knots.clear()
        moved = self._moved()
        self._state = np.stack(moved[:3])
        return moved

    def _moved(self) -> Limited:
        """The joints a period later."""
        q, dq, ddq = self._state
        return self._limiter.step(q, dq, ddq, self._wanted()) if self.following else self._limiter.stop(q, dq, ddq)

    def _take(self, command: Command) -> str:
        """Queues a command; why not, if it is not to be followed."""
        position, velocity = np.array(command.position), np.array(command.velocity)
        at, last = self._state[0], self._newest
        if not position.shape == velocity.shape == at.shape:
            return f"{len(command.position)} joints, {len(at)} needed"
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            return "a joint that is not finite"
        outside = np.maximum(np.minimum(self._lower, at) - position, position - np.maximum(self._upper, at))
        if outside.max() > TOLERANCE:
            return f"joint {outside.argmax() + 1} outside its limits: {position[outside.argmax()]:.3f} rad"
        if (fast := np.abs(velocity) - self._max_velocity).max() > TOLERANCE:
            return f"joint {fast.argmax() + 1} faster than its limit: {velocity[fast.argmax()]:.3f} rad/s"
        tick = command.tick if command.tick >= 0 or last is None else last.tick + 1
        ticks = 0 if last is None else tick - last.tick
        if last is None or max(self._now - self._heard, abs(ticks) * self.tick_s) > REJOIN_AFTER_S:
            off = (np.abs(position - at) / np.array(self._limits.per_rad)).max()
            if self._state[1:].any() or off > REJOIN_RAD or np.abs(velocity).max() > REJOIN_RADPS:
                return f"a new sequence that does not begin where the arm stands: {off:.3f} rad off, or moving"
            self._knots.clear()
            self._lengths_s.clear()
            time_s = self._now
        elif ticks <= 0:
            return ""  # late or twice: the cubic goes on without it
        else:
            lengths_s, since_s = self._lengths_s.copy(), (command.stamp_ns - self._newest_stamp_ns) * 1e-9
            if TICK_RANGE_S[0] <= since_s / ticks <= TICK_RANGE_S[1]:
                lengths_s.append(since_s / ticks)
            if not (tick_s := _mean_length(lengths_s) if lengths_s else self.tick_s):
                return (
                    f"no length of a tick: stamped {1000 * since_s:.3g} ms and {ticks} ticks after the command before, "
                    f"{1000 / RATES_HZ[1]:g} to {1000 / RATES_HZ[0]:g} ms a tick needed"
                )
            if (np.abs(position - last.values[0]) > self._max_velocity * ticks * tick_s + TOLERANCE).any():
                return "a jump from the command before"
            self.tick_s, self._lengths_s = tick_s, lengths_s
            time_s = last.time_s + tick_s * _steps(last, position, velocity, ticks, tick_s)
        latest = self._now - time_s + MOST_DELAY_S
        if self._knots:  # a segment is of use from now on, and should have been when it began
            begins_s = self._knots[-1].time_s
            if time_s - begins_s < 2.5 * self.tick_s:  # one that was lost alone is not waited for
                begins_s = time_s - self.tick_s
            needed = self._needed if self._paused else self._now - begins_s
            self._needed = min(max(self._needed, needed), latest)
            self._offset = min(self._offset, latest)
        else:
            self._needed = self._offset = self._now - time_s
        self._newest, self._heard = Knot(tick, time_s, np.stack((position, velocity))), self._now
        self._newest_stamp_ns = command.stamp_ns
        if reason := no_room_to_brake(self.tick_s):
            self._knots.clear()
            return reason
        self._knots.append(self._newest)
        return ""

    def _wanted(self) -> Vector:
        """The velocities (J,) [rad/s] for this period."""
        slower = min(max((self._needed - self._offset) / CATCH_UP_S, -MOST_CATCH_UP), MOST_CATCH_UP)
        self._offset += slower * self._period_s
        self._needed -= FORGET * self._period_s
        playhead_s = self._now - self._offset
        while len(self._knots) > 2 and self._knots[1].time_s <= playhead_s:
            self._knots.popleft()
        one, other = self._knots[0], self._knots[1]
        span = np.array((one.time_s, other.time_s, playhead_s, slower))
        wanted: Vector = np.empty_like(self._state[1])
        _aim(self._state, one.values, other.values, span, self._parameters, wanted)
        if self._speed_limits is not None:
            wanted = np.clip(wanted, *self._speed_limits(self._state[0], self._state[1]))
        return wanted


def _mean_length(lengths: deque[float]) -> float:
    """The mean of lengths without outliers."""
    middle = median_low(lengths)
    return fmean(one for one in lengths if abs(one - middle) <= TICK_OUTLIER * middle)


def _steps(last: Knot, position: Vector, velocity: Vector, ticks: int, tick_s: float) -> float:
    """How many ticks the motion has gone on since the last command, by how far it came: fewer than
    tick numbers say where these jumped over deadlines that were missed.
    """
    mean = 0.5 * (last.values[1] + velocity)
    if ticks == 1 or np.abs(mean).max() < SLOW_RADPS:
        return float(ticks)
    return float(np.clip((position - last.values[0]) @ mean / (mean @ mean * tick_s), 1.0, ticks))


@compiled
def _aim(state: Vector, one: Vector, other: Vector, span: Vector, parameters: Records, wanted: Vector) -> None:
    """Into `wanted` (J,) [rad/s] the joints' velocities after this period, on their way to where
    the cubic between two commands (2, J) is then. Beyond these it goes on at constant acceleration
    for HELD_S, then at constant velocity.

    span (4,): times [s] of both commands and of the playhead, and the share by which that is slow.
    """
    given = parameters[0]
    lasts_s, playhead_s = span[1] - span[0], span[2] - span[0]
    inside_s = min(max(playhead_s, 0.0), lasts_s)
    beyond_s, u = playhead_s - inside_s, inside_s / lasts_s
    held_s = min(max(beyond_s, -HELD_S), HELD_S)
    for i in range(len(wanted)):
        begin, end, way = lasts_s * one[1, i], lasts_s * other[1, i], other[0, i] - one[0, i]
        bend, twist = 3.0 * way - 2.0 * begin - end, begin + end - 2.0 * way
        position = one[0, i] + u * (begin + u * (bend + u * twist))
        velocity = (begin + u * (2.0 * bend + u * 3.0 * twist)) / lasts_s
        acceleration = (2.0 * bend + u * 6.0 * twist) / lasts_s**2
        position += beyond_s * velocity + held_s * (beyond_s - 0.5 * held_s) * acceleration
        velocity = (velocity + held_s * acceleration) * (1.0 - span[3])
        if held_s != beyond_s:
            acceleration = 0.0
        error = position - state[0, i] - velocity * given.period_s
        velocity += min(max(FEEDBACK * error, -MOST_FEEDBACK_RADPS), MOST_FEEDBACK_RADPS)
        acceleration += given.damping[i] * (velocity - acceleration * given.period_s - state[1, i])
        change = min(max(acceleration - state[2, i], -given.most_change[i]), given.most_change[i])
        acceleration = min(max(state[2, i] + change, -given.max_acceleration[i]), given.max_acceleration[i])
        wanted[i] = state[1, i] + given.period_s * acceleration
