"""The tool's orientation predicted with its position: over the board the glass faces the user's
eyes, in places that were never demonstrated too.

The skill is learned from demonstrations that turn the tool, taught places with their orientations,
and followed by the service's core, as any.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import rerun as rr

from kmp.orientation import exp, log, multiplied
from thirdhand.contract.requests import ViaPoint
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reached import ours, taught
from thirdhand_sim.lab.rehearsal import Rehearsed, demonstrated, rehearse
from thirdhand_sim.lab.results import (
    ADAPTED,
    OTHER,
    REFERENCE,
    TOOL,
    Array,
    Options,
    Results,
    pyplot,
    rgb,
)
from thirdhand_sim.lab.scenes import Drawn, draw
from thirdhand_sim.scene import TOOL_ORIENTATION, Scene

EYES = np.array([1.15, 0.0, 0.50])  # [m] the user's eyes, frame base
SCATTER_RAD = 0.03  # deviation of the demonstrated orientations, each axis
COMPONENTS, ELL, PENALTY = 10, 5.0, 2.0  # parameters of the paper's way
SCENES = EXPERIMENTS["orientation"].seeds.evaluation["scenes"]
SEED, RATE_HZ = EXPERIMENTS["orientation"].seeds.evaluation["hands"].seed, 250
WORK_S = 3.0  # the hands stay this long over the board


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    moved = {f"scene {number}": draw(number, seed=SCENES.seed).scene for number in SCENES.share(options.share, least=0)}
    scenes = {"nominal": Scene(), **moved}
    scenes = {
        name: msgspec.structs.replace(scene, dwells_s=(*scene.dwells_s[:2], WORK_S)) for name, scene in scenes.items()
    }
    skill = learn_turning()
    runs: dict[str, Rehearsed] = {}
    for name, scene in scenes.items():
        script = Drawn(scene, 1.0, (), SEED).script()
        there = taught(skill, turned(scene))
        runs[name] = rehearse(script, lambda bench: there, rate_hz=RATE_HZ, keep=True)  # noqa: B023
        results.say(f"{name}: {_measured(runs[name], scene)}")
    nominal = scenes["nominal"]
    fixed = rehearse(Drawn(nominal, 1.0, (), SEED).script(), ours(nominal), rate_hz=RATE_HZ, keep=True)
    _draw(results, runs["nominal"], fixed, nominal)
    _record(results, runs["nominal"])
    return {
        "eyes_m": EYES,
        "scenes": {name: _measured(one, scenes[name]) for name, one in runs.items()},
        "nominal_with_a_constant_orientation": _measured(fixed, nominal),
    }


def facing(scene: Scene) -> Array:
    """The orientation (4,) of a tool over the board whose +z points at the user's eyes: turned the
    shortest way from where it points elsewhere.
    """
    wanted = EYES - np.array(scene.carry)
    wanted /= np.linalg.norm(wanted)
    now = _axis(np.array(TOOL_ORIENTATION))
    turn = np.concatenate([np.cross(now, wanted), [1 + now @ wanted]])
    return multiplied(turn / np.linalg.norm(turn), np.array(TOOL_ORIENTATION))


def learn_turning() -> StoredSkill:
    """The skill of five demonstrations in which the tool turns to the eyes on the way from the
    glass to the board.
    """
    scene = Scene()
    begin, end = scene.segments[2]
    there, back = np.array(TOOL_ORIENTATION), facing(scene)
    whole = log(back[None], there)[0]
    turning = []
    for number, one in enumerate(demonstrated()):
        random = np.random.default_rng([number, SEED])
        u = np.clip((np.arange(len(one.hands)) * one.period_s - begin) / (end - begin), 0, 1)
        share = u**3 * (10 - 15 * u + 6 * u * u)
        off = SCATTER_RAD / 2 * random.standard_normal((2, 3))
        quaternions = exp(share[:, None] * (whole + off[1]) + (1 - share[:, None]) * off[0], there)
        turning.append(one._replace(tool=np.hstack([one.tool[:, :3], quaternions])))
    return learn(turning, name="turning", components=COMPONENTS, ell=ELL, penalty=PENALTY)


def turned(scene: Scene) -> tuple[ViaPoint, ...]:
    """A scene's three via-points with the tool's orientation at each."""
    x, y, z, w = facing(scene).tolist()
    orientations = (TOOL_ORIENTATION, TOOL_ORIENTATION, (x, y, z, w))
    return tuple(
        msgspec.structs.replace(point, orientation=orientation)
        for point, orientation in zip(scene.via_points(), orientations, strict=True)
    )


def _axis(quaternion: Array) -> Array:
    """The tool's +z (..., 3) of quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)


