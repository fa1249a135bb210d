"""Numbers of the wishes. docs/policies.md has what each tuned one changes."""

from __future__ import annotations

from typing import NamedTuple


class WishTuning(NamedTuple):
    """Tuned numbers of stage 2 where a policy leads."""

    # 10 to 40. More: chunks are joined sooner, and a policy is answered sooner. Less: less jerk.
    fade_rate_per_s: float = 20.0  # [1/s] at which the offset between two chunks fades out
    # 0 to 0.3. More: a late chunk is bridged. Less: the tool rests sooner where none comes.
    steady_s: float = 0.1  # time over which the path goes on after its end, at its velocity there


RETAINED = 12  # poses before now, from which a velocity is estimated
# largest speed of an offset d that fades out at the rate w from rest is this times |d| w: 2 / e²
FADING_SHARE = 0.2706705664732254
NEAREST_S = 0.01  # a wish due so soon after another one is left out
LEAP_M = 0.25  # a wish farther from the path than this is another task's, or a mistake
LEAP_MPS = 0.5  # and by this for each second in which no wish was due
LEAP_HOLD_S = 0.5  # the arm holds for so long after such a wish
GOES_ON_S = 0.2  # after a longer gap, a target does not go on from the one before
RAD_AS_M = 0.2  # [m/rad] an offset of orientation fades out as one of position of this size
UNKNOWN_STD = (0.01, 0.05)  # [m, rad] deviation of a wish without a covariance
WISH_NORM_TOLERANCE = 0.01  # a quaternion whose norm is farther from 1 is no rotation
LARGEST_VARIANCE = 1e6  # [m², rad²] a larger one, or one below 0, is a mistake
LATEST_S = 1.0  # a pose that was due earlier is not taken
