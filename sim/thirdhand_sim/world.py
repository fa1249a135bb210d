"""The bench's world for any physics engine: an arm, and around it table, board, magnifying glass,
iron, solder and two hands. It runs without a screen, step by step.

Only the arm is dynamic, and only the table stops it. Held things move with their holder: there is
no grip to tune, and contact with a grasped thing would push the arm away by centimetres.
"""

from __future__ import annotations

import abc
import math
from typing import Any, NamedTuple

import numpy as np

from thirdhand.contract.messages import Quaternion
from thirdhand.core.geometry import rotation
from thirdhand.settings.config import Settings
from thirdhand.settings.urdf import multiply
from thirdhand_sim.scene import HAND_ORIENTATION, Scene

Floats = tuple[float, ...]
ALONG_X = (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))  # a capsule's own axis is z
LEVEL = (0.0, 0.0, 0.0, 1.0)
POSITION_GAIN = 0.3  # a motor corrects this share of its position error in one step
TABLE_THICKNESS = 0.04  # [m]
UNLIMITED = 1e6  # [N m] effort of a motor without a limit in the description
FIELD_OF_VIEW = 45.0  # [degrees] vertical field of view of pictures
# distances between which a camera draws
NEAR_PLANE_M = 0.1
FAR_PLANE_M = 5.0
BOARD_RGBA = (0.1, 0.5, 0.2, 1.0)
STEEL_RGBA = (0.7, 0.7, 0.75, 1.0)
WOOD_RGBA = (0.75, 0.6, 0.4, 1.0)
SKIN_RGBA = (0.9, 0.7, 0.6, 1.0)
IRON_RGBA = (0.2, 0.4, 0.8, 1.0)


class Pose(NamedTuple):
    """Position [m] and quaternion x y z w."""

    position: Floats
    orientation: Quaternion


AT_ITS_FRAME = Pose((0.0, 0.0, 0.0), LEVEL)
# held by its edge
BOARD_IN_TOOL = Pose((0.0, 0.0, 0.05), (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4)))


class Look(NamedTuple):
    """The look of a thing: its shape, which is `box`, `cylinder` or `capsule`, its size x y z [m],
    for a capsule with the length of the axis as z, and its colour.
    """

    shape: str
    size: Floats
    colour: Floats


class WorldBody(NamedTuple):
    """A body around the arm: its look, its initial pose, and the offset of the look in its frame. A
    `solid` body stops the arm; the clearance of the arm is measured to `measured` bodies.
    """

    look: Look
    at: Pose
    offset: Pose = AT_ITS_FRAME
    solid: bool = False
    measured: bool = False


class World(abc.ABC):
    """The simulated bench: an arm that follows joint commands, and movable bodies by name."""

    arm = "arm"
    board = "board"
    glass = "glass"
    iron = "iron"
    solder = "solder"
    left = "left"
    right = "right"
    things: dict[str, Look]  # the things on the bench that can be grasped

    def __init__(self, scene: Scene, settings: Settings, *, posture: Floats) -> None:
        self._period_s = settings.period_s
        x, y, z, *turn = settings.tool.plate_from_tool
        self.plate_from_tool = Pose((x, y, z), (turn[0], turn[1], turn[2], turn[3]))
        bodies = furniture(scene, settings)
        self.things = {
            name: bodies[name].look for name in (self.board, self.glass, self.iron, self.solder)
        }
        self._poses = {name: body.at for name, body in bodies.items()}
        self._build(settings, bodies, posture)
        self.follow(posture, (0.0,) * len(posture))
        self.put(self.board, Pose(self.tool()[0].position, LEVEL))

    @abc.abstractmethod
    def _build(self, settings: Settings, bodies: dict[str, WorldBody], posture: Floats) -> None:
        """Make the arm, at a posture [rad], and all bodies."""

    @abc.abstractmethod
    def follow(self, position: Floats, velocity: Floats) -> None:
        """Set the motors' target positions [rad] and velocities [rad/s]."""

    @abc.abstractmethod
    def step(self) -> None:
        """One period of physics."""

    @abc.abstractmethod
    def joints(self) -> tuple[Floats, Floats]:
        """Position [rad] and velocity [rad/s] of the joints in chain order."""

    @abc.abstractmethod
    def tool(self) -> tuple[Pose, Floats]:
        """Pose and velocity [m/s] of the tool."""

    @abc.abstractmethod
    def _place(self, body: str, pose: Pose) -> None:
        """Set the pose of a body in the engine."""

    @abc.abstractmethod
    def clearance(self, body: str, *, within: float = 2.0) -> float:
        """Smallest distance between the arm and a measured body [m], but at most `within`."""

    @abc.abstractmethod
    def _colours(self, eye: Floats, target: Floats, size: tuple[int, int]) -> Any:
        """The picture of a camera (height, width, 3) on a white background."""

    @abc.abstractmethod
    def close(self) -> None:
        """End the simulation."""

    def _tool_on(self, plate: Pose, speed: Floats, turning: Floats) -> tuple[Pose, Floats]:
        """Pose and velocity of the tool from those of the plate [m/s, rad/s]."""
        if self.plate_from_tool == AT_ITS_FRAME:
            return plate, speed
        tool = carried_by(plate, self.plate_from_tool)
        moved = np.cross(turning, np.subtract(tool.position, plate.position))
        return tool, tuple((speed + moved).tolist())

    def pose(self, body: str) -> Pose:
        """The pose of a body."""
        return self._poses[body]

    def put(self, body: str, pose: Pose) -> None:
        """Set the pose of a body."""
        self._poses[body] = pose
        self._place(body, pose)

    def picture(
        self, *, eye: Floats, target: Floats, size: tuple[int, int] = (640, 480)
    ) -> tuple[Any, Any]:
        """The picture of a camera (height, width, 3), and the matrix (4, 4) from positions [m] to
        normalized coordinates in it, -1 to 1.
        """
        return self._colours(eye, target, size), np.matmul(*camera(eye, target, size))


