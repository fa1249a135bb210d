"""A daemon as a process, and a client's session to it, for tests that go through Zenoh."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from support.paths import ROOT
from thirdhand.client import Client, open_session
from thirdhand.command_line import main
from thirdhand.contract import cdr, messages
from thirdhand.daemon.launch import Launched, launched

LISTENING = '[network]\nlisten = ["tcp/127.0.0.1:0"]\n'
# positions of resting hands [m]
LEFT = (0.98, -0.32, 0.06)
RIGHT = (0.98, 0.32, 0.06)


def thirdhand(
    *arguments: str, timeout: float = 60, cwd: Path = ROOT, **more: Any
) -> subprocess.CompletedProcess[str]:
    """A `thirdhand` command, run to its end."""
    command = [sys.executable, "-m", "thirdhand", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, check=False, cwd=cwd, **more
    )


def told(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A `thirdhand` command, run to its end in this process, which has its imports already."""
    out = io.StringIO()
    errors = io.StringIO()
    mask = os.umask(0o022)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            code = main(list(arguments))
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            os.umask(mask)  # `serve` changes it
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), errors.getvalue())


def until(
    what: Callable[[], Any], words: str = "it did not come to hold", *, within_s: float = 20.0
) -> Any:
    """The first true value that a call returns."""
    end = time.monotonic() + within_s
    while not (value := what()):
        assert time.monotonic() < end, words
        time.sleep(0.02)
    return value


def is_running(pid: int) -> bool:
    """True if a process exists and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


class Daemon:
    """A running `thirdhand serve` and a client's session to it."""

    def __init__(self, service: Launched, session: zenoh.Session) -> None:
        self.process = service.process
        self.endpoint = service.endpoint
        self.session = session
        self.log = service.log
        self.client = Client(session)
        self.end = service.stop  # stops the daemon; returns its exit code

    def until(
        self, what: Callable[[dict[str, Any]], bool], timeout_s: float = 15.0
    ) -> dict[str, Any]:
        """The first status for which a condition holds."""
        end = time.monotonic() + timeout_s
        while not what(status := self.client.ask("status")):
            assert time.monotonic() < end, f"not within {timeout_s} s: {json.dumps(status)}"
            time.sleep(0.01)  # leave the processor to the daemon and its processes
        return status


@contextlib.contextmanager
def serving(
    folder: Path,
    *arguments: str,
    before: str = "",
    network: str = LISTENING,
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[Daemon]:
    """A daemon on a free port with its files in a folder; its process first runs the Python code
    `before`.
    """
    program = (
        ("-c", f"{before}\nfrom thirdhand.__main__ import main\nimport sys\nsys.exit(main())")
        if before
        else ("-m", "thirdhand")
    )
    with (
        launched(folder, *arguments, program=program, network=network, say=say) as service,
        open_session(connect=[service.endpoint]) as session,
    ):
        yield Daemon(service, session)


class Tracker:
    """Publishes both hands at 100 Hz until closed; `left` and `right` may be changed, or None for
    an unseen hand. They are in a `frame`; the tracker's clock is `ahead_ns` ahead.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.left: tuple[float, float, float] | None = LEFT
        self.right: tuple[float, float, float] | None = RIGHT
        self.ahead_ns = 0
        self.frame = messages.BASE
        self._publishers = {
            side: session.declare_publisher(f"thirdhand/hands/{side}") for side in ("left", "right")
        }
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        while not self._end.wait(0.01):
            stamp_ns = time.time_ns() + self.ahead_ns
            for side, position in (("left", self.left), ("right", self.right)):
                if position is not None:
                    pose = messages.PoseStamped(
                        stamp_ns, self.frame, position, (0.0, 0.0, 0.0, 1.0)
                    )
                    self._publishers[side].put(cdr.encode_pose(pose))

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
