"""Setpoints that follow targets, checked in each step."""

from __future__ import annotations

import numpy as np

from support.explained import Explained
from support.wam import STATE
from thirdhand.core.codes import SetpointBound
from thirdhand.core.frame import Record, Vector, blank
from thirdhand.core.setpoint.bounds import broken_bound
from thirdhand.core.setpoint.stage import SetpointGenerator
from thirdhand.core.skill.model import Target
from thirdhand.settings.config import Settings, ToolSettings

PERIOD_S = 0.002
TOOL = ToolSettings(engage_speed=0.0)  # full speed from the start; engaging has its own tests
BOX = np.array([[0.2, -0.6, 0.05], [1.0, 0.6, 0.8]])
MIDDLE = np.array([0.6, 0.0, 0.4])
FREE = np.zeros((3, 3, 7))  # no joint limits


def at_rest(position: Vector | tuple[float, ...]) -> Vector:
    """A motion (3, 3) at rest at a position."""
    return np.array([position, (0.0,) * 3, (0.0,) * 3])


def name_of_broken_bound(generator: SetpointGenerator, state: Record, before: Vector) -> str:
    """Name of the bound that a step from `before` (3, 3) broke; empty if there is none."""
    limits = generator.limits(state)[0]
    bound = SetpointBound(broken_bound(state["setpoint"], before, state["hull"], BOX, limits))
    return bound.name.lower().replace("_", " ") if bound else ""


def driven(
    targets: list[Vector],
    *,
    start: Vector | None = None,
    tool: ToolSettings = TOOL,
    costs: Vector = FREE,
    rate_hz: int = 500,
) -> tuple[Vector, Vector]:
    """Setpoints (1 + T, 3, 3) that follow targets (3, 3), one a tick, and the results of the steps.

    The bounds are asserted in each step.
    """
    generator = Explained(Settings(tool=tool, rate_hz=rate_hz))
    state = blank(STATE)
    generator.begin(state, at_rest(targets[0][0]) if start is None else start)
    out = [state["setpoint"].copy()]
    results = []
    for target in targets:
        before = state["setpoint"].copy()
        generator.engage(state, target[0])
        results.append(generator.step(state, Target(*target, clamped=False), BOX, costs, 1.0))
        assert name_of_broken_bound(generator, state, before) == ""
        out.append(state["setpoint"].copy())
    return np.array(out), np.array(results)
