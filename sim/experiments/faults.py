"""What happens when something fails: each fault struck for real while the tool is fast, and what it
cost.

A service, its scribe and workshop, a tracker, and the network between them are processes; PyBullet
is the arm. Taken are when the service decided to stop (from its recording), when the tool came to
rest and how far it went until then (from the arm), how far it was told to (from the commands that
left the service), and how many ticks the recording lacks.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from service.client import RefusedError
from service.config import Settings, robot_description
from service.contract import cdr
from service.contract.records import Mode, Reason
from service.core.arm import Arm
from service.recorder.recording import Recording
from sim.experiments.results import REFERENCE, SERIES, Options, Results, pyplot
from sim.faulty_cell import WATCHED_S, Event, Fault, FaultyCell
from sim.script import Array

STANDS_M = 0.001  # a tool that stays this near to where it ends has come to rest
DISK_MB = 64
BEFORE_S, AFTER_S = 0.3, 1.0  # around a fault, in the figure
SCRIBE_SILENT_S = 8.0  # until one that is stopped is replaced, and the new one writes
Act = Callable[[FaultyCell], None]


def _signal(part: str, number: int) -> Act:
    return lambda cell: getattr(cell, part).send(number)


def _begin_anew(part: str) -> Act:
    return lambda cell: getattr(cell, part).again()


def _and_reset(mend: Act) -> Act:
    """Mends, then resets the service, as an operator would."""

    def mend_and_reset(cell: FaultyCell) -> None:
        mend(cell)
        cell.until(lambda: cell.client.status()["mode"] == "fault", "the service was not at fault")
        cell.client.ask("reset")

    return mend_and_reset


def _stop_or_kill(what: str, number: int) -> Act:
    return lambda cell: os.kill(cell.child(what), number)


def _kill_the_service(cell: FaultyCell) -> None:
    cell.service.process.kill()


def _kill_the_workshop_at_work(cell: FaultyCell) -> None:
    workshop = cell.child("workshop")
    os.kill(workshop, signal.SIGSTOP)  # so it is at work when it is killed
    threading.Timer(0.2, os.kill, [workshop, signal.SIGKILL]).start()
    place = {"name": "p", "left": [0.62, -0.28, 0.3], "right": [0.98, 0.32, 0.06], "tool": [0.54, -0.28, 0.38]}
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
    cell.until(lambda: cell.client.status()["scribe"]["state"] == "recording", "nothing was recorded again")


def _recording_again(cell: FaultyCell) -> None:
    cell.until(lambda: cell.client.status()["scribe"]["state"] == "recording", "nothing was recorded again")


FAULTS = {
    "tracker killed": Fault(_signal("tracker", signal.SIGKILL), _begin_anew("tracker")),
    "tracker frozen": Fault(_signal("tracker", signal.SIGSTOP), _signal("tracker", signal.SIGCONT)),
    "tracker repeats its last sample": Fault(_signal("tracker", signal.SIGUSR1), _begin_anew("tracker")),
    "network to the tracker silent": Fault(
        _signal("to_tracker", signal.SIGSTOP), _signal("to_tracker", signal.SIGCONT)
    ),
    "network to the tracker torn": Fault(_signal("to_tracker", signal.SIGKILL), _begin_anew("to_tracker")),
    "network to the arm silent": Fault(
        _signal("to_arm", signal.SIGSTOP), _and_reset(_signal("to_arm", signal.SIGCONT))
    ),
    "network to the arm torn": Fault(_signal("to_arm", signal.SIGKILL), _and_reset(_begin_anew("to_arm"))),
    "workshop killed": Fault(_kill_the_workshop_at_work, stops=False),
    "scribe killed": Fault(_stop_or_kill("scribe", signal.SIGKILL), _recording_again, stops=False, lasts_s=3.0),
    "scribe stopped": Fault(
        _stop_or_kill("scribe", signal.SIGSTOP), _recording_again, stops=False, lasts_s=SCRIBE_SILENT_S
    ),
    "recording folder removed": Fault(_remove_the_folder, _recording_again, stops=False, lasts_s=3.0),
    "disk full": Fault(_fill_the_disk, _empty_the_disk, stops=False, lasts_s=3.0),
    "service killed": Fault(_kill_the_service, FaultyCell.begin_service),  # the last: another life begins
    "router killed": Fault(
        _signal("router", signal.SIGKILL), _and_reset(_begin_anew("router")), routed=True
    ),
}


class Recorded:
    """What the recordings in a folder say of each tick: its mode and reason; and those that are
    missing.
    """

    def __init__(self, folder: Path) -> None:
        ticks, modes, reasons = [], [], []
        for path in sorted(folder.glob("*.mcap")):
            for step in Recording.open(path).steps():
                if step.frame is not None:
                    ticks.append(step.tick)
                    modes.append(int(step.frame["mode"]))
                    reasons.append(int(step.frame["reason"]))
        self.ticks, self.modes, self.reasons = (np.array(values, np.int64) for values in (ticks, modes, reasons))

    def first_stop(self, after: int) -> tuple[int, str] | None:
        """The first tick behind one that did not follow, and why."""
        found = np.flatnonzero((self.ticks > after) & (self.modes != Mode.FOLLOW))
        if not len(found):
            return None
        return int(self.ticks[found[0]]), Reason(int(self.reasons[found[0]])).name.lower()


def way_to_rest(times: Array, places: Array) -> tuple[float, float]:
    """When a point came to rest [s] and how far it went until then [m]: times (T,) and places
    (T, 3) from an event to where it surely rests.
    """
    far = np.flatnonzero(np.linalg.norm(places - places[-1], axis=1) > STANDS_M)
    rest = min(int(far[-1]) + 1, len(times) - 1) if len(far) else 0
    return float(times[rest]), float(np.linalg.norm(np.diff(places[: rest + 1], axis=0), axis=1).sum())


def figures(cell: FaultyCell, event: Event, fault: Fault, recorded: Recorded, steps: Array) -> dict[str, Any]:
    """The figures of one fault; `steps` (T, 5) are the arm's: time [s], tool [m], speed [m/s]."""
    period_ms = 1e3 * Settings().period_s
    until = event.mended_s if fault.stops else event.ended_s
    mine = steps[(steps[:, 0] >= event.struck_s) & (steps[:, 0] <= until)]
    told = [entry for entry in cell.commands if event.struck_s <= entry[0] <= until]
    stop = recorded.first_stop(event.tick)
    if stop is not None and (stop[0] - event.tick) * period_ms > 1e3 * (until - event.struck_s):
        stop = None
    found: dict[str, Any] = {
        "hold_ms": None if stop is None else round((stop[0] - event.tick) * period_ms, 1),
        "reason": None if stop is None else stop[1],
        "lost_ticks": event.lost,
        "fastest_m_per_s": float(steps[(steps[:, 0] >= event.struck_s) & (steps[:, 0] <= event.ended_s), 4].max()),
        "arm_largest_gap_ms": 1e3 * float(np.diff(mine[:, 0]).max()),
    }
    if fault.stops:
        at_s, way = way_to_rest(mine[:, 0], mine[:, 1:4])
        found |= {
            "speed_m_per_s": float(mine[0, 4]),
            "rest_ms": 1e3 * (at_s - event.struck_s),
            "travelled_mm": 1e3 * way,
            "commanded_mm": 1e3 * _commanded(told),
            "moves_again_ms": 1e3 * (event.moving_s - event.mended_s),
        }
    else:
        gaps = np.diff([event.struck_s, *(entry[0] for entry in told)])
        found |= {"command_largest_gap_ms": 1e3 * float(gaps.max()), "command_mean_gap_ms": 1e3 * float(gaps.mean())}
    return found


