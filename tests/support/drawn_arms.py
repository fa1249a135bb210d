"""Simulated arms that follow commands and report joints well, or fail as arms and drivers do."""

from __future__ import annotations

import numpy as np

from thirdhand.contract.messages import JointState
from thirdhand.core.frame import Event, Frame, Vector
from thirdhand.settings.config import Settings

# An arm that follows well is as probable as all other kinds together.
KINDS = ("lag", "noise", "jumps", "drift", "odd numbers", "gaps", "joint missing", "delay", "stall")
WELL = "well"
ODD_NUMBERS = (
    0.0,
    -0.0,
    5e-324,
    1e-9,
    0.7,
    -3.0,
    4.999,
    5.001,
    1e3,
    1e9,
    1e154,
    1e308,
    -1e308,
    np.nan,
    np.inf,
)
ODD_STAMPS_NS = (-(2**63), -1, 0, 1, 2**31 * 10**9, 2**63 - 1)


class DrawnArm:
    """An arm of one of the kinds, at some posture (J,) [rad]."""

    def __init__(
        self, kind: str, posture: Vector, settings: Settings, random: np.random.Generator
    ) -> None:
        self.kind = kind
        self._random = random
        self._names = settings.joints.names
        self._hz = settings.rate_hz
        self._joints = posture.copy()
        self._commands = [posture.copy()]
        self._velocities = np.zeros(len(posture))
        self._drift = np.zeros(len(posture))

    def follow(self, frame: Frame) -> None:
        """Take a command."""
        if frame["commanded"]:
            self._commands.append(frame["joints"])
        self._velocities = frame["joint_velocities"]

    def events(self, tick: int, stamp_ns: int) -> list[Event]:
        """Move by one tick; returns at most one joint state."""
        kind = self.kind
        random = self._random
        target = self._commands[-1]
        count = len(self._names)
        if kind == "delay":  # 20 ticks
            target = self._commands[-min(20, len(self._commands))]
        if kind == "stall" and int(tick / (0.9 * self._hz)) % 4 == 3:
            target = self._joints
        self._joints = self._joints + (0.25 if kind == "lag" else 1.0) * (target - self._joints)
        joints = self._joints
        velocities = self._velocities
        names = self._names
        if kind == "noise":
            joints = joints + random.normal(0, 0.003, count)
            velocities = velocities + random.normal(0, 0.05, count)
        if kind == "drift":
            self._drift = np.clip(self._drift + random.normal(0, 0.0002, count), -0.08, 0.08)
            joints = joints + self._drift
        if kind == "jumps" and random.random() < 0.002:
            joints = joints + random.normal(0, 0.3, count)
        if kind == "joint missing" and random.random() < 0.3:
            names = names[1:]
            joints = joints[1:]
            velocities = velocities[1:]
        if kind == "odd numbers" and random.random() < 0.05:
            joints = joints.copy()
            velocities = velocities.copy()
            joint = random.integers(count)
            joints[joint], velocities[joint] = random.choice(ODD_NUMBERS, 2)
            stamp_ns = (
                ODD_STAMPS_NS[random.integers(len(ODD_STAMPS_NS))]
                if random.random() < 0.3
                else stamp_ns
            )
        if kind == "gaps" and tick // 200 % 5 == 4:
            return []
        state = JointState(stamp_ns, names, tuple(joints.tolist()), tuple(velocities.tolist()))
        return [Event("joints/state", b"", state)]
