"""The world in MuJoCo."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np

from thirdhand.settings.config import Settings
from thirdhand_sim.description import simulated
from thirdhand_sim.world import (
    FIELD_OF_VIEW,
    POSITION_GAIN,
    UNLIMITED,
    Floats,
    Pose,
    World,
    WorldBody,
)

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # draws without a screen
import mujoco

GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
}
FELT_GROUP = 0  # group into which MuJoCo puts collision shapes of a URDF
SEEN_GROUP = 1  # group into which MuJoCo puts visual shapes of a URDF
MOST_PIXELS = 2048  # largest width and height of a picture
# MuJoCo needs a mass for each link. Visual shapes are kept, and links are not merged.
READ_AS = {
    "discardvisual": "false",
    "fusestatic": "false",
    "balanceinertia": "true",
    "boundmass": "1e-6",
    "boundinertia": "1e-9",
}


class MujocoWorld(World):
    """The bench's world, simulated by MuJoCo. The motors are modelled as in PyBullet: within a step
    each corrects a part of its position error and its whole velocity error, within its effort.
    """

    def _build(self, settings: Settings, bodies: dict[str, WorldBody], posture: Floats) -> None:
        spec = mujoco.MjSpec.from_string(simulated(settings, **READ_AS))
        spec.option.timestep = self._period_s
        for shape in spec.geoms:
            shape.contype = int(shape.group == FELT_GROUP)
            shape.conaffinity = 0
        spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            rgb1=(1, 1, 1),
            rgb2=(1, 1, 1),
            width=8,
            height=48,
        )
        spec.worldbody.add_light(
            pos=(1, -1, 3), dir=(-0.3, 0.3, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        )
        for name, body in bodies.items():
            self._add(spec, name, body)
        spec.visual.global_.offwidth = spec.visual.global_.offheight = MOST_PIXELS
        spec.visual.global_.fovy = FIELD_OF_VIEW
        self._model = model = spec.compile()
        self._data = mujoco.MjData(model)
        joints = [model.joint(name) for name in settings.joints.names]
        self._joints = np.array([joint.qposadr[0] for joint in joints])
        self._motors = np.array([joint.dofadr[0] for joint in joints])
        # [N m]
        self._efforts = np.array(
            [model.jnt_actfrcrange[joint.id, 1] or UNLIMITED for joint in joints]
        )
        self._inertia = np.empty((model.nv, model.nv))
        self._tool = model.body(settings.arm.plate).id
        self._mocap = {name: int(model.body(name).mocapid[0]) for name in bodies}
        self._felt = np.flatnonzero(model.geom_contype)
        self._data.qpos[self._joints] = posture
        mujoco.mj_step1(model, self._data)

    @staticmethod
    def _add(spec: Any, name: str, body: WorldBody) -> None:
        x, y, z = body.look.size
        spec_body = spec.worldbody.add_body(
            name=name,
            pos=body.at.position,
            quat=_w_first(body.at.orientation),
            mocap=not body.solid,
        )
        spec_body.add_geom(
            name=name,
            type=GEOM_TYPES[body.look.shape],
            size=(x / 2, y / 2, z / 2) if body.look.shape == "box" else (x / 2, z / 2, 0),
            pos=body.offset.position,
            quat=_w_first(body.offset.orientation),
            rgba=body.look.colour,
            contype=0,
            conaffinity=int(body.solid),
            group=SEEN_GROUP,
        )

    def follow(self, position: Floats, velocity: Floats) -> None:
        """Set the motors' target positions [rad] and velocities [rad/s]."""
        self._position = np.array(position)
        self._velocity = np.array(velocity)

    def step(self) -> None:
        """One period of physics."""
        data = self._data
        data.qfrc_applied[self._motors] = self._effort()
        mujoco.mj_step2(self._model, data)
        mujoco.mj_step1(self._model, data)

    def _effort(self) -> Any:
        """Torques of the motors [N m]. Motors that do not reach their limit reach their
        velocity.
        """
        data = self._data
        motors = self._motors
        target_velocity = self._velocity + POSITION_GAIN / self._period_s * (
            self._position - data.qpos[self._joints]
        )
        acceleration = (target_velocity - data.qvel[motors]) / self._period_s
        mujoco.mj_fullM(self._model, data, self._inertia)
        inertia = self._inertia[np.ix_(motors, motors)]
        others = (data.qfrc_bias - data.qfrc_passive - data.qfrc_constraint)[motors]
        effort = inertia @ acceleration + others
        weak = np.zeros(len(motors), bool)
        while (share := np.where(weak, 0.0, np.abs(effort) / self._efforts)).max() > 1.0:
            weak[np.argmax(share)] = True  # its torque is at the limit; the others compensate
            effort[weak] = np.clip(effort[weak], -self._efforts[weak], self._efforts[weak])
            left = effort[weak] - others[weak] - inertia[np.ix_(weak, ~weak)] @ acceleration[~weak]
            acceleration[weak] = np.linalg.solve(inertia[np.ix_(weak, weak)], left)
            effort[~weak] = (inertia @ acceleration + others)[~weak]
        return effort

    def joints(self) -> tuple[Floats, Floats]:
        """Position [rad] and velocity [rad/s] of the joints in chain order."""
        return tuple(self._data.qpos[self._joints].tolist()), tuple(
            self._data.qvel[self._motors].tolist()
        )

    def tool(self) -> tuple[Pose, Floats]:
        """Pose and velocity [m/s] of the tool."""
        w, *turn = self._data.xquat[self._tool].tolist()
        speed = np.empty(6)
        mujoco.mj_objectVelocity(
            self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, self._tool, speed, 0
        )
        pose = Pose(tuple(self._data.xpos[self._tool].tolist()), (*turn, w))
        return self._tool_on(pose, tuple(speed[3:].tolist()), tuple(speed[:3].tolist()))

    def _place(self, body: str, pose: Pose) -> None:
        number = self._mocap[body]
        self._data.mocap_pos[number] = pose.position
        self._data.mocap_quat[number] = _w_first(pose.orientation)

    def clearance(self, body: str, *, within: float = 2.0) -> float:
        """Smallest distance between the arm and a measured body [m], but at most `within`."""
        mujoco.mj_kinematics(self._model, self._data)  # bodies may have moved
        other = self._model.geom(body).id
        return min(
            float(mujoco.mj_geomDistance(self._model, self._data, geom, other, within, None))
            for geom in self._felt
        )

    def _colours(self, eye: Floats, target: Floats, size: tuple[int, int]) -> Any:
        mujoco.mj_kinematics(self._model, self._data)
        lens = mujoco.MjvCamera()
        option = mujoco.MjvOption()
        away = np.subtract(target, eye)
        lens.lookat[:] = target
        lens.distance = np.linalg.norm(away)
        lens.azimuth = np.degrees(np.arctan2(away[1], away[0]))
        lens.elevation = np.degrees(np.arctan2(away[2], np.hypot(away[0], away[1])))
        option.geomgroup[FELT_GROUP] = 0
        with mujoco.Renderer(self._model, size[1], size[0]) as renderer:
            renderer.update_scene(self._data, lens, option)
            return renderer.render()

    def close(self) -> None:
        """End the simulation."""
        del self._data, self._model


def _w_first(quaternion: Floats) -> Floats:
    x, y, z, w = quaternion
    return (w, x, y, z)