def camera(eye: Floats, target: Floats, size: tuple[int, int]) -> tuple[Any, Any]:
    """Projection (4, 4) and view (4, 4) of a camera that looks from an eye at a target [m], for
    column vectors.
    """
    ahead = np.subtract(target, eye) / math.dist(target, eye)
    aside = np.cross(ahead, (0.0, 0.0, 1.0))
    aside /= np.linalg.norm(aside)
    view = np.eye(4)
    projection = np.zeros((4, 4))
    view[:3, :3] = aside, np.cross(aside, ahead), -ahead
    view[:3, 3] = view[:3, :3] @ np.negative(eye)
    scale = 1 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    projection[:2, :2] = np.diag((scale * size[1] / size[0], scale))
    projection[2, 2:] = (
        (FAR_PLANE_M + NEAR_PLANE_M) / (NEAR_PLANE_M - FAR_PLANE_M),
        2 * FAR_PLANE_M * NEAR_PLANE_M / (NEAR_PLANE_M - FAR_PLANE_M),
    )
    projection[3, 2] = -1.0
    return projection, view


def furniture(scene: Scene, settings: Settings) -> dict[str, WorldBody]:
    """All bodies around the arm, by name."""
    people = settings.people
    x, y, top = settings.table.centre
    width, depth = settings.table.half_size
    slab = Look("box", (2 * width, 2 * depth, TABLE_THICKNESS), WOOD_RGBA)
    bodies = {"table": WorldBody(slab, Pose((x, y, top - TABLE_THICKNESS / 2), LEVEL), solid=True)}
    for name in ("soldering", "glass", "iron"):  # stands below these things
        position = getattr(scene, name)
        stand = Look("box", (0.06, 0.06, position[2]), WOOD_RGBA)
        bodies[f"stand of {name}"] = WorldBody(
            stand, Pose((position[0], position[1], position[2] / 2), LEVEL)
        )
    for name, shape, size, colour, position in (
        (World.board, "box", (0.08, 0.05, 0.002), BOARD_RGBA, (0.0, 0.0, 0.0)),
        (World.glass, "cylinder", (0.10, 0.10, 0.006), STEEL_RGBA, scene.glass),
        (World.iron, "cylinder", (0.016, 0.016, 0.18), IRON_RGBA, scene.iron),
        (World.solder, "cylinder", (0.04, 0.04, 0.03), STEEL_RGBA, scene.solder),
    ):
        bodies[name] = WorldBody(Look(shape, size, colour), Pose(position, LEVEL))
    # A hand is a capsule from the palm along the forearm. It is for measuring distances and pushes
    # nothing.
    hand = Look("capsule", (2 * people.radius, 2 * people.radius, people.length), SKIN_RGBA)
    back = Pose((-people.length / 2, 0.0, 0.0), ALONG_X)
    for name, start in ((World.left, scene.left_start), (World.right, scene.right_start)):
        bodies[name] = WorldBody(hand, Pose(start, HAND_ORIENTATION), back, measured=True)
    return bodies


def pixels(points: Any, matrix: Any, size: tuple[int, int]) -> Any:
    """Pixels (N, 2) of points (N, 3) [m] in a picture of a size, by its matrix (4, 4)."""
    clip_points = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    flat = clip_points[:, :2] / clip_points[:, 3:]
    return (flat * (1, -1) + 1) / 2 * size


def seen_from(holder: Pose, thing: Pose) -> Pose:
    """The thing's pose in its holder's frame."""
    x, y, z, w = holder.orientation
    back = (-x, -y, -z, w)
    away = rotation(back) @ np.subtract(thing.position, holder.position)
    return Pose(tuple(away.tolist()), multiply(back, thing.orientation))


def carried_by(holder: Pose, grip: Pose) -> Pose:
    """The pose of a thing whose pose in its holder's frame is `grip`."""
    position = rotation(holder.orientation) @ grip.position + holder.position
    return Pose(tuple(position.tolist()), multiply(holder.orientation, grip.orientation))