def _commanded(told: list[tuple[float, int, bytes]]) -> float:
    """How far the commands led the tool [m]."""
    if len(told) < 2:
        return 0.0
    arm = Arm(Settings(), robot_description(Settings()))
    places = np.array([arm.at(np.array(cdr.decode_joints(payload).position)).position for _, _, payload in told])
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


def suffered(names: list[str], say: Callable[[str], None] = lambda line: None) -> tuple[dict[str, Any], dict[str, Any]]:
    """The figures of some faults by name, and the tool's speeds around each (T, 2) [s, m/s]."""
    found: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    for routed in (False, True):
        mine = [name for name in FAULTS if name in names and FAULTS[name].routed == routed]
        if mine:
            with disk() as (folder, bounded):
                if not bounded and "disk full" in mine:
                    mine.remove("disk full")
                    say("disk full: mounting a small disk is not allowed here, left out")
                _suffer(folder, mine, routed, found, curves, say)
    return found, curves


def _suffer(
    folder: Path, names: list[str], routed: bool, found: dict[str, Any], curves: dict[str, Any], say: Callable[[str], None]
) -> None:
    events = []
    with FaultyCell(folder, routed=routed) as cell:
        for name in names:
            events.append(cell.suffer(name, FAULTS[name]))
            say(f"{name}: done")
        code = cell.close()
        if code != 0:
            say(f"the service ended with code {code}")
        recorded, steps = Recorded(cell.records), np.array(cell.arm.steps)
    for event in events:
        found[event.fault] = figures(cell, event, FAULTS[event.fault], recorded, steps)
        near = steps[(steps[:, 0] > event.struck_s - BEFORE_S) & (steps[:, 0] < event.struck_s + AFTER_S)]
        curves[event.fault] = np.column_stack([near[:, 0] - event.struck_s, near[:, 4]])
    said = set(recorded.ticks.tolist())
    found.setdefault("unrecorded_commands", 0)
    found["unrecorded_commands"] += sum(tick not in said for _, tick, _ in cell.commands)


def run(results: Results, options: Options) -> dict[str, Any]:
    names = list(FAULTS)
    found, curves = suffered(names, results.say)
    for name, one in found.items():
        print(name, one)
    return {"faults": found}
