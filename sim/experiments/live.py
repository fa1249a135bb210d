"""The closed loop in real time: the service as a process of its own, the bench beside it, Zenoh between them."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import msgspec

from service.client import Client, open_session
from sim.experiments.rehearsal import NOISE_M, TOLERANCE_M, TREMOR_M
from sim.experiments.report import ExperimentError
from sim.experiments.scenes import OFFSET_M, Drawn
from sim.live import Report

TIMEOUT_S = 120.0


def live_run(drawn: Drawn, folder: Path, *, taught: bool = True, record: bool = False) -> Report:
    """The bench's report of one scene through a service of its own. Raises ExperimentError.

    With `record` its recording and Rerun file go into `folder`. If not `taught`, the skill is as it was learned.
    """
    with _service(folder, record=record) as endpoint, open_session(connect=[endpoint]) as session:
        if taught:
            Client(session).add(drawn.scene.places(), tolerance=TOLERANCE_M)
        return msgspec.json.decode(_bench(endpoint, drawn), type=Report)


def _bench(endpoint: str, drawn: Drawn) -> str:
    """The bench's report of one run as JSON: a process, as a user would start it."""
    command = [sys.executable, "-m", "sim", "--connect", endpoint, "--once", "--json", "-", "--seed", str(drawn.seed), "--speed", str(drawn.speed)]
    command += ["--offset-mm", str(1000 * OFFSET_M), "--tremor-mm", str(1000 * TREMOR_M), "--noise-mm", str(1000 * NOISE_M)]
    for pause in drawn.pauses:
        command += ["--turn" if pause.depth > 1 else "--pause", str(pause.at_s), str(pause.lasts_s)]
    places = "".join(f"{name} = {list(getattr(drawn.scene, name))}\n" for name in ("handover", "glass", "soldering"))
    with tempfile.TemporaryDirectory() as scratch:
        scene = Path(scratch) / "scene.toml"
        scene.write_text(places)
        done = subprocess.run([*command, "--scene", str(scene)], capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    if done.returncode != 0:
        raise ExperimentError(f"the bench ended with code {done.returncode}: {done.stderr.strip()}")
    return next(line for line in done.stdout.splitlines() if line.startswith("{"))


@contextlib.contextmanager
def _service(folder: Path, *, record: bool) -> Iterator[str]:
    """The endpoint of a daemon on a free port, which ends with the context."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:  # no places from before
        config, log = Path(scratch) / "cell.toml", Path(scratch) / "service.log"
        config.write_text(
            f'[network]\nlisten = ["tcp/127.0.0.1:0"]\n[files]\nstate = {json.dumps(str(Path(scratch) / "state"))}\n'
            + (f"record = {json.dumps(str(folder.absolute()))}\n" if record else "")
        )
        with log.open("w") as errors:
            command = [sys.executable, "-m", "service", "serve", "--config", str(config), "--arm", "state"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
            try:
                assert process.stdout is not None
                said = next((line for line in process.stdout if line.startswith("listening on ")), None)
                if said is None:
                    raise ExperimentError(f"the service did not start: {log.read_text().strip() or 'it gave no reason'}")
                yield said.split()[2].rstrip(",")
                process.send_signal(signal.SIGTERM)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(TIMEOUT_S)
            finally:
                process.kill()
                process.wait()
