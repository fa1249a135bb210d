"""Measurement of memory and open files of a daemon's processes over time, with recorder, viewer and
a tracker, for `thirdhand bench --soak`.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from service.process.progress import say
from service.settings.config import Settings
from service.timing.loads import running_cell
from service.timing.probe_processes import family

LONGEST_PAUSE_S = 5.0  # maximum interval of samples
FEWEST = 60  # minimum number of samples
WARM_UP = 0.2  # the first 20 % of the duration are not counted
T_95 = 1.96  # half width of a 95 % interval / standard deviation


def run(minutes: float, rate_hz: int, *, settings: Settings | None = None) -> dict[str, Any]:
    """Measure the growth of each process's memory [MB/h] with its interval, open files at start and
    end, and missed deadlines. Raises LoadError and LaunchError.
    """
    say(f"daemon with recorder and viewer, a tracker: {minutes:g} min")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with running_cell(folder, rate_hz, settings=settings) as (service, client):
            processes = family(service.process.pid)
            samples: dict[str, list[tuple[float, float, int]]] = {who: [] for who in processes}
            before, began = client.status(), time.monotonic()
            while (at := time.monotonic() - began) < 60 * minutes:
                for who, process in processes.items():
                    samples[who].append((at, process.memory_info().rss / 1e6, process.num_fds()))
                time.sleep(min(LONGEST_PAUSE_S, 60 * minutes / FEWEST))
            after = client.status()
        return {
            "minutes": minutes,
            "rate_hz": rate_hz,
            "ticks": after.tick - before.tick,
            "missed": after.missed - before.missed,
            "lost": after.scribe["lost"],
            "restarts": after.scribe["restarts"],
            "processes": {who: judged(np.array(values)) for who, values in samples.items()},
            "files": sorted(path.name for path in folder.iterdir() if path.suffix == ".mcap"),
        }


def judged(samples: Any) -> dict[str, Any]:
    """Growth of memory by least squares after the warm-up, and half the width of its 95 % interval.

    The interval is computed from ten blocks, because neighbouring samples are correlated.
    """
    kept = samples[samples[:, 0] >= WARM_UP * samples[-1, 0]]
    hours, memory, files = kept[:, 0] / 3600, kept[:, 1], kept[:, 2]
    slope, level = np.polyfit(hours, memory, 1)
    parts = np.array_split(memory - slope * hours - level, 10)
    spread = np.std([part.mean() for part in parts], ddof=2)
    half = T_95 * spread / (np.std([part.mean() for part in np.array_split(hours, 10)]) * np.sqrt(10))
    return {
        "memory_mb": round(float(memory[-1]), 1),
        "slope_mb_per_h": round(float(slope), 2),
        "interval_mb_per_h": round(float(half), 2),
        "files_open": [int(files[0]), int(files[-1])],
    }


def text(report: dict[str, Any]) -> str:
    """The report as a table in text."""
    lines = [f"  {'':<10}{'memory MB':>10}{'grows MB/h':>16}{'open files':>14}"]
    for who, one in report["processes"].items():
        grows = f"{one['slope_mb_per_h']:+.1f} ± {one['interval_mb_per_h']:.1f}"
        first, last = one["files_open"]
        lines.append(f"  {who:<10}{one['memory_mb']:>10.1f}{grows:>16}{f'{first} -> {last}':>14}")
    share = 100 * report["missed"] / max(1, report["ticks"])
    lines.append(
        f"  {report['minutes']:g} min at {report['rate_hz']} Hz: {report['missed']} of {report['ticks']} deadlines "
        f"missed ({share:.2f} %), {report['lost']} ticks not recorded, {len(report['files'])} files written"
    )
    return "\n".join(lines)
