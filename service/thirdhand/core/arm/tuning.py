"""Tuned numbers of the arm's inverse kinematics.

docs/tuning.md has them as a table, with their measured sensitivity. The comment above one has the
range of sensible values, and what more and less of it are expected to do.
"""

from __future__ import annotations

from typing import NamedTuple


class ArmTuning(NamedTuple):
    """Tuned numbers of the arm's inverse kinematics."""

    # Costs of the least-squares problem. Lever and dampings in m² are for the WAM's reach, and
    # scale with that of the arm.
    # 3e-3 to 0.1. More: orientation is kept better. Less: position is kept better.
    # an error of 1 rad/s in the tool's turn costs as much as this many m/s
    turn_lever_m: float = 0.0115
    # 1e-6 to 1e-3. More: joints move less. Less: the tool is more exact.
    damping_m2: float = 1e-5  # [m²] cost of joint velocity, (m/s)² of the tool for each (rad/s)²
    # 1e-4 to 0.02. More: joints are calm when stretched. Less: the stretched tool is exact.
    # [m²] added damping at a singular posture; it begins where it weighs as much
    singular_damping_m2: float = 2e-3
    # 0 to 20. More: unreachable targets are calm. Less: far targets close faster.
    # [s²] damping at unreachable targets / (closing speed - half of the largest one)²
    far_damping_s2: float = 4.0
    # 0 to 2. More: weak joints move less. Less: all joints move alike.
    # weight of a joint's speed = acceleration limit ^ -power: weak joints move less
    sparing_power: float = 0.8

    # Closing in on the setpoint.
    # 10 to 200. More: the tool lags less. Less: the joints are calm.
    position_gain_per_s: float = 50.0  # [1/s] decay of a small position error
    # 0.5 to 5. More: slow joints lag less. Less: slow joints are calm.
    # largest position gain / (jerk / acceleration) of the slowest joint
    position_gain_rate_share: float = 2.0
    # 0.04 to 1. More: turns lag less. Less: the joints are calm.
    # decay of a small orientation error / position gain; with more, the joints oscillate
    turn_gain_share: float = 0.2
    # 0.1 to 1. More: large errors close faster. Less: large errors close calmly.
    closing_speed_mps: float = 0.3  # largest speed at which an error is closed
    # 0.03 to 0.5. More: large errors close faster. Less: the joints are calm.
    # share of the tool's deceleration for closing in; with more, the joints oscillate
    closing_brake_share: float = 0.1
    # 2e-3 to 0.05. More: turns go on. Less: position is kept in turns.
    # a turn is scaled down unless its joint velocities can be reached within this time
    turn_horizon_s: float = 0.008
    # 0.5 to 1. More: the setpoint is faster. Less: joints can correct more.
    # usable by the setpoint: of joint speed, acceleration, jerk
    planned_limit_shares: tuple[float, ...] = (0.97, 0.95, 0.85)

    @property
    def tool_speed_share(self) -> float:
        """Speed of setpoint and closing in / max_speed."""
        return 0.5 * (1.0 + self.planned_limit_shares[0])
