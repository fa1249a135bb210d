"""What a tick publishes: under which keys, which bytes. Made once, and recorded as published. And
the frames by which viewers draw it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from service.config import Settings
from service.contract import cdr
from service.contract.channels import STREAMS
from service.contract.messages import BASE, GRIPPER, PoseStamped, PoseWithCovarianceStamped, Transform
from service.contract.records import SIDES
from service.core.frame import Frame
from service.core.skill.pose import CLOSED, UNKNOWN
from service.urdf import Urdf

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


_UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # not turned at all


class Frames:
    """Where viewers find the arm's links, its tool, setpoint, target and hands: each in a parent,
    all of them one tree. `fixed` are those that never move; `links`: whether the arm's are told.
    """

    def __init__(self, settings: Settings, description: str, *, links: bool = True) -> None:
        urdf, offset = Urdf(description), settings.tool.plate_from_tool
        self._root, self._names, self._urdf = urdf.root, settings.joints.names, urdf
        self._still = {joint.child for joint in urdf.joints if joint.kind == "fixed"}
        self._links = links
        self.fixed = [one for one in self._at(()) if one.child in self._still]
        self.fixed.append(Transform(settings.arm.plate, "tool", offset[:3], offset[3:]))
        if all(BASE not in (joint.parent, joint.child) for joint in urdf.joints):
            self.fixed.append(Transform(BASE, urdf.root, (0.0, 0.0, 0.0), _UPRIGHT))

    def _at(self, joints: Sequence[float]) -> list[Transform]:
        return self._urdf.transforms(dict(zip(self._names, joints, strict=False))) if self._links else []

    def moving(self, frame: Frame, joints: Sequence[float]) -> list[Transform]:
        """Of a frame, with the joints [rad] in chain order; what is not known is left out."""
        found = [one for one in self._at(joints) if one.child not in self._still]
        setpoint, turn, target, target_turn = (
            tuple(frame[name].tolist()) for name in ("setpoint", "setpoint_orientation", "target", "orientation")
        )
        found.append(Transform(self._root, "setpoint", setpoint, turn))
        for side, name in enumerate(SIDES):
            if frame["hand_ages"][side] >= 0:
                found.append(Transform(self._root, f"{name}_hand", tuple(frame["hands"][side].tolist()), _UPRIGHT))
        if frame["covariance"].any():  # without both hands nothing is predicted
            found.append(Transform(self._root, "target", target, target_turn))
        return found
