"""Tuned numbers of the intake and of the hand filter.

docs/tuning.md has them as a table, with their measured sensitivity. The comment above one has the
range of sensible values, and what more and less of it are expected to do.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from thirdhand.core.frame import Vector

Modes: TypeAlias = tuple[float, float, float, float]
"""A number for each mode of the hand filter: rest, steady, reach, change."""


class IntakeTuning(NamedTuple):
    """Tuned numbers of the intake and of the hand filter."""

    # 2 to 5. More: noise and outliers are trusted. Less: ordinary noise counts as an outlier.
    # what differs by more than this number of standard deviations is an outlier
    outlier_stds: float = 3.0

    # 0.4 to 0.95. More: holds end sooner. Less: holds last longer, but do not flicker.
    # a hold for a measured reason lasts until its measure is below this share of the threshold
    end_share: float = 0.8

    # The hand filter's modes: rest, steady, reach, change.
    # 0.05 to 0.8. More: a mode is entered more often. Less: a mode is entered less often.
    # probabilities before anything is known, and after a switch
    mode_prior: Modes = (0.3, 0.1, 0.4, 0.2)
    # 0.01 to 10. More: changes are seen sooner. Less: estimates are smoother.
    # [1/s] rates at which the mode is drawn anew; low in rest
    mode_switch_rates_per_s: Modes = (0.03, 1.0, 3.0, 3.0)
    # 1e-7 to 100. More: the estimate follows faster. Less: noise is reduced more.
    # [m²/s⁵] intensity of the white jerk
    mode_intensities_m2ps5: Modes = (1e-6, 3e-3, 1.0, 30.0)
    # 3 to 40. More: accelerations end sooner. Less: accelerations last longer.
    # [1/s] decay of the acceleration
    mode_acceleration_reversions_per_s: Modes = (10.0, 10.0, 14.0, 14.0)
    # 0 to 300. More: motions are expected to end sooner. Less: motions are expected to go on.
    # [1/s²] low in rest, where drift goes on, and 0 in steady motion; reaches end
    mode_velocity_reversions_per_s2: Modes = (0.3, 0.0, 95.0, 95.0)
    # 0 to 2e-3. More: more motion counts as tremor. Less: more tremor reaches the estimate.
    # standard deviation on each axis; larger tremor has the same frequency
    tremor_stds_m: Modes = (5e-4, 5e-4, 3e-4, 0.0)
    # 40 to 90. More: faster tremor is removed. Less: slower tremor is removed.
    # [1/s] usual angular frequency; physiological tremor has 8 to 12 Hz
    tremor_rate_per_s: float = 20.0 * math.pi
    # 0.05 to 0.5. More: irregular tremor is removed. Less: only regular tremor is removed.
    tremor_damping: float = 0.1  # damping ratio of the tremor's oscillator
    # 2e-3 to 0.02. More: rest is left later. Less: strong tremor counts as motion.
    # upper limit of the amplitude, which only pathological tremor exceeds
    max_tremor_m: float = 6e-3
    # 3e-3 to 0.03. More: faster drift counts as rest. Less: rest is left sooner.
    # standard deviation of a resting hand, each axis: hands that hold something drift
    rest_speed_std_mps: float = 0.01

    # Measurement noise, estimated from third differences of the samples.
    # 1e-4 to 2e-3. More: estimates are smoother. Less: good trackers are followed faster.
    # lower limit of the standard deviation; below it, samples differ by the hand's tremor
    least_noise_m: float = 7e-4
    # 20 to 300. More: the noise is steadier. Less: the noise adapts faster.
    noise_samples: int = 60  # number of samples over which the noise is averaged

    # Late samples.
    # 0.03 to 0.3. More: later samples are used. Less: late samples are rejected sooner.
    # samples older than the newest one by more are rejected; longer delays count as this
    max_late_s: float = 0.1
    # 0.3 to 5. More: judgements are steadier. Less: drift and a second arm are seen sooner.
    # time over which a tracker's minimum delay and the arm's contradictions are judged
    tracker_memory_s: float = 1.0

    # Jumps, and two sources of the arm.
    # 2 to 10. More: wrong units pass. Less: far trackers are rejected.
    # samples farther from the base plate are rejected; their unit is probably wrong
    max_hand_distance_m: float = 5.0
    # 0.1 to 0.5. More: two arms are tolerated longer. Less: outliers hold the arm.
    # the arm is contested above this share of contradicting states
    contested_on_share: float = 0.25

    # Joint states. Radians hold for revolute joints; a prismatic joint has them times `per_rad`.
    # 0.05 to 1. More: jumps of the arm pass. Less: coarse joint states are rejected.
    # a joint may differ from its newest sample by this + jump speed * elapsed time
    joint_jump_rad: float = 0.2

    # Hands that move.
    # 0.01 to 0.5. More: slow reaches count as rest. Less: trembling hands are in motion.
    hand_still_mps: float = 0.05  # a faster hand is in motion
    # 0.005 to 0.3. More: outliers are followed. Less: quick reaches are rejected.
    jump_m: float = 0.04  # a sample farther from its prediction is a jump
    # 0 to 5. More: outliers after a pause are followed. Less: hands that reappear are rejected.
    jump_speed_mps: float = 1.5  # after a pause the limit of a jump grows at this speed

    @property
    def tremor_rates_per_s(self) -> Vector:
        """Possible rates of tremor [1/s], 2.3 to 12 Hz; neighbours differ by the width of the
        resonance.
        """
        return np.round(
            self.tremor_rate_per_s * (1.0 + 2.0 * self.tremor_damping) ** np.arange(-8.0, 2.0), 9
        )

    @property
    def start_speed_std_mps(self) -> float:
        """Standard deviation of the velocity after a hand's first sample: `outlier_stds` times the
        stationary one of the mode CHANGE.
        """
        reversion = (
            self.mode_velocity_reversions_per_s2[-1] * self.mode_acceleration_reversions_per_s[-1]
        )
        return self.outlier_stds * math.sqrt(self.mode_intensities_m2ps5[-1] / (2.0 * reversion))

    @property
    def hand_still_s(self) -> float:
        """A slow hand counts as still after two periods of tremor."""
        return 2.0 * self.stillness_lowpass_s

    @property
    def confirmed_s(self) -> float:
        """Samples that confirm a jump span at least this time: a hand is not yet stale then."""
        return 0.5 * self.max_late_s

    @property
    def arm_still_rad(self) -> float:
        """An arm is at rest if no joint moves by more than this within max_late_s."""
        return self.joint_jump_rad / 10.0

    @property
    def stillness_lowpass_s(self) -> float:
        """Time constant of the velocity's lowpass in the stillness: a period of tremor."""
        return 2.0 * math.pi / self.tremor_rate_per_s

    @property
    def contested_off_share(self) -> float:
        """A contested arm remains so until its share of contradicting states is below this."""
        return self.end_share * self.contested_on_share

    @property
    def max_joint_radps(self) -> float:
        """Samples of a joint are rejected that would jump within 2 ms."""
        return self.joint_jump_rad / 2e-3

    @property
    def max_outside_rad(self) -> float:
        """Samples of a joint farther outside its limits are rejected; it is moved back by hand."""
        return self.joint_jump_rad
