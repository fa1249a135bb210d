"""Faults, each caused for real while the tool is fast: time to rest, path until then, and lost
ticks.

Service, scribe, skill worker, tracker and network are processes; PyBullet is the arm. The
experiment measures the decision to stop (from the recording), the time at which the tool came to
rest and its path until then (from the arm), the commanded path (from the commands that left the
service), and the ticks that the recording lacks.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np

from thirdhand.client import RefusedError
from thirdhand.contract import cdr
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.arm.stage import ArmStage
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings, robot_description
from thirdhand.workbench.report.columns import read
from thirdhand_sim.faulty_cell import Command, Fault, FaultTimes, FaultyCell, Network
from thirdhand_sim.lab.results import DESIRED, REFERENCE, TOOL_COLOUR, Options, Results, pyplot
from thirdhand_sim.parts import PartError
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import Array

STANDS_M = 0.001  # a tool that stays within this distance of its end is at rest
DISK_MB = 64
# the figure shows this time around a fault
BEFORE_FAULT_S = 0.3
AFTER_S = 1.0
SCRIBE_SILENT_S = 8.0  # time in which a stopped scribe is replaced, and the new one writes
Act = Callable[[FaultyCell], None]


def _signal(part: str, number: int) -> Act:
    return lambda cell: getattr(cell, part).send(number)


def _begin_anew(part: str) -> Act:
    return lambda cell: getattr(cell, part).again()


def _and_reset(mend: Act) -> Act:
    """An act that repairs, and then resets a service in fault, as an operator would."""

    def mend_and_reset(cell: FaultyCell) -> None:
        mend(cell)
        if cell.client.wait_until_ready().mode == "fault":
            cell.client.reset()

    return mend_and_reset


def _stop_or_kill(what: str, number: int) -> Act:
    return lambda cell: os.kill(cell.child(what), number)


def _kill_the_service(cell: FaultyCell) -> None:
    cell.service.process.kill()


def _end_the_service(cell: FaultyCell) -> None:
    cell.service.process.terminate()


def _kill_the_workshop_at_work(cell: FaultyCell) -> None:
    skill_worker = cell.child("skill worker")
    # its work cannot end before it is killed
    os.kill(skill_worker, signal.SIGSTOP)
    threading.Timer(0.2, os.kill, [skill_worker, signal.SIGKILL]).start()
    place = {
        "name": "p",
        "left": [0.62, -0.28, 0.3],
        "right": [0.98, 0.32, 0.06],
        "tool": [0.54, -0.28, 0.38],
    }
    with contextlib.suppress(RefusedError):
        cell.client.ask("via_points", {"op": "add", "points": [place]})


def _remove_the_folder(cell: FaultyCell) -> None:
    shutil.rmtree(cell.records)


def _fill_the_disk(cell: FaultyCell) -> None:
    with contextlib.suppress(OSError), (cell.folder / "ballast").open("wb", buffering=0) as file:
        while file.write(bytes(65536)):
            pass


def _empty_the_disk(cell: FaultyCell) -> None:
    (cell.folder / "ballast").unlink()
    _until_recorded(cell)


def _until_recorded(cell: FaultyCell) -> None:
    cell.until(
        lambda: cell.client.status().scribe["state"] == "recording", "nothing was recorded again"
    )


KILL = signal.SIGKILL
STOP = signal.SIGSTOP
CONT = signal.SIGCONT
FAULTS = {
    "tracker killed": Fault(_signal("tracker", KILL), _begin_anew("tracker")),
    "tracker frozen": Fault(_signal("tracker", STOP), _signal("tracker", CONT)),
    "tracker repeats its last sample": Fault(
        _signal("tracker", signal.SIGUSR1), _begin_anew("tracker")
    ),
    "clock of the tracker set back": Fault(_signal("tracker", signal.SIGUSR2), stops=False),
    "clock of the tracker set ahead": Fault(_signal("tracker", signal.SIGUSR2), stops=False),
    "network to the tracker silent": Fault(
        _signal("to_tracker", STOP), _signal("to_tracker", CONT)
    ),
    "network to the tracker torn": Fault(_signal("to_tracker", KILL), _begin_anew("to_tracker")),
    "network to the arm silent": Fault(
        _signal("to_arm", STOP), _and_reset(_signal("to_arm", CONT))
    ),
    "network to the arm torn": Fault(_signal("to_arm", KILL), _and_reset(_begin_anew("to_arm"))),
    "skill worker killed": Fault(_kill_the_workshop_at_work, stops=False),
    "scribe killed": Fault(
        _stop_or_kill("scribe", KILL), _until_recorded, stops=False, lasts_s=3.0
    ),
    "scribe stopped": Fault(
        _stop_or_kill("scribe", STOP), _until_recorded, stops=False, lasts_s=SCRIBE_SILENT_S
    ),
    "disk full": Fault(_fill_the_disk, _empty_the_disk, stops=False, lasts_s=3.0),
    # This fault must be the last one in its cell, as it ends the service.
    "service killed": Fault(_kill_the_service, FaultyCell.begin_service),
    # This fault must be the first one in its cell, as it removes the recordings.
    "recording folder removed": Fault(
        _remove_the_folder, _until_recorded, stops=False, network="router", lasts_s=3.0
    ),
    "cable pulled": Fault(
        lambda cell: cell.link.set("down"),
        _and_reset(lambda cell: cell.link.set("up")),
        network="link",
    ),
    "router killed": Fault(
        _signal("router", KILL), _and_reset(_begin_anew("router")), network="router"
    ),
    "service asked to end": Fault(_end_the_service, FaultyCell.begin_service, network="router"),
}
SHORT = (
    "tracker frozen",
    "network to the arm silent",
    "scribe killed",
    "service killed",
    "router killed",
    "cable pulled",
)


class Recorded:
    """Mode and reason of each tick in the recordings of a folder."""

    def __init__(self, folder: Path) -> None:
        recorded = [read(Recording.open(path)).frames for path in sorted(folder.glob("*.mcap"))]
        self.ticks, self.modes, self.reasons = (
            np.concatenate([np.empty(0, np.int64), *(frames[name] for frames in recorded)]).astype(
                np.int64
            )
            for name in ("tick", "mode", "reason")
        )

    def first_stop(self, after: int) -> tuple[int, str] | None:
        """The first tick after a given one in which the arm did not follow, and its reason."""
        indices = np.flatnonzero((self.ticks > after) & (self.modes != Mode.FOLLOW))
        if not len(indices):
            return None
        return int(self.ticks[indices[0]]), Reason(int(self.reasons[indices[0]])).name.lower()

    def stopped(self, after: int, until: int) -> int:
        """The number of ticks in which the arm did not follow."""
        return int(
            ((self.ticks > after) & (self.ticks <= until) & (self.modes != Mode.FOLLOW)).sum()
        )


def way_to_rest(times: Array, places: Array) -> tuple[float, float]:
    """Time at which a point came to rest [s], and its path until then [m], from times (T,) and
    positions (T, 3) between an event and the end of observation.
    """
    far = np.flatnonzero(np.linalg.norm(places - places[-1], axis=1) > STANDS_M)
    rest_index = min(int(far[-1]) + 1, len(times) - 1) if len(far) else 0
    return float(times[rest_index]), float(
        np.linalg.norm(np.diff(places[: rest_index + 1], axis=0), axis=1).sum()
    )


def figures(
    cell: FaultyCell, event: FaultTimes, fault: Fault, recorded: Recorded, steps: Array
) -> dict[str, Any]:
    """The figures of one fault; `steps` (T, 5) are the arm's: time [s], tool [m], speed [m/s]."""
    period_ms = 1e3 * cell.settings.period_s
    until = event.mended_s if fault.stops else event.ended_s
    mine = steps[(steps[:, 0] >= event.struck_s) & (steps[:, 0] <= until)]
    commands = [command for command in cell.commands if event.struck_s <= command[0] <= until]
    stop = recorded.first_stop(event.tick)
    hold_ms = None if stop is None else (stop[0] - event.tick) * period_ms
    if hold_ms is not None and hold_ms > 1e3 * (until - event.struck_s):
        hold_ms = None  # the hold belongs to a later event
    numbers: dict[str, Any] = {
        "hold_ms": hold_ms,
        "reason": None if stop is None or hold_ms is None else stop[1],
        "lost_ticks": event.lost
        if event.lost >= 0
        else sum(entry[1] > recorded.ticks.max() for entry in cell.commands),
        "speed_m_per_s": float(mine[0, 4]),
        "fastest_m_per_s": float(
            steps[(steps[:, 0] >= event.struck_s) & (steps[:, 0] <= event.ended_s), 4].max()
        ),
        "arm_largest_gap_ms": 1e3 * float(np.diff(mine[:, 0]).max()),
    }
    if fault.stops:
        at_s, path_m = way_to_rest(mine[:, 0], mine[:, 1:4])
        numbers |= {
            "rest_ms": 1e3 * (at_s - event.struck_s),
            "travelled_mm": 1e3 * path_m,
            "commanded_mm": 1e3 * _commanded(commands, cell.settings),
            "speed_at_the_end_m_per_s": float(mine[-1, 4]),
            "moves_again_ms": 1e3 * (event.moving_s - event.mended_s),
        }
    else:
        numbers |= _gaps(cell, event, commands)
        numbers["held_ms"] = period_ms * recorded.stopped(event.tick, commands[-1][1])
    return numbers


