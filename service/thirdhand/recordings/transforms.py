"""Coordinate frames with which viewers draw a cell: arm, tool, setpoint, target and hands."""

from __future__ import annotations

from collections.abc import Sequence

from thirdhand.contract.messages import BASE, Transform
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Frame
from thirdhand.settings.config import Settings
from thirdhand.settings.urdf import Urdf

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # quaternion x y z w without rotation


class Frames:
    """Transforms of the arm's links, the tool, setpoint, target and hands to their parents.

    All frames form one tree. `fixed`: the transforms that never change. `links`: the arm's links
    are published too.
    """

    def __init__(self, settings: Settings, description: str, *, links: bool = True) -> None:
        urdf = Urdf(description)
        offset = settings.tool.plate_from_tool
        self._root = urdf.root
        self._names = settings.joints.names
        self._urdf = urdf
        self._still = {joint.child for joint in urdf.joints if joint.kind == "fixed"}
        self._links = links
        self.fixed = [transform for transform in self._at(()) if transform.child in self._still]
        self.fixed.append(Transform(settings.arm.plate, "tool", offset[:3], offset[3:]))
        if all(BASE not in (joint.parent, joint.child) for joint in urdf.joints):
            self.fixed.append(Transform(BASE, urdf.root, (0.0, 0.0, 0.0), _UPRIGHT))

    def _at(self, joints: Sequence[float]) -> list[Transform]:
        """Transforms of the arm's links at joints [rad], in chain order; none without `links`."""
        return (
            self._urdf.transforms(dict(zip(self._names, joints, strict=False)))
            if self._links
            else []
        )

    def moving(self, frame: Frame, joints: Sequence[float]) -> list[Transform]:
        """Moving transforms for a tick's `frame`: links at joints [rad], in chain order, then
        setpoint, hands and target; unknown ones are left out.
        """
        transforms = [
            transform for transform in self._at(joints) if transform.child not in self._still
        ]
        setpoint, turn, target, target_turn = (
            tuple(frame[name].tolist())
            for name in ("setpoint", "setpoint_orientation", "target", "orientation")
        )
        transforms.append(Transform(self._root, "setpoint", setpoint, turn))
        for side, name in enumerate(SIDES):
            if frame["hand_ages"][side] >= 0:
                transforms.append(
                    Transform(
                        self._root, f"{name}_hand", tuple(frame["hands"][side].tolist()), _UPRIGHT
                    )
                )
        if frame["covariance"].any():  # zeros: nothing is predicted
            transforms.append(Transform(self._root, "target", target, target_turn))
        return transforms
