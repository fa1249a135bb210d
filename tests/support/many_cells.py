"""Many daemons in one process, each a cell of its own, all connected to one router: `python
many_cells.py FOLDER ENDPOINT CELL ...` serves until its standard input ends.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import contextlib
import os
import sys
import threading
from pathlib import Path

import msgspec

from thirdhand.core.warm_up import warm_up
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.daemon import Daemon
from thirdhand.daemon.skill_worker import SkillWorker
from thirdhand.daemon.start import starting
from thirdhand.recordings.shipped import recordings, shipped_skill
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import ArmSettings, Files, Settings, robot_description
from thirdhand.settings.network import Network

RATE_HZ = 50
ROS2_DOMAIN = 7


def main(folder: Path, endpoint: str, *cells: str) -> None:
    """Serve the cells; each prints its name once it is announced."""
    skill = shipped_skill()
    skill_worker = SkillWorker()
    warm_up(Settings(), skill.for_loop(), urdf=robot_description(Settings()))
    daemons = []
    held = contextlib.ExitStack()
    for cell in cells:
        settings = Settings(
            cell=cell,
            rate_hz=RATE_HZ,
            arm=msgspec.structs.replace(ArmSettings(), source="assumed"),
            network=Network(listen=(), connect=(endpoint,), ros2_domain=ROS2_DOMAIN),
            files=Files(state=str(folder)),
        )
        start = held.enter_context(starting(settings))
        state = CellState(settings, skill, Scribe(settings), start)
        daemons.append(Daemon(state, skill_worker, recordings()))
    for daemon, cell in zip(daemons, cells, strict=True):
        say = threading.Thread(
            target=daemon.serve, args=(lambda _, cell=cell: os.write(1, f"{cell}\n".encode()),)
        )
        say.start()
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