def _gaps(cell: FaultyCell, event: FaultTimes, commands: list[Command]) -> dict[str, float]:
    """The gaps [s] between commands, as figures in ms, while a fault lasts and before it."""
    gaps = np.diff([event.struck_s, *(command[0] for command in commands)])
    arrivals = np.array([command[0] for command in cell.commands])
    is_before = (arrivals < event.struck_s) & (arrivals > event.struck_s - BEFORE_FAULT_S)
    return {
        "command_largest_gap_ms": 1e3 * float(gaps.max()),
        "command_mean_gap_ms": 1e3 * float(gaps.mean()),
        "command_mean_gap_before_ms": 1e3 * float(np.diff(arrivals[is_before]).mean()),
    }


def _commanded(told: list[Command], settings: Settings) -> float:
    """Path of the tool by the commands [m]."""
    if len(told) < 2:
        return 0.0
    arm = ArmStage(settings, robot_description(settings))
    places = np.array(
        [arm.at(np.array(cdr.decode_joints(payload).position)).position for _, _, payload in told]
    )
    return way_to_rest(np.arange(len(places), dtype=np.float64), places)[1]


@contextlib.contextmanager
def disk() -> Iterator[tuple[Path, bool]]:
    """A folder for a cell; on a small disk of its own where mounting is allowed, and whether."""
    with tempfile.TemporaryDirectory() as scratch:
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", scratch]
        allowed = subprocess.run(mount, capture_output=True, check=False).returncode == 0
        try:
            yield Path(scratch), allowed
        finally:
            if allowed:
                subprocess.run(["umount", "--lazy", scratch], check=True, timeout=10)


