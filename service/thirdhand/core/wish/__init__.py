"""Stage 2 where a policy leads: the tool follows its wishes, poses with stamps.

The state of such a cell has these fields after those of all cells.
"""

from __future__ import annotations

from thirdhand.contract.records import Field

MOST_WISHES = 128  # a second ahead, and those before from which a velocity is estimated
STATE = (
    Field("wish_count", "int64"),  # poses of the path
    Field("wish_tick", "int64"),  # newest tick at which a wish was taken; -1: none yet
    Field("wish_told_tick", "int64"),  # tick of `wish_told`
    Field("wish_rate", "float64"),  # at which the offset fades out [1/s]
    Field("wish_due", "float64", (MOST_WISHES,)),  # when each pose is due [ticks]
    Field("wish_poses", "float64", (MOST_WISHES, 7)),  # x y z [m], quaternion x y z w
    Field("wish_newest_due", "float64"),  # when the newest wish of the path is due [ticks]
    # the arm holds from and to these ticks, as a wish between them is far from the path
    Field("wish_leap", "float64", (2,)),
    # of the newest wish: of the position [m²], of the orientation [rad²]
    Field("wish_covariances", "float64", (6, 3)),
    # offset of the target from the path, and its two derivatives: of the position [m, m/s, m/s²],
    # of the orientation [rad, rad/s, rad/s²]
    Field("wish_offset", "float64", (3, 6)),
    # target of the newest tick: position [m, m/s, m/s²]; angular velocity [rad/s]
    Field("wish_told", "float64", (4, 3)),
    Field("wish_turn", "float64", (4,)),  # its orientation
    Field("wish_sources", "uint8"),  # what led then: `join`
    Field("wish_is_new", "uint8"),  # 1: the path has changed since
)
