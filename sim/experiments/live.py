"""The closed loop in real time: the service as a process of its own, the bench beside it, Zenoh
between them.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import msgspec

from service.client import Client, open_session
from service.launch import launched
from sim.experiments.rehearsal import NOISE_M, TOLERANCE_M, TREMOR_M
from sim.experiments.results import ExperimentError
from sim.experiments.scenes import OFFSET_M, Drawn
from sim.network import RunReport

TIMEOUT_S = 120.0


def live_run(drawn: Drawn, folder: Path, *, taught: bool = True, record: bool = False) -> RunReport:
    """The bench's report of one scene through a service of its own. Raises ExperimentError.

    With `record` its recording and Rerun file go into `folder`. If not `taught`, the skill is as it
    was learned.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,  # nothing taught from before
        launched(Path(scratch), "--arm", "state", record=folder if record else None) as service,
    ):
        with open_session(connect=[service.endpoint]) as session:
            if taught:
                Client(session).add(drawn.scene.via_points(), tolerance=TOLERANCE_M)
            report = msgspec.json.decode(_bench(service.endpoint, drawn), type=RunReport)
        service.stop()
    return report


def _bench(endpoint: str, drawn: Drawn) -> str:
    """The bench's report of one run as JSON: a process, as a user would start it."""
    command = [
        sys.executable,
        "-m",
        "sim",
        "--connect",
        endpoint,
        "--once",
        "--json",
        "-",
        "--seed",
        str(drawn.seed),
        "--speed",
        str(drawn.speed),
    ]
    command += [
        "--offset-mm",
        str(1000 * OFFSET_M),
        "--tremor-mm",
        str(1000 * TREMOR_M),
        "--noise-mm",
        str(1000 * NOISE_M),
    ]
    for pause in drawn.pauses:
        command += ["--turn" if pause.depth > 1 else "--pause", str(pause.at_s), str(pause.lasts_s)]
    places = "".join(f"{name} = {list(getattr(drawn.scene, name))}\n" for name in ("handover", "glass", "soldering"))
    with tempfile.TemporaryDirectory() as scratch:
        scene = Path(scratch) / "scene.toml"
        scene.write_text(places)
        done = subprocess.run(
            [*command, "--scene", str(scene)], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    if done.returncode != 0:
        raise ExperimentError(f"the bench ended with code {done.returncode}: {done.stderr.strip()}")
    return next(line for line in done.stdout.splitlines() if line.startswith("{"))
