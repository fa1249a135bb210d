"""The choice of the bench's physics engine: PyBullet if it is installed, else MuJoCo."""

from __future__ import annotations

from thirdhand.daemon.launch import engine_of
from thirdhand_sim.world import World


def world_of(engine: str | None = None) -> type[World]:
    """The world of an engine, by default of the first installed one. Raises LaunchError."""
    if engine_of(engine) == "pybullet":
        from thirdhand_sim.pybullet_world import PyBulletWorld

        return PyBulletWorld
    from thirdhand_sim.mujoco_world import MujocoWorld

    return MujocoWorld
