"""Cells drawn at random: arm, loop rate, tool, limits, boxes, clearances and assumptions on
hands.
"""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
from msgspec.structs import replace

from support.arms import MODELS, Model, toml_of
from thirdhand.recordings.shipped import cell_of as shipped
from thirdhand.settings.config import Box, Settings, parse

XARM7 = Model("xarm7.urdf", "link7", (0.0, -0.3, 0.0, 1.2, 0.0, 1.5, 0.0))
ENGAGE_SPEEDS_MPS = (0.01, 0.05, 0.15, 0.15, 0.4)
ARMS = ("wam", "ur5", "franka", "panda", "wam", "xarm7")  # shipped arms, and two of other URDFs
RATES_HZ = (100, 125, 250, 333, 500, 500, 500, 1000)
TOOLS_M = ((0.0, 0.0, 0.12), (0.05, 0.0, 0.1), (0.0, 0.0, 0.25), (0.15, -0.1, 0.05))
BOX_CENTRES_M = np.array([[0.2, -0.6, 0.0], [0.9, 0.6, 0.5]])


@cache
def cell_with(arm: str) -> Settings:
    """The cell with this arm, before settings are drawn."""
    if arm in ("panda", "xarm7"):
        return parse(toml_of({**MODELS, "xarm7": XARM7}[arm]), origin=arm)
    return shipped(arm)


def drawn_cell(random: np.random.Generator, arm: str) -> Settings:  # noqa: C901, PLR0912 - a draw for each option
    """A cell with this arm, in which each group of settings is changed with some probability."""
    cell = cell_with(arm)

    def happens(probability: float) -> bool:
        return bool(random.random() < probability)

    def one_of(*values: float) -> float:
        return float(random.choice(values))

    tool = cell.tool
    skill = cell.skill
    hands = cell.hands
    obstacles = cell.obstacles
    people = cell.people
    if happens(0.35):
        tool = replace(tool, orientation="full")
    if happens(0.25):
        tool = replace(
            tool, plate_from_tool=(*TOOLS_M[random.integers(len(TOOLS_M))], 0.0, 0.0, 0.0, 1.0)
        )
    if happens(0.3):
        tool = replace(
            tool,
            max_speed=one_of(0.05, 0.1, 0.3, 0.5),
            max_acceleration=one_of(0.5, 1.0, 2.0, 4.0, 20.0),
            max_jerk=one_of(5.0, 20.0, 100.0, 200.0, 1000.0),
        )
    if happens(0.3):
        tool = replace(tool, follow=("closely", "calmly")[random.integers(2)])
    if happens(0.2):
        tool = replace(
            tool, max_turn_speed=one_of(0.2, 0.5, 2.0), max_turn_acceleration=one_of(0.5, 2.0, 20.0)
        )
    if happens(0.3):
        skill = replace(skill, lead_s=one_of(0.02, 0.1, 0.2, 0.5))
    if happens(0.3):
        hands = replace(hands, unseen_ms=one_of(0.0, 50.0, 100.0, 101.0, 300.0, 1000.0))
    if happens(0.15):
        hands = replace(hands, stale_ms=one_of(20.0, 50.0, 300.0, 1000.0))
    if happens(0.25):
        obstacles = replace(
            obstacles, boxes=tuple(_box(random) for _ in range(random.integers(1, 4)))
        )
    if happens(0.2):
        obstacles = replace(obstacles, clearance=one_of(0.0, 0.005, 0.03, 0.05))
    if happens(0.2):
        people = replace(people, clearance=one_of(0.0, 0.01, 0.06, 0.1))
    if happens(0.1):
        people = replace(people, length=one_of(0.0, 0.4))
    joints = cell.joints
    if happens(0.2):
        limits = ("velocity", "acceleration", "jerk")
        shares = random.uniform(0.1, 1.0, (len(limits), len(joints.names)))
        slower = {
            name: tuple((s * getattr(joints, name)).tolist())
            for name, s in zip(limits, shares, strict=True)
        }
        joints = replace(joints, **slower)
    return replace(
        cell,
        rate_hz=int(random.choice(RATES_HZ)),
        arm=replace(cell.arm, source="assumed" if happens(0.5) else "state"),
        tool=tool,
        skill=skill,
        hands=hands,
        obstacles=obstacles,
        people=people,
        joints=joints,
    )


def _box(random: np.random.Generator) -> Box:
    sizes = random.uniform(0.02, 0.15, 3)
    return Box(
        centre=tuple(random.uniform(*BOX_CENTRES_M).tolist()), half_size=tuple(sizes.tolist())
    )


def changes(cell: Settings, arm: str) -> str:
    """The drawn settings of a cell, as text for failures."""
    default = msgspec.to_builtins(cell_with(arm))
    drawn = msgspec.to_builtins(cell)
    texts = []
    for section, values in drawn.items():
        if isinstance(values, dict):
            changed = {name for name, value in values.items() if value != default[section][name]}
            texts += [f"{section}.{name} = {values[name]}" for name in sorted(changed)]
    return ", ".join(texts)


def engaging_cell(random: np.random.Generator, cell: Settings) -> Settings:
    """A drawn cell with a clutch, whose setpoint engages at a speed drawn at random."""
    speed = min(float(random.choice(ENGAGE_SPEEDS_MPS)), cell.tool.max_speed)
    return replace(
        cell,
        tool=replace(cell.tool, engage_speed=speed),
        hands=replace(cell.hands, clutch="key", gripper="key"),
    )
