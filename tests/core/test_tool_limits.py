"""The tool limits that follow from the joints' limits, against joint motion computed here and by
hand.
"""

from __future__ import annotations

import numpy as np
import pytest

from support.followed import changed
from thirdhand.contract.records import Flag, Mode
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.frame import blank, frame_layout
from thirdhand.core.tool_limits import binding, tool_limits
from thirdhand.core.tuning import TUNING
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Settings, robot_description

PLANNED_LIMIT_SHARES = TUNING.arm.planned_limit_shares


@pytest.mark.parametrize("name", ARMS)
def test_limit_uses_all_that_is_planned(name: str) -> None:
    """At the tool's limit, the named joint uses all of its planned speed."""
    settings = cell_of(name)
    arm = ArmStage(settings, robot_description(settings))
    random = np.random.default_rng(0)
    never_binding = {"max_speed": 100.0, "max_acceleration": 1000.0, "fault_speed": 200.0}
    quick = changed(settings, tool=never_binding)
    for _ in range(20):
        q = np.array(settings.arm.posture) + random.uniform(-0.2, 0.2, len(settings.joints.names))
        u = random.normal(size=3)
        u /= np.linalg.norm(u)
        directed = tool_limits(arm, quick, q[None], u[None])
        least = tool_limits(arm, quick, q[None])
        pose = arm.at(q)
        for order, (kind, value, joint) in enumerate(
            (
                ("velocity", directed.speed, directed.speed_joint),
                ("acceleration", directed.acceleration, directed.acceleration_joint),
            )
        ):
            limits = np.array(getattr(settings.joints, kind))
            weights = limits / limits.mean()
            jacobian = pose.tasks[:3] * weights
            moved = weights * (
                jacobian.T
                @ np.linalg.solve(
                    jacobian @ jacobian.T + pose.record["damping"][0] * np.eye(3), value * u
                )
            )
            shares = np.abs(moved) / limits
            assert shares.max() == pytest.approx(PLANNED_LIMIT_SHARES[order], rel=0.01)
            assert settings.joints.names[int(shares.argmax())] == joint
        assert least.speed <= directed.speed + 1e-3
        assert least.acceleration <= directed.acceleration + 1e-2


def test_frame_meets_its_binding_limit() -> None:
    """The binding limit of a frame is the one of which it uses the largest share."""
    settings = Settings()
    frames = np.repeat(blank(frame_layout(7)).reshape(1), 6)
    frames["mode"] = Mode.FOLLOW
    frames["joint_velocities"][0, 2] = -settings.joints.velocity[2]
    frames["joint_accelerations"][0, 1] = 0.95 * settings.joints.acceleration[1]
    frames["setpoint_velocity"][1] = (0.0, 0.0, settings.tool.max_speed)
    frames["setpoint_acceleration"][2] = (-settings.tool.acceleration, 0.0, 0.0)
    frames["setpoint_velocity"][3] = (settings.tool.engaging_speed, 0.0, 0.0)
    frames["flags"][3] = Flag.ENGAGING
    frames["joint_velocities"][4, 2] = (
        0.99 * PLANNED_LIMIT_SHARES[1] ** 2 * settings.joints.velocity[2]
    )
    frames["joint_velocities"][5, 2] = settings.joints.velocity[2]
    frames["mode"][5] = Mode.HOLD
    assert {name: np.flatnonzero(met).tolist() for name, met in binding(settings, frames)} == {
        "speed of wam/shoulder_yaw_joint": [0],
        "[tool] max_speed": [1],
        "[tool] max_acceleration": [2],
        "[tool] engage_speed": [3],
    }
