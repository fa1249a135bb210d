"""The world in PyBullet."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np

from thirdhand.settings.config import Settings
from thirdhand_sim.description import simulated
from thirdhand_sim.quiet import pybullet
from thirdhand_sim.world import POSITION_GAIN, UNLIMITED, Floats, Pose, World, WorldBody, camera


class PyBulletWorld(World):
    """The bench's world, simulated by PyBullet."""

    def _build(self, settings: Settings, bodies: dict[str, WorldBody], posture: Floats) -> None:
        names = settings.joints.names
        self._id: int = pybullet.connect(pybullet.DIRECT)
        pybullet.setTimeStep(self._period_s, physicsClientId=self._id)
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=self._id)
        pybullet.setPhysicsEngineParameter(
            deterministicOverlappingPairs=1, physicsClientId=self._id
        )
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            file.write(simulated(settings))
            file.flush()
            self._arm: int = pybullet.loadURDF(
                file.name,
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=self._id,
            )
        count = pybullet.getNumJoints(self._arm, physicsClientId=self._id)
        joints = [
            pybullet.getJointInfo(self._arm, j, physicsClientId=self._id) for j in range(count)
        ]
        index = {info[1].decode(): info[0] for info in joints}
        self._tool = next(info[0] for info in joints if info[12].decode() == settings.arm.plate)
        self._joints = [index[name] for name in names]
        self._efforts = [joints[j][10] or UNLIMITED for j in self._joints]  # [N m]
        self._position_gains = [POSITION_GAIN] * len(names)
        self._velocity_gains = [1.0] * len(names)
        for joint, angle in zip(self._joints, posture, strict=True):
            pybullet.resetJointState(self._arm, joint, angle, physicsClientId=self._id)
        self._bodies = {name: self._body(body) for name, body in bodies.items()}

    def _body(self, body: WorldBody) -> int:
        size = body.look.size
        kind = getattr(pybullet, f"GEOM_{body.look.shape.upper()}")
        box = {"halfExtents": tuple(0.5 * edge for edge in size)}
        visual = box if body.look.shape == "box" else {"radius": size[0] / 2, "length": size[2]}
        felt = box if body.look.shape == "box" else {"radius": size[0] / 2, "height": size[2]}
        position, turn = body.offset
        look = pybullet.createVisualShape(
            kind,
            rgbaColor=body.look.colour,
            visualFramePosition=position,
            visualFrameOrientation=turn,
            physicsClientId=self._id,
            **visual,
        )
        shape = -1
        if body.solid or body.measured:
            shape = pybullet.createCollisionShape(
                kind,
                collisionFramePosition=position,
                collisionFrameOrientation=turn,
                physicsClientId=self._id,
                **felt,
            )
        body_id: int = pybullet.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            baseVisualShapeIndex=look,
            basePosition=body.at.position,
            baseOrientation=body.at.orientation,
            physicsClientId=self._id,
        )
        if not body.solid:
            pybullet.setCollisionFilterGroupMask(body_id, -1, 0, 0, physicsClientId=self._id)
        return body_id

    def follow(self, position: Floats, velocity: Floats) -> None:
        """Set the motors' target positions [rad] and velocities [rad/s]."""
        pybullet.setJointMotorControlArray(
            self._arm,
            self._joints,
            pybullet.POSITION_CONTROL,
            targetPositions=position,
            targetVelocities=velocity,
            forces=self._efforts,
            positionGains=self._position_gains,
            velocityGains=self._velocity_gains,
            physicsClientId=self._id,
        )

    def step(self) -> None:
        """One period of physics."""
        pybullet.stepSimulation(physicsClientId=self._id)

    def joints(self) -> tuple[Floats, Floats]:
        """Position [rad] and velocity [rad/s] of the joints in chain order."""
        states = pybullet.getJointStates(self._arm, self._joints, physicsClientId=self._id)
        return tuple(state[0] for state in states), tuple(state[1] for state in states)

    def tool(self) -> tuple[Pose, Floats]:
        """Pose and velocity [m/s] of the tool."""
        state = pybullet.getLinkState(
            self._arm,
            self._tool,
            computeLinkVelocity=True,
            computeForwardKinematics=True,
            physicsClientId=self._id,
        )
        return self._tool_on(Pose(state[4], state[5]), state[6], state[7])

    def _place(self, body: str, pose: Pose) -> None:
        pybullet.resetBasePositionAndOrientation(
            self._bodies[body], pose.position, pose.orientation, physicsClientId=self._id
        )

    def clearance(self, body: str, *, within: float = 2.0) -> float:
        """Smallest distance between the arm and a measured body [m], but at most `within`."""
        near = pybullet.getClosestPoints(
            self._arm, self._bodies[body], within, physicsClientId=self._id
        )
        return min((float(point[8]) for point in near), default=within)

    def _colours(self, eye: Floats, target: Floats, size: tuple[int, int]) -> Any:
        projection, view = camera(eye, target, size)
        width, height = size
        image = pybullet.getCameraImage(
            width,
            height,
            view.ravel("F").tolist(),
            projection.ravel("F").tolist(),
            shadow=1,
            lightDirection=(1.0, -1.0, 3.0),
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._id,
        )
        return np.reshape(np.asarray(image[2], dtype=np.uint8), (height, width, 4))[:, :, :3]

    def close(self) -> None:
        """End the simulation."""
        pybullet.disconnect(physicsClientId=self._id)
