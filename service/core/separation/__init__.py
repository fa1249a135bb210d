"""Stage 4, separation: how fast the parts of the arm may approach hands, things and each other."""

from __future__ import annotations

from service.contract.records import Field, Layout

STATE: Layout = ()
FRAME = (
    Field("hand_distance", "float64"),  # from the nearest hand to the arm, before this tick's motion; 3 at most [m]
    Field("hand_limit", "float64"),  # least speed toward a hand that is allowed at some part of the arm [m/s]
)
