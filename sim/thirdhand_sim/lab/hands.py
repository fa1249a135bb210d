"""The soldering task driven by two hands, through the running service in real time (the paper,
section III-C, Figures 4 and 5).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thirdhand.contract.records import Mode
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.workbench.cli.view import convert
from thirdhand.workbench.report.columns import read
from thirdhand_sim.bench import Bench
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.load.live import SKIPPED, is_evidence, steady_run
from thirdhand_sim.lab.reached import EVENTS, ours
from thirdhand_sim.lab.rehearsal import demonstrated, rehearse
from thirdhand_sim.lab.reproduction.beside_the_paper import differences
from thirdhand_sim.lab.results import (
    LEFT_COLOUR,
    RIGHT_COLOUR,
    TOOL_COLOUR,
    Array,
    Options,
    Results,
    equal_box,
    pyplot,
)
from thirdhand_sim.lab.scenes import Drawn
from thirdhand_sim.network import RunReport
from thirdhand_sim.scene import Scene
from thirdhand_sim.world import pixels

[HANDS_SEED] = EXPERIMENTS["hands"].seeds.evaluation["hands"].numbers
NOMINAL = Drawn(Scene(), 1.0, (), HANDS_SEED)
MOVED = Drawn(
    Scene(handover=(0.56, -0.20, 0.38), glass=(0.42, 0.30, 0.24), soldering=(0.68, 0.09, 0.10)),
    1.0,
    (),
    HANDS_SEED,
)
MOVING_M_S = 0.05  # a hand that has reached this speed has started
# rates of the paths in the figure, and of their recordings
DRAWN_HZ = 20
SERVICE_HZ = 500
CAMERA_EYE = (1.45, -0.95, 0.85)
CAMERA_TARGET = (0.57, 0.03, 0.24)
SIZE = (640, 480)
SCENE_THINGS = {
    "board": "board",
    "glass": "magnifying glass",
    "iron": "soldering iron",
    "solder": "solder",
}
DRAWN = {"reproduction": "dotted: as learned", "adaptation": "solid: adapted"}


class Traces(NamedTuple):
    """Left hand, right hand and tool (T, 3) [m]."""

    left: Array
    right: Array
    tool: Array


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    scratch = results.folder / "hands-live"
    runs: dict[str, tuple[RunReport | None, Traces]] = {}
    tries: dict[str, int] = {}
    for name, of_stream, taught in (
        ("reproduction", NOMINAL, False),
        ("nominal", NOMINAL, True),
        ("adaptation", MOVED, True),
    ):
        drawn = of_stream._replace(seed=of_stream.seed + options.seed_offset)
        # quick look: in process
        if options.share < 1:
            runs[name] = (None, _in_process(drawn, taught=taught))
            continue
        ran, attempts = steady_run(drawn, scratch, taught=taught, record=True)
        recording = next(scratch.glob("*.mcap")).replace(results.folder / f"hands-{name}.mcap")
        convert(
            recording,
            results.folder / ("hands.rrd" if name == "adaptation" else f"hands-{name}.rrd"),
        )
        runs[name] = (ran, _recorded(recording))
        tries[name] = attempts
        results.say(f"{name} over Zenoh, attempt {attempts}: {_numbers(ran)}")
    if scratch.is_dir():
        scratch.rmdir()
    _draw_stages(results)
    numbers = {
        "moved_cm": {
            n: 100
            * float(np.linalg.norm(np.subtract(getattr(MOVED.scene, n), getattr(Scene(), n))))
            for n in ("handover", "glass", "soldering")
        },
        "attempts": tries,
        "evidence_is_periods_skipped_at_most": SKIPPED,
        **{name: _numbers(ran) for name, (ran, _) in runs.items() if ran is not None},
        "beside_the_paper": differences(options.share, options.seed_offset),
        "shown": {
            name: {part: line.round(3).T for part, line in traces._asdict().items()}
            for name, (_, traces) in runs.items()
            if name in DRAWN
        },
    }
    draw_numbers(results, numbers)
    return numbers


def _numbers(ran: RunReport) -> dict[str, Any]:
    return {
        "success": ran.success,
        **{f"{name}_mm": getattr(ran.events, name).error_mm for name in EVENTS},
        "latency_p99_ms": ran.latency_ms.p99,
        "periods_skipped_by_bench": ran.skipped,
        "evidence": is_evidence(ran.skipped),
    }


def _recorded(path: Path) -> Traces:
    frames = read(Recording.open(path)).frames
    following = frames[frames["mode"] == Mode.FOLLOW]
    moving = np.linalg.norm(following["hand_velocities"], axis=2).max(axis=1) > MOVING_M_S
    shown_frames = following[int(np.argmax(moving)) :: SERVICE_HZ // DRAWN_HZ]
    return Traces(shown_frames["hands"][:, 0], shown_frames["hands"][:, 1], shown_frames["tool"])


def _in_process(drawn: Drawn, *, taught: bool) -> Traces:
    skill = shipped_skill()
    adapt = ours(drawn.scene) if taught else lambda bench: skill
    rehearsal = rehearse(drawn.script(), adapt, rate_hz=250, keep=True)
    began = int(np.argmax(rehearsal.time_s > 0))
    stride = 250 // DRAWN_HZ
    return Traces(
        rehearsal.hands[began::stride, 0],
        rehearsal.hands[began::stride, 1],
        rehearsal.tool[began::stride],
    )


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the paths of hands and tool. The figure of the stages needs more than the
    numbers.
    """
    runs = {
        name: Traces(*(np.array(paths[part]).T for part in Traces._fields))
        for name, paths in numbers["shown"].items()
    }
    plt = pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5.8), subplot_kw={"projection": "3d"})
    everything = []
    for demonstration in demonstrated():
        traces = Traces(
            demonstration.hands[:, :3], demonstration.hands[:, 3:], demonstration.tool[:, :3]
        )
        everything += list(traces)
        _trace(left, traces, "-", 1.0)
    left.set_title("(a) five demonstrations", loc="left", fontsize=9)
    for name, style, width in (("reproduction", ":", 1.6), ("adaptation", "-", 1.6)):
        everything += list(runs[name])
        _trace(right, runs[name], style, width)
    lines = [f"{words}{_mark(numbers.get(name))}" for name, words in DRAWN.items()]
    right.set_title("\n".join(("(b) through the service", *lines)), loc="left", fontsize=9)
    for place in (MOVED.scene.offer, MOVED.scene.glass, MOVED.scene.carry):
        right.scatter(*place, s=70, facecolors="none", edgecolors="black", linewidths=1.2)
    for axes in (left, right):
        equal_box(axes, np.concatenate(everything))
        axes.view_init(elev=28, azim=-122)
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.tick_params(labelsize=7)
    handles = [
        plt.Line2D([], [], color=c, label=n)
        for c, n in (
            (LEFT_COLOUR, "left hand"),
            (RIGHT_COLOUR, "right hand"),
            (TOOL_COLOUR, "robot's tool"),
        )
    ]
    handles += [
        plt.Line2D([], [], color="black", marker=m, lw=0, label=n)
        for m, n in (("*", "start"), ("+", "end"))
    ]
    places = "new places for the tool: handover, glass, over the board"
    handles.append(
        plt.Line2D([], [], color="black", marker="o", mfc="none", lw=0, ms=8, label=places)
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    results.figure(figure)


def _mark(ran: dict[str, Any] | None) -> str:
    """The note on a run that is no evidence."""
    if ran is None:
        return ", in process"
    skipped = ran["periods_skipped_by_bench"]
    return (
        ""
        if is_evidence(skipped)
        else f"; NO EVIDENCE: {skipped} periods skipped, {SKIPPED} at most"
    )


def _trace(axes: Any, traces: Traces, style: str, width: float) -> None:
    for line, colour in zip(traces, (LEFT_COLOUR, RIGHT_COLOUR, TOOL_COLOUR), strict=True):
        axes.plot(*line.T, style, color=colour, lw=width)
        axes.plot(*line[:1].T, "*", color=colour, ms=7)
        axes.plot(*line[-1:].T, "+", color=colour, ms=9, mew=1.8)


def _draw_stages(results: Results) -> None:
    """Pictures of the four stages as in Figure 4, from a run in process."""
    scene = MOVED.scene
    middle = [0.0, *(sum(dwell) / 2 for dwell in scene.dwells)]
    titles = (
        "(a) at the start",
        "(b) the board is handed over",
        "(c) the robot grasps the glass",
        "(d) glass, board and iron in place",
    )
    shots: list[tuple[Any, Any, Traces]] = []
    so_far: list[Array] = []
    things: list[Any] = []

    def look(bench: Bench) -> None:
        observation = bench.observe()
        if bench.time_s > 0:
            so_far.append(
                np.stack(
                    [
                        observation.hands.left.position,
                        observation.hands.right.position,
                        np.array(observation.tool.position),
                    ]
                )
            )
        if len(shots) < len(middle) and bench.time_s > middle[len(shots)]:
            colours, matrix = bench.world.picture(eye=CAMERA_EYE, target=CAMERA_TARGET, size=SIZE)
            path = np.array(so_far)
            if not shots:
                things.extend(
                    bench.world.pose(getattr(bench.world, name)).position for name in SCENE_THINGS
                )
            shots.append((colours, matrix, Traces(path[:, 0], path[:, 1], path[:, 2])))
            so_far.clear()

    rehearse(MOVED.script(), ours(scene), rate_hz=250, look=look)
    plt = pyplot()
    figure, grid = plt.subplots(2, 2, figsize=(9, 6.6))
    for axes, (colours, matrix, traces), title in zip(grid.flat, shots, titles, strict=True):
        axes.imshow(colours)
        for line, colour in zip(traces, (LEFT_COLOUR, RIGHT_COLOUR, TOOL_COLOUR), strict=True):
            if np.ptp(line, axis=0).max() > 0.02:
                pixel_path = pixels(line, matrix, SIZE)
                axes.plot(*pixel_path.T, color=colour, lw=2)
                axes.annotate(
                    "",
                    pixel_path[-1],
                    pixel_path[-max(2, len(pixel_path) // 12 + len(pixel_path) // 8)],
                    arrowprops={
                        "arrowstyle": "-|>",
                        "color": colour,
                        "lw": 2,
                        "mutation_scale": 18,
                    },
                )
        axes.set_title(title, loc="left")
        axes.set_axis_off()
    for pixel, name in zip(
        pixels(np.array(things), shots[0][1], SIZE), SCENE_THINGS.values(), strict=True
    ):
        aside = (-35, 45) if name == "solder" else (25, -38)  # the iron stands behind it
        grid[0, 0].annotate(
            name,
            pixel,
            pixel + np.array(aside),
            fontsize=8,
            arrowprops={"arrowstyle": "-", "lw": 0.8},
        )
    handles = [
        plt.Line2D([], [], color=c, label=n)
        for c, n in (
            (LEFT_COLOUR, "path of the left hand"),
            (RIGHT_COLOUR, "of the right hand"),
            (TOOL_COLOUR, "of the robot's tool"),
        )
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    results.figure(figure, "stages")
