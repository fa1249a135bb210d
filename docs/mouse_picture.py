"""`python docs/mouse_picture.py` makes mouse.png: the page for a mouse during the demo, in a
headless Chromium. The first event has been reached, and the board is laid down; the iron is not
taken yet.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from support import chromium  # noqa: E402
from support.dragging import Person  # noqa: E402

PICTURE = Path(__file__).with_name("mouse.png")
TIMEOUT_S = 300


def main(path: Path = PICTURE) -> None:
    """Play the demo until its second event, and save what the page shows as PNG."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [
            sys.executable,
            "-m",
            "thirdhand",
            "demo",
            "--mouse",
            "--rate",
            "100",
            "--output",
            str(folder / "out"),
        ]
        with subprocess.Popen(
            command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT
        ) as demo:
            watchdog = threading.Timer(TIMEOUT_S, demo.kill)
            watchdog.start()
            try:
                assert demo.stderr is not None
                said = ""
                while not (found := re.search(r"http://\S+", said)):
                    said += (line := demo.stderr.readline())
                    if not line:
                        raise SystemExit(said)  # it has ended
                url = found[0]
                threading.Thread(target=demo.stderr.read, daemon=True).start()
                with chromium.opened(url, folder, size=(1000, 700), timeout_s=TIMEOUT_S) as tab:
                    tab.until(
                        "typeof hands !== 'undefined' && !!hands.left && handGoals().length > 0"
                    )
                    play(Person(tab))
                    tab.picture(path)
            finally:
                watchdog.cancel()
                demo.kill()


def play(person: Person) -> None:
    """Hand the board over, lay it down, and move the right hand toward the iron."""
    tab = person.tab
    for goal in person.goals():
        person.drag(goal.side, goal.at)
    tab.until("document.getElementById('done').textContent !== '' && handGoals().length > 1")
    for goal in sorted(person.goals()):
        x, y, z = goal.at
        to = goal.at if goal.side == "left" else (x + 0.08, y - 0.1, z - 0.04)
        person.drag(goal.side, to)
        person.arrive(goal.side, to)
    tab.until("link.status.mode === 'follow'")


if __name__ == "__main__":
    main()