@dataclass
class Suffered:
    """Figures of faults by name, the tool's speed around each (T, 2) [s, m/s], the number of
    commands that are neither recorded nor counted as lost, and the number of faults that were not
    injected.
    """

    figures: dict[str, dict[str, Any]] = field(default_factory=dict)
    speeds: dict[str, Array] = field(default_factory=dict)
    unaccounted: int = 0
    unasked: int = 0


def suffered(
    names: Sequence[str],
    say: Callable[[str], None] = lambda line: None,
    settings: Settings | None = None,
    seed_offset: int = 0,
) -> Suffered:
    """The results of some faults, each caused once, in a cell with some settings.

    Raises FaultError, LaunchError and PartError.
    """
    result = Suffered()
    for network in get_args(Network):
        mine = [name for name in FAULTS if name in names and FAULTS[name].network == network]
        with disk() as (folder, bounded):
            if not bounded and "disk full" in mine:
                mine.remove("disk full")
                say("disk full: mounting a small disk is not allowed here, left out")
            try:
                if mine:
                    seed = Scene().seed + seed_offset
                    cell = FaultyCell(folder, network=network, settings=settings, seed=seed)
                    _suffer(result, mine, cell, say)
            except PartError as error:
                if network != "link":
                    raise
                say(f"cable pulled: left out, as a network namespace is not allowed here: {error}")
    return result


