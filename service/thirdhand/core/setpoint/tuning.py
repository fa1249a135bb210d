"""Tuned numbers of the setpoint.

docs/tuning.md has them as a table, with their measured sensitivity. The comment above one has the
range of sensible values, and what more and less of it are expected to do.
"""

from __future__ import annotations

from typing import NamedTuple


class SetpointTuning(NamedTuple):
    """Tuned numbers of the setpoint."""

    # The tracker: a linear-quadratic one, whose input is jerk.
    # 1e-9 to 1e-7. More: the setpoint follows calmly. Less: it follows faster, if joints can.
    jerk_weight: float = 2.8e-9  # [s⁶] weight of a squared jerk beside that of a squared distance
    # 0.5 to 2. More: the setpoint follows faster. Less: the joints follow calmly.
    # largest tracker rate / (jerk / acceleration); joints oscillate with a larger one
    tracker_rate_share: float = 1.1

    # Stopping where the hands would stop at the soonest.
    # 2 to 20. More: more lag, less overshoot. Less: less lag, more overshoot and jerk.
    # [m/s²] largest mean deceleration of a hand, from when it begins to brake
    hand_brake_mps2: float = 5.0
    # 0.03 to 0.3. More: ends of reaches are braked early. Less: stops are passed.
    deceleration_lookahead_s: float = 0.12  # predicted speed = speed + this * min(acceleration, 0)

    # A tool that falls behind.
    # 3e-3 to 0.05. More: a late tool is waited for less. Less: lags slow the setpoint.
    gap_slow_m: float = 0.012  # share of the speed = 1 / (1 + (gap - gap_free_m) / gap_slow_m)

    # Bounds around the last targets: docs/bounds.md has the proof.
    # 0.1 to 2. More: old targets stay in bounds. Less: the bounds follow closely.
    hull_time_s: float = 0.35  # the setpoint stays near the targets of this last time
    # 5e-3 to 0.1. More: more overshoot is possible. Less: the bounds brake the setpoint.
    # the setpoint may be this far outside of the box around those targets
    hull_margin_m: float = 0.03

    @property
    def gap_free_m(self) -> float:
        """A tool this far behind its setpoint does not slow it."""
        return self.gap_slow_m / 4.0

    @property
    def gap_waiting_m(self) -> float:
        """From here on a setpoint's target is moved closer: a ninth of its speed is left."""
        return self.gap_free_m + 8.0 * self.gap_slow_m

    @property
    def gap_stopped_m(self) -> float:
        """The setpoint stops at this distance from its tool."""
        return 2.0 * self.gap_waiting_m
