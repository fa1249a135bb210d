"""A guess of joints' accelerations and jerks from the velocities, masses and efforts of a URDF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from thirdhand.core.frame import Vector
from thirdhand.settings.urdf import UrdfJoint

UNKNOWN_VELOCITY = 1.5  # [rad/s, m/s] for joints without a velocity in the URDF
RISE_S = 0.25  # acceleration = velocity / 0.25 s
MAX_ACCELERATION = 15.0  # [rad/s²]
JERK_RATE = 40.0  # jerk = 40 / s * acceleration
MAX_JERK = 500.0  # [rad/s³]
TORQUE_SHARE = 0.5  # gravity and acceleration of the arm may take this share of a joint's effort
LEAST_SCALE = 0.2  # small efforts reduce the acceleration to this share at most: they may be wrong


def rates(text: str, moving: Sequence[UrdfJoint]) -> tuple[list[float], list[float], bool]:
    """A guess of the joints' accelerations [rad/s²] and jerks [rad/s³], and True if the URDF has
    masses and efforts.

    acceleration = velocity / RISE_S, reduced if the efforts are small for the masses. Values of
    the URDF itself are taken instead.
    """
    nominal = np.array([min(_known(joint.velocity) / RISE_S, MAX_ACCELERATION) for joint in moving])
    share = _torque_share(text, moving, nominal)
    guess = nominal * min(max(LEAST_SCALE, 1.0 if share is None else share), 1.0)
    urdf_rates = np.array([(joint.acceleration, joint.jerk) for joint in moving])
    acceleration = np.where(np.isfinite(urdf_rates[:, 0]), urdf_rates[:, 0], guess)
    jerk = np.where(
        np.isfinite(urdf_rates[:, 1]),
        urdf_rates[:, 1],
        np.minimum(JERK_RATE * acceleration, MAX_JERK),
    )
    return (
        [float(f"{a:.3g}") for a in acceleration],
        [float(f"{j:.3g}") for j in jerk],
        share is not None,
    )


def velocities(moving: Sequence[UrdfJoint]) -> dict[str, list[float]]:
    """The setting `velocity` of joints [rad/s]; empty if the URDF has all velocities."""
    if all(math.isfinite(joint.velocity) for joint in moving):
        return {}
    return {"velocity": [_known(joint.velocity) for joint in moving]}


def _known(velocity: float) -> float:
    return velocity if math.isfinite(velocity) else UNKNOWN_VELOCITY


def _torque_share(text: str, moving: Sequence[UrdfJoint], acceleration: Vector) -> float | None:
    """The share of accelerations a (J,) that half of the efforts can produce in addition to
    gravity: min((TORQUE_SHARE * effort - |gravity|) / (|M| a)). None if the URDF has no masses or
    efforts.
    """
    robot = ElementTree.fromstring(text)
    limits = {joint.get("name"): joint.find("limit") for joint in robot.findall("joint")}
    if robot.find("link/inertial/mass") is None or any(
        (limit := limits[joint.name]) is None or "effort" not in limit.attrib for joint in moving
    ):
        return None
    try:
        model = pin.buildModelFromXML(text)
        numbers = [model.joints[model.getJointId(joint.name)].idx_v for joint in moving]
        data = model.createData()
        neutral = pin.neutral(model)
        inertia = pin.crba(model, data, neutral)
        gravity = np.abs(pin.computeGeneralizedGravity(model, data, neutral))
        efforts = np.array(model.effortLimit)[numbers]
    except (ValueError, IndexError, RuntimeError):
        return None  # Pinocchio rejects masses that other readers accept
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    needed = np.abs(inertia[np.ix_(numbers, numbers)]) @ acceleration
    if not (efforts > 0.0).all() or not (needed > 0.0).any() or not np.isfinite(efforts).all():
        return None
    return float(((TORQUE_SHARE * efforts - gravity[numbers]) / np.maximum(needed, 1e-9)).min())
