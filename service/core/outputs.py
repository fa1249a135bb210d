"""What a tick publishes: under which keys, which bytes. Made once, and recorded as published."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from service.contract import cdr
from service.contract.channels import STREAMS
from service.contract.messages import BASE, GRIPPER, PoseStamped, PoseWithCovarianceStamped
from service.core.frame import Frame
from service.core.skill.pose import CLOSED, UNKNOWN

Outputs: TypeAlias = Sequence[tuple[str, bytes]]
"""Keys below the cell, and what is published there."""


def outgoing(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> Outputs:
    """What is published of a frame; `joints` are the names of the commanded ones.

    Nothing is commanded before the arm is ready, and no target is there without both hands.
    """
    tick = int(frame["tick"])
    made = ((one.key, _OUTPUTS[one.key](frame, stamp_ns, joints)) for one in STREAMS if tick % one.every == 0)
    return [(key, payload) for key, payload in made if payload is not None]


def _command(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if not frame["commanded"]:
        return None
    return cdr.encode_command(stamp_ns, joints, frame["joints"].tolist(), frame["joint_velocities"].tolist())


def _target(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if not frame["covariance"].any():
        return None
    covariance = [0.0] * 36
    for i, row in enumerate(frame["covariance"].tolist()):
        covariance[6 * i : 6 * i + 3] = row
    for i, row in enumerate(frame["orientation_covariance"].tolist()):
        covariance[6 * i + 21 : 6 * i + 24] = row
    position, orientation = tuple(frame["target"].tolist()), tuple(frame["orientation"].tolist())
    message = PoseWithCovarianceStamped(stamp_ns, BASE, position, orientation, tuple(covariance))
    return cdr.encode_pose_with_covariance(message)


def _setpoint(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    message = PoseStamped(
        stamp_ns, BASE, tuple(frame["setpoint"].tolist()), tuple(frame["setpoint_orientation"].tolist())
    )
    return cdr.encode_pose(message)


def _gripper(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if frame["gripper"] == UNKNOWN:
        return None
    return cdr.encode_command(stamp_ns, (GRIPPER,), [float(frame["gripper"] == CLOSED)], [0.0])


_OUTPUTS: dict[str, Callable[[Frame, int, tuple[str, ...]], bytes | None]] = {
    "joints/command": _command,
    "tool/target": _target,
    "tool/setpoint": _setpoint,
    "gripper/command": _gripper,
}