def _angle_deg(a: Array, b: Array) -> Array:
    """Between directions (..., 3), of any length [degrees]."""
    cosine = np.sum(a * b, axis=-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _measured(one: Rehearsed, scene: Scene) -> dict[str, Any]:
    moving = one.time_s > 0
    begin, end = scene.dwells[2]
    over = (one.time_s >= end - 1) & (one.time_s <= end)
    turned = _angle_deg(one.axis, EYES - one.tool) < 10
    return {
        "within_10_deg_after_the_hands_rest_s": float(
            np.min(one.time_s[turned & (one.time_s > begin)], initial=np.inf) - begin
        ),
        "from_the_eyes_in_the_last_second_deg": float(_angle_deg(one.axis[over], EYES - one.tool[over]).mean()),
        "arm_from_predicted_rms_deg": float(
            np.sqrt(np.mean(_angle_deg(one.axis[moving], _axis(one.frames["orientation"][moving])) ** 2))
        ),
        "errors_mm": one.errors_mm,
        "success": one.events.success,
    }


def _draw(results: Results, ours: Rehearsed, fixed: Rehearsed, scene: Scene) -> None:
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1, 1.1))
    moving = ours.time_s > 0
    t = ours.time_s[moving]
    predicted = _axis(ours.frames["orientation"][moving])
    for direction, style, colour, label in (
        (predicted, "--", ADAPTED, "predicted"),
        (ours.axis[moving], "-", TOOL, "the arm's tool"),
        (fixed.axis[fixed.time_s > 0], ":", OTHER, "with a constant orientation"),
    ):
        tool = ours.tool[moving] if len(direction) == len(t) else fixed.tool[fixed.time_s > 0]
        left.plot(t[: len(direction)], _angle_deg(direction, EYES - tool)[: len(t)], style, color=colour, label=label)
    for (begin, end), name in zip(scene.dwells, ("handover", "glass", "over the board"), strict=True):
        left.axvspan(begin, end, color=REFERENCE, alpha=0.2, lw=0)
        left.text((begin + end) / 2, 26, name, rotation=90, ha="center", va="bottom", fontsize=8)
    left.set(
        xlabel="time [s]",
        ylabel="angle between the tool's +z\nand the way to the eyes [°]",
        ylim=(0, None),
        xlim=(0, t[-1]),
    )
    left.legend(frameon=False)
    rows = np.linspace(0, len(t) - 1, 26).round().astype(int)
    tool, axis = ours.tool[moving][rows], ours.axis[moving][rows]
    right.plot(*ours.tool[moving][:, [0, 2]].T, color=TOOL, lw=1)
    right.quiver(
        tool[:, 0], tool[:, 2], axis[:, 0], axis[:, 2], color=TOOL, width=0.005, scale=12, label="the tool and its +z"
    )
    right.plot(*EYES[[0, 2]], "o", color="black", ms=9)
    right.annotate("the user's eyes", EYES[[0, 2]], EYES[[0, 2]] + np.array([-0.03, 0.01]), ha="right")
    right.plot(*np.array(scene.soldering)[[0, 2]], "s", color=REFERENCE)
    right.annotate("board", np.array(scene.soldering)[[0, 2]] + np.array([0.015, 0.0]), va="center")
    right.set_title("seen from the side", fontsize=9)
    right.plot(*np.stack([np.array(scene.carry), EYES])[:, [0, 2]].T, ":", color=REFERENCE)
    right.set(xlabel="x [m]", ylabel="z [m]")
    right.set_aspect("equal", adjustable="datalim")
    right.legend(frameon=False, loc="lower right", fontsize=8)
    results.figure(figure)


def _record(results: Results, one: Rehearsed) -> None:
    stream = results.recording()
    stream.log("/eyes", rr.Points3D([EYES], radii=[0.03], labels=["eyes"]), static=True)
    for k in np.flatnonzero(one.time_s > 0)[::10]:
        stream.set_time("time", duration=float(one.time_s[k]))
        arrow = rr.Arrows3D(origins=[one.tool[k]], vectors=[0.1 * one.axis[k]], colors=[rgb(TOOL)])
        stream.log("/tool", arrow)
        stream.log("/hands", rr.Points3D(one.hands[k], radii=[0.015], colors=[rgb(ADAPTED), rgb(OTHER)]))
    stream.disconnect()
