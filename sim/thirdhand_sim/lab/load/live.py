"""The closed loop in real time: the service as a process of its own, the bench beside it, connected
by Zenoh.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import msgspec

from thirdhand.client import Client, open_session
from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.daemon.launch import launched, played
from thirdhand_sim.lab.rehearsal import SESSION_NOISE_M, TREMOR_M
from thirdhand_sim.lab.scenes import OFFSET_M, Drawn
from thirdhand_sim.network import RunReport

ATTEMPTS = 3
# a run with more skipped periods of the bench is no evidence: the machine was too busy
SKIPPED = 25


def is_evidence(skipped: int) -> bool:
    """True if a run with a number of skipped periods is evidence."""
    return skipped <= SKIPPED


def steady_run(
    drawn: Drawn, folder: Path, *, taught: bool = True, record: bool = False
) -> tuple[RunReport, int]:
    """A `live_run` in which the machine kept real time, or the last attempt, and the attempt's
    number. With `record` the folder is emptied before each.
    """
    for attempt in range(1, ATTEMPTS + 1):
        for old in folder.glob("*") if record else ():
            old.unlink()
        ran = live_run(drawn, folder, taught=taught, record=record)
        if is_evidence(ran.skipped) or attempt == ATTEMPTS:
            return ran, attempt
    raise AssertionError


def live_run(drawn: Drawn, folder: Path, *, taught: bool = True, record: bool = False) -> RunReport:
    """The bench's report of one scene through a service of its own. Raises LaunchError.

    With `record` its recording goes into `folder`. If not `taught`, the skill has no via-points.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,  # without earlier via-points
        launched(Path(scratch), "--joints", "state", record=folder if record else None) as service,
        open_session(connect=[service.endpoint]) as session,
    ):
        if taught:
            Client(session).add(drawn.scene.via_points(), tolerance=TOLERANCE_M)
        report = played(service.endpoint, *_arguments(drawn, Path(scratch)), reported=service.stop)
    return msgspec.json.decode(report, type=RunReport)


def _arguments(drawn: Drawn, folder: Path) -> list[str]:
    """The bench's arguments for a scene, whose places go into a file in the folder."""
    arguments = ["--seed", str(drawn.seed), "--speed", str(drawn.speed)]
    for name, value in (("offset", OFFSET_M), ("tremor", TREMOR_M), ("noise", SESSION_NOISE_M)):
        arguments += [f"--{name}-mm", str(1000 * value)]
    for pause in drawn.pauses:
        arguments += [
            "--turn" if pause.depth > 1 else "--pause",
            str(pause.at_s),
            str(pause.lasts_s),
        ]
    places = "".join(
        f"{name} = {list(getattr(drawn.scene, name))}\n"
        for name in ("handover", "glass", "soldering")
    )
    scene = folder / "scene.toml"
    scene.write_text(places)
    return [*arguments, "--scene", str(scene)]
