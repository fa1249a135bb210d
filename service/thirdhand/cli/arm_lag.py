"""The lag of an arm behind its commands, by least squares from both streams of joint positions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from thirdhand.core.frame import Vector

LAG_RANGE_S = (-0.02, 0.5)  # lags that are searched; commands arrive up to one period late
LAG_STEPS_S = (0.004, 0.0002)  # coarse and fine step of the search
LAG_TRAVEL_RAD = 0.03  # a joint shows the lag once it was commanded to travel this far
# standard deviation of the commands that are compared; below it they show no lag
LEAST_SPREAD_RAD = 0.003
LAG_STD_S = 0.003  # largest standard deviation of a lag that is reported
MAX_RESIDUAL_SHARE = 0.2  # largest error that remains / standard deviation of the commands
MAX_COMMAND_GAP_S = 0.05  # states are not compared where commands paused for longer
LEAST_STATES = 20  # of a joint, and as many commands

Samples = Sequence[tuple[float, float]]  # arrival [s] and position [rad] of one joint


class Lag(NamedTuple):
    """A measured lag and its standard deviation [s], the error that remains with it [rad], and that
    error as a share of the commands' standard deviation.
    """

    lag_s: float
    std_s: float
    error_rad: float
    residual_share: float


def lag(commanded: Mapping[str, Samples], measured: Mapping[str, Samples]) -> Lag | None:
    """The lag tau of an arm: the least squares of q(t) - c(t - tau) - b over all moving joints.

    q are measured and c commanded positions, by arrival, and b is an offset of each joint. Its
    standard deviation is that of the residual divided by the root of the sum of squared commanded
    velocities. None if the arm moved too little to measure the lag, or does not follow its commands
    alone: a braking arm, or a machine so busy that messages arrive in heaps.
    """
    pairs = [
        (*_columns(commanded[name]), *_columns(states))
        for name, states in measured.items()
        if name in commanded
        and len(states) >= LEAST_STATES
        and len(commanded[name]) >= LEAST_STATES
    ]
    moving = [pair for pair in pairs if np.ptp(pair[1]) > LAG_TRAVEL_RAD]
    estimate: Lag | None = None
    low, high = LAG_RANGE_S
    for step_s in LAG_STEPS_S if moving else ():
        candidates = [_at(float(tau), moving) for tau in np.arange(low, high + step_s / 2, step_s)]
        estimate = min(candidates, key=lambda one: one.error_rad)
        low = estimate.lag_s - step_s
        high = estimate.lag_s + step_s
    if (
        estimate is None
        or estimate.std_s > LAG_STD_S
        or estimate.residual_share > MAX_RESIDUAL_SHARE
    ):
        return None
    return estimate if LAG_RANGE_S[0] < estimate.lag_s < LAG_RANGE_S[1] else None


def _columns(samples: Samples) -> tuple[Vector, Vector]:
    """Times [s] and unwrapped positions [rad]: a continuous joint may wrap at pi."""
    times, positions = np.array(samples).T
    later = np.diff(times, prepend=-np.inf) > 0.0
    return times[later], np.unwrap(positions[later])


def _at(lag_s: float, joints: Sequence[tuple[Vector, Vector, Vector, Vector]]) -> Lag:
    """An assumed lag [s] and the error that remains with it. The states within the range of all
    lags are compared, so that each lag is judged by the same ones.
    """
    squares = 0.0
    speeds = 0.0
    spread = 0.0
    count = 0
    for command_times, commands, times, positions in joints:
        inside = (times - LAG_RANGE_S[1] >= command_times[0]) & (
            times - LAG_RANGE_S[0] <= command_times[-1]
        )
        after = np.clip(np.searchsorted(command_times, times), 1, len(command_times) - 1)
        inside &= command_times[after] - command_times[after - 1] < MAX_COMMAND_GAP_S

        delayed_times = times[inside] - lag_s
        if len(delayed_times) < LEAST_STATES:
            continue
        expected = np.interp(delayed_times, command_times, commands)
        residual = positions[inside] - expected
        squares += float(np.sum((residual - residual.mean()) ** 2))
        spread += float(np.sum((expected - expected.mean()) ** 2))
        velocity = np.interp(delayed_times, command_times, np.gradient(commands, command_times))
        speeds += float(np.sum((velocity - velocity.mean()) ** 2))
        count += len(delayed_times)
    # the motion was outside of the compared times
    if not speeds or spread < count * LEAST_SPREAD_RAD**2:
        return Lag(lag_s, math.inf, math.inf, math.inf)
    error = math.sqrt(squares / count)
    return Lag(lag_s, error / math.sqrt(speeds), error, math.sqrt(squares / spread))
