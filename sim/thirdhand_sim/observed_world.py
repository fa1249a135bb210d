"""The world of a real arm, or of one that another program simulates: its joint states give its
position. Only hands and things are simulated here.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import zenoh

from thirdhand.contract import cdr, messages
from thirdhand.contract.joint_states import JointStates, measured
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.geometry import between_segments, place, quaternion_of
from thirdhand.core.separation.body import body_of
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.world import LEVEL, Floats, Pose, World, WorldBody, carried_by


class ObservedWorld(World):
    """The bench's world around an observed arm, which another program moves."""

    heard = False  # True once a joint state was received

    def _build(self, settings: Settings, bodies: dict[str, WorldBody], posture: Floats) -> None:
        self._names = settings.joints.names
        description = robot_description(settings)
        self._arm = ArmStage(settings, description)
        self._body = body_of(settings, description)
        self._bodies = bodies
        self._newest: tuple[Floats, Floats] = posture, (0.0,) * len(posture)
        self._states = JointStates(self._names, settings.arm.silent_ms / 1000)

    def receive(self, sample: zenoh.Sample) -> None:
        """Store a joint state. Others are ignored, because the service reports them. For any
        thread.
        """
        try:
            joint_state = self._states.take(
                cdr.decode_joints(sample.payload.to_bytes()), time.monotonic()
            )
            if joint_state is None:
                return
            state = measured(joint_state, self._names)
        except messages.WireError:
            return
        if messages.finite(state[0] + state[1]):
            self._newest = state
            self.heard = True

    def follow(self, position: Floats, velocity: Floats) -> None:
        """Do nothing: the arm follows commands itself."""

    def step(self) -> None:
        """Do nothing: the arm moves in real time."""

    def joints(self) -> tuple[Floats, Floats]:
        """Position [rad] and velocity [rad/s] of the joints in chain order."""
        return self._newest

    def tool(self) -> tuple[Pose, Floats]:
        """Pose and velocity [m/s] of the tool."""
        position, velocity = self._newest
        tool_frame = self._arm.at(np.array(position))
        turn = np.empty(4)
        quaternion_of(tool_frame.rotation, turn)
        x, y, z, w = turn.tolist()
        speed = tool_frame.jacobian[:3] @ velocity
        return Pose(tuple(tool_frame.position.tolist()), (x, y, z, w)), tuple(speed.tolist())

    def _place(self, body: str, pose: Pose) -> None:
        """Do nothing: the base class stores the pose."""

    def clearance(self, body: str, *, within: float = 2.0) -> float:
        """Smallest distance between the arm's capsules and a hand [m], but at most `within`."""
        capsules = self._body.capsules
        near = np.empty(9)
        placed = np.empty((len(capsules), 2, 3))
        place(np.array(self._newest[0]), self._body.frames, self._body.axes, capsules, placed)
        pose = self.pose(body)
        look = self._bodies[body].look
        hand = np.array(
            [pose.position, carried_by(pose, Pose((-look.size[2], 0.0, 0.0), LEVEL)).position]
        )
        distances_m = [between_segments(segment, hand, near) for segment in placed] - capsules[
            "radius"
        ]
        return min(within, float(distances_m.min()) - look.size[0] / 2)

    def _colours(self, eye: Floats, target: Floats, size: tuple[int, int]) -> Any:
        raise NotImplementedError(
            "there is no engine that draws; thirdhand view live shows the cell"
        )

    def close(self) -> None:
        """Do nothing: there are no resources."""
