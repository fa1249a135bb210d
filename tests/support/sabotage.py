"""Parts of a daemon that fail on a test's request."""

from __future__ import annotations

from pathlib import Path

# A part fails while the folder has a file of its name; once only, if the file contains "once".
SABOTAGE = """
import pathlib
from thirdhand.core import controller
from thirdhand.core.arm import stage as arm
from thirdhand.daemon import cell_state, queryables, rehearsed_controller, status

def sabotaged(owner, name, folder=pathlib.Path({folder!r})):
    honest = getattr(owner, name)
    def method(*arguments, **more):
        if (mark := folder / name).exists():
            if mark.read_text() == "once":
                mark.unlink()
            raise RuntimeError(f"{{name}} is sabotaged")
        return honest(*arguments, **more)
    setattr(owner, name, method)

sabotaged(status.CellStatus, "status")
sabotaged(controller.Controller, "step")
sabotaged(arm.ArmStage, "follow")
sabotaged(rehearsed_controller, "outgoing")
sabotaged(queryables.RequestQueue, "enqueue")
sabotaged(cell_state.CellState, "note")
"""


def fail(folder: Path, part: str, how: str = "always") -> None:
    """Have a part of a sabotaged daemon fail from now on, or once."""
    (folder / "mark").write_text(how)
    (folder / "mark").rename(folder / part)