def _suffer(
    result: Suffered, names: Sequence[str], cell: FaultyCell, say: Callable[[str], None]
) -> None:
    """Cause some faults in one running cell, and add their results."""
    events: list[FaultTimes] = []
    with cell:
        for name in names:
            say(name)
            events.append(cell.suffer(name, FAULTS[name]))
        cell.close()
        recorded = Recorded(cell.records)
        steps = np.array(cell.arm.steps)
    result.unasked += cell.unasked
    for event in events:
        result.figures[event.fault] = figures(cell, event, FAULTS[event.fault], recorded, steps)
        near = steps[
            (steps[:, 0] > event.struck_s - BEFORE_FAULT_S)
            & (steps[:, 0] < event.struck_s + AFTER_S)
        ]
        result.speeds[event.fault] = np.column_stack([near[:, 0] - event.struck_s, near[:, 4]])
    recorded_ticks = set(recorded.ticks.tolist())
    missing = sum(tick not in recorded_ticks for _, tick, _ in cell.commands)
    result.unaccounted += max(
        0, missing - sum(result.figures[name]["lost_ticks"] for name in names)
    )


def table(found: dict[str, dict[str, Any]]) -> str:
    """The figures as a table of text."""
    rows = [
        f"{'':<32}{'holds':>8}{'at rest':>9}{'travelled':>11}{'commanded':>11}"
        f"{'lost':>7}{'moves again':>13}"
    ]
    rows += [f"{'':<32}{'ms':>8}{'ms':>9}{'mm':>11}{'mm':>11}{'ticks':>7}{'ms':>13}"]
    for name, numbers in found.items():
        values = (
            numbers.get(key)
            for key in (
                "hold_ms",
                "rest_ms",
                "travelled_mm",
                "commanded_mm",
                "lost_ticks",
                "moves_again_ms",
            )
        )
        cells = ("-" if value is None else f"{value:.0f}" for value in values)
        rows.append(
            f"{name:<32}"
            + "".join(f"{cell:>{w}}" for cell, w in zip(cells, (8, 9, 11, 11, 7, 13), strict=True))
        )
    return "\n".join(rows)


def run(results: Results, options: Options) -> dict[str, Any]:
    """The figures of every fault, or of a few for a quick look."""
    came = suffered(
        list(FAULTS) if options.share == 1 else SHORT,
        results.say,
        cell_of(options.arm),
        options.seed_offset,
    )
    print(table(came.figures), flush=True)
    _draw(results, came)
    return {
        "faults": came.figures,
        "unaccounted_ticks": came.unaccounted,
        "unasked_faults": came.unasked,
        "load": os.getloadavg()[0],
    }


def _draw(results: Results, came: Suffered) -> None:
    stopping = [name for name in came.speeds if FAULTS[name].stops]
    figure, grid = pyplot().subplots(
        -(-len(stopping) // 3),
        3,
        figsize=(9, 1.9 * -(-len(stopping) // 3)),
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    for axes, name in zip(grid.flat, stopping, strict=False):
        speed = came.speeds[name]
        numbers = came.figures[name]
        axes.plot(1e3 * speed[:, 0], speed[:, 1], color=TOOL_COLOUR)
        axes.axvline(0, color=REFERENCE, linewidth=0.8)
        if numbers["hold_ms"] is not None:
            axes.axvline(numbers["hold_ms"], color=DESIRED, linewidth=0.8, linestyle="--")
        axes.set_title(f"{name}: {numbers['travelled_mm']:.0f} mm", fontsize=9)
    for axes in grid.flat[len(stopping) :]:
        axes.set_visible(False)
    figure.supxlabel("ms after the fault; dashed: the service decides to stop", fontsize=9)
    figure.supylabel("tool, m/s", fontsize=9)
    results.figure(figure)
