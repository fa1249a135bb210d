"""Positions of a skill or of its via-points that are out of the arm's reach."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import clamp
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import Settings, urdf_path
from thirdhand.settings.reachable import workspace_of
from thirdhand.settings.urdf import Urdf
from thirdhand.skills.skill_file import StoredSkill

REFUSED_SHARE = 0.5  # a skill is refused if a larger share of its positions is out of reach
RETAUGHT_M = 0.15  # a task's via-point that is out of reach by less can be taught anew
NOTED_M = 0.0005  # a target that is held back by less is within reach
ANYWHERE = np.array([[-math.inf] * 3, [math.inf] * 3])  # [m] box without limits


class OutOfReach(NamedTuple):
    """A warning about positions out of reach, empty if there are none, and whether the skill is
    refused for them.
    """

    text: str
    is_refused: bool


def out_of_reach(skill: StoredSkill, distances_m: Vector, settings: Settings) -> OutOfReach:
    """The verdict on a skill whose tool positions have these distances (M,) [m], see `beyond_m`."""
    number = int(np.count_nonzero(distances_m))
    total = len(distances_m)
    if not number:
        return OutOfReach("", is_refused=False)
    lost = np.count_nonzero(distances_m > (RETAUGHT_M if skill.model.names else 0.0))
    is_refused = bool(lost > REFUSED_SHARE * total)
    if is_refused:
        remedy = (
            "Learn a skill from demonstrations within reach; or move the arm, or change [reach] if "
            "it is wrong"
        )
    else:
        remedy = "The tool stops at the edge of its reach there" + (
            ": teach these via-points anew within reach (thirdhand via-points add)"
            * bool(skill.model.names)
        )
    return OutOfReach(
        f"{number} of {total} positions of the tool in skill {skill.name!r} are out of the arm's "
        f"reach, the farthest by {distances_m.max():.3f} m: {accepted(settings)}. {remedy}",
        is_refused,
    )


def accepted(settings: Settings) -> str:
    """The arm's reach in words."""
    reach = settings.reach
    centre = ", ".join(f"{value:g}" for value in reach.centre)
    return (
        f"{reach.inner:g} to {reach.outer:g} m from the shoulder ({centre}), x ≥ {reach.min_x:g} m "
        f"and z ≥ {reach.min_z:g} m accepted, where the joints' limits allow it"
    )


def beyond_m(settings: Settings, positions: Vector) -> Vector:
    """The distances (M,) [m] of positions (M, 3) from `[reach]` or from the joints' workspace,
    whichever is larger; 0 within both.
    """
    joints = settings.joints
    still = np.zeros(3)
    held = [
        clamp(position, still, still, box=ANYWHERE, reach=settings.reach).position
        for position in positions
    ]
    chain = Urdf(description(urdf_path(settings), cover=False)).chain(settings.arm.plate)
    workspace = workspace_of(chain, joints.lower, joints.upper, settings.tool.plate_from_tool)
    distances = np.linalg.norm(positions - np.reshape(held, positions.shape), axis=1)
    return np.maximum(np.where(distances > NOTED_M, distances, 0.0), workspace.beyond(positions))
