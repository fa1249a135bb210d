"""The bodies around the arm in PyBullet: table, board, magnifying glass, iron, solder and two
hands. Headless, one step at a time.

Only the arm is dynamic, and only the table stops it. Things that are held are moved with their
holder: there is no grip to tune, and contact with what the arm grasps would push it away by
centimetres.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from service.config import People, Settings, Table, urdf_path
from sim.quiet import pybullet
from sim.scene import HAND_ORIENTATION, Scene

Floats = tuple[float, ...]
ALONG_X = (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))  # a capsule's own axis is z
LEVEL = (0.0, 0.0, 0.0, 1.0)
POSITION_GAIN = 0.3  # this much of a position error is made up in one step
TABLE_THICKNESS = 0.04  # [m]
GREEN, STEEL, WOOD, SKIN, BLUE = (
    (0.1, 0.5, 0.2, 1.0),
    (0.7, 0.7, 0.75, 1.0),
    (0.75, 0.6, 0.4, 1.0),
    (0.9, 0.7, 0.6, 1.0),
    (0.2, 0.4, 0.8, 1.0),
)


class Pose(NamedTuple):
    """Position [m] and quaternion x y z w."""

    position: Floats
    orientation: Floats


BOARD_IN_TOOL = Pose((0.0, 0.0, 0.05), (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4)))  # held by its edge


class Look(NamedTuple):
    """How a thing looks: a `box` or a `cylinder` of a size x y z [m], and its colour."""

    shape: str
    size: Floats
    colour: Floats


class World:
    """The simulated bench: an arm that follows joint commands, and bodies that are put where they
    are wanted.
    """

    def __init__(self, scene: Scene, settings: Settings, *, posture: Floats, rate_hz: int) -> None:
        names = settings.joints.names
        self._id: int = pybullet.connect(pybullet.DIRECT)
        pybullet.setTimeStep(1.0 / rate_hz, physicsClientId=self._id)
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=self._id)
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=self._id)
        self.arm: int = pybullet.loadURDF(
            str(urdf_path(settings)),
            useFixedBase=True,
            flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=self._id,
        )
        count = pybullet.getNumJoints(self.arm, physicsClientId=self._id)
        joints = [pybullet.getJointInfo(self.arm, j, physicsClientId=self._id) for j in range(count)]
        index = {info[1].decode(): info[0] for info in joints}
        self._tool = next(info[0] for info in joints if info[12].decode() == settings.arm.plate)
        self._joints = [index[name] for name in names]
        self._efforts = [joints[j][10] for j in self._joints]  # [N m]
        self._position_gains, self._velocity_gains = [POSITION_GAIN] * len(names), [1.0] * len(names)
        for joint, angle in zip(self._joints, posture, strict=True):
            pybullet.resetJointState(self.arm, joint, angle, physicsClientId=self._id)
        self.follow(posture, (0.0,) * len(names))
        self._furnish(scene, settings.table, settings.people)

    def _furnish(self, scene: Scene, table: Table, people: People) -> None:
        x, y, top = table.centre
        self._box((*table.half_size, TABLE_THICKNESS / 2), (x, y, top - TABLE_THICKNESS / 2), WOOD, solid=True)
        for at in (scene.soldering, scene.glass, scene.iron):  # what things rest on
            self._box((0.03, 0.03, at[2] / 2), (at[0], at[1], at[2] / 2), WOOD)
        self.things: dict[str, tuple[int, Look]] = {}  # by name, what lies on the bench and can be taken
        self.board = self._thing("board", Look("box", (0.08, 0.05, 0.002), GREEN), self.tool()[0].position)
        self.glass = self._thing("glass", Look("cylinder", (0.10, 0.10, 0.006), STEEL), scene.glass)
        self.iron = self._thing("iron", Look("cylinder", (0.016, 0.016, 0.18), BLUE), scene.iron)
        self.solder = self._thing("solder", Look("cylinder", (0.04, 0.04, 0.03), STEEL), scene.solder)
        self.left = self._hand(scene.left_start, people)
        self.right = self._hand(scene.right_start, people)

    def _thing(self, name: str, look: Look, at: Floats) -> int:
        x, y, z = look.size
        if look.shape == "box":
            body = self._box((x / 2, y / 2, z / 2), at, look.colour)
        else:
            body = self._cylinder(x / 2, z, at, look.colour)
        self.things[name] = body, look
        return body

    def _box(self, half: Floats, at: Floats, colour: Floats, *, solid: bool = False) -> int:
        look = pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half, rgbaColor=colour, physicsClientId=self._id
        )
        shape = (
            pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self._id)
            if solid
            else -1
        )
        return self._body(look, shape, Pose(at, LEVEL))

    def _cylinder(self, radius: float, length: float, at: Floats, colour: Floats) -> int:
        look = pybullet.createVisualShape(
            pybullet.GEOM_CYLINDER, radius=radius, length=length, rgbaColor=colour, physicsClientId=self._id
        )
        return self._body(look, -1, Pose(at, LEVEL))

    def _hand(self, at: Floats, people: People) -> int:
        # A capsule from the palm back along the forearm; its shape is there to measure distances,
        # and pushes nothing.
        back = (-people.length / 2, 0.0, 0.0)
        look = pybullet.createVisualShape(
            pybullet.GEOM_CAPSULE,
            radius=people.radius,
            length=people.length,
            rgbaColor=SKIN,
            visualFramePosition=back,
            visualFrameOrientation=ALONG_X,
            physicsClientId=self._id,
        )
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CAPSULE,
            radius=people.radius,
            height=people.length,
            collisionFramePosition=back,
            collisionFrameOrientation=ALONG_X,
            physicsClientId=self._id,
        )
        hand = self._body(look, shape, Pose(at, HAND_ORIENTATION))
        pybullet.setCollisionFilterGroupMask(hand, -1, 0, 0, physicsClientId=self._id)
        return hand

    def _body(self, look: int, shape: int, pose: Pose) -> int:
        body: int = pybullet.createMultiBody(
            baseMass=0.0,
            baseCollisionShapeIndex=shape,
            baseVisualShapeIndex=look,
            basePosition=pose.position,
            baseOrientation=pose.orientation,
            physicsClientId=self._id,
        )
        return body

    def follow(self, position: Floats, velocity: Floats) -> None:
        """Set where the motors go: [rad] with [rad/s] fed forward."""
        pybullet.setJointMotorControlArray(
            self.arm,
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
        states = pybullet.getJointStates(self.arm, self._joints, physicsClientId=self._id)
        return tuple(state[0] for state in states), tuple(state[1] for state in states)

    def tool(self) -> tuple[Pose, Floats]:
        """The tool plate's pose and velocity [m/s]."""
        state = pybullet.getLinkState(
            self.arm, self._tool, computeLinkVelocity=True, computeForwardKinematics=True, physicsClientId=self._id
        )
        return Pose(state[4], state[5]), state[6]

    def pose(self, body: int) -> Pose:
        """Where a body is."""
        return Pose(*pybullet.getBasePositionAndOrientation(body, physicsClientId=self._id))

    def put(self, body: int, pose: Pose) -> None:
        """Put a body somewhere."""
        pybullet.resetBasePositionAndOrientation(body, pose.position, pose.orientation, physicsClientId=self._id)

    def clearance(self, body: int, *, within: float = 2.0) -> float:
        """Smallest distance between the arm and a body with a shape [m]; `within` when there is
        more.
        """
        near = pybullet.getClosestPoints(self.arm, body, within, physicsClientId=self._id)
        return min((float(point[8]) for point in near), default=within)

    def picture(self, *, eye: Floats, target: Floats, size: tuple[int, int] = (640, 480)) -> tuple[Any, Any]:
        """What a camera sees: colours (height, width, 3), and the matrix (4, 4) from places [m] to
        where they are in it, -1 to 1 each way.
        """
        width, height = size
        view = pybullet.computeViewMatrix(eye, target, (0.0, 0.0, 1.0))
        projection = pybullet.computeProjectionMatrixFOV(45.0, width / height, 0.1, 5.0)
        seen = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            shadow=1,
            lightDirection=(1.0, -1.0, 3.0),
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._id,
        )
        colours = np.reshape(np.asarray(seen[2], dtype=np.uint8), (height, width, 4))[:, :, :3]
        return colours, np.reshape(projection, (4, 4)).T @ np.reshape(view, (4, 4)).T

    def close(self) -> None:
        """End the simulation."""
        pybullet.disconnect(physicsClientId=self._id)


def pixels(points: Any, matrix: Any, size: tuple[int, int]) -> Any:
    """Where points (N, 3) [m] are in a picture of a size, by its matrix (4, 4): (N, 2)."""
    seen = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    flat = seen[:, :2] / seen[:, 3:]
    return (flat * (1, -1) + 1) / 2 * size


def seen_from(holder: Pose, thing: Pose) -> Pose:
    """The thing's pose in its holder's frame."""
    return Pose(*pybullet.multiplyTransforms(*pybullet.invertTransform(*holder), *thing))


def carried_by(holder: Pose, grip: Pose) -> Pose:
    """Where a thing is whose pose in its holder's frame is `grip`."""
    return Pose(*pybullet.multiplyTransforms(*holder, *grip))
