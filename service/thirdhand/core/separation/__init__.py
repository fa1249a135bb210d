"""Stage 4, separation: speed limits of the arm's parts toward hands, things and each other."""

from __future__ import annotations

from thirdhand.contract.records import Field, Layout

FARTHEST_REPORTED_M = 3.0  # larger distances are reported as this one
TABLE_DEPTH_M = 1.0  # the table is this thick
STATE: Layout = ()
FRAME = (
    # [m] from the arm to the nearest hand, before this tick's motion
    Field("hand_distance", "float64"),
    # [m/s] smallest of the speeds at which the arm's parts may approach a hand
    Field("hand_limit", "float64"),
)
