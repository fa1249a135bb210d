"""The closed loop in real time: the service as a process of its own, the bench beside it, Zenoh between them."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from service.client import Client, open_session
from sim.bench import Bench
from sim.experiments.rehearsal import TOLERANCE_M
from sim.experiments.report import ExperimentError
from sim.experiments.scenes import Drawn
from sim.live import Live, Report
from sim.live import run as play

TIMEOUT_S = 60.0


def live_run(drawn: Drawn, folder: Path, *, taught: bool = True, record: bool = False) -> Report:
    """The bench's report of one scene through a service of its own. Raises ExperimentError.

    With `record` its recording and Rerun file go into `folder`. If not `taught`, the skill is as it was learned.
    """
    reports: list[Report] = []
    with _service(folder, record=record) as endpoint, open_session(connect=[endpoint]) as session, Bench(drawn.script()) as bench:
        if taught:
            Client(session).add(drawn.scene.places(), tolerance=TOLERANCE_M)
        play(bench, session, Live(once=True), stop=threading.Event(), report=reports.append, say=lambda line: None)
    return reports[0]


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
