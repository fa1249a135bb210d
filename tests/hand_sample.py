"""The path of one hand sample through the service, from its subscriber to the joint command: the
files that it enters, in order, and the number of calls between files.

    python -m tests.hand_sample

Compiled functions run as plain Python here, so that they count too. A call from one function of
a file to a function of another counts once, however often a loop repeats it. A re-entry is such a
call into a file that was entered before. A segment's class and its compiled step count as one file.
"""

from __future__ import annotations

import os

os.environ["NUMBA_DISABLE_JIT"] = "1"  # before anything imports Numba

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import contextlib
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

from thirdhand.client import Publisher, endpoints, open_session
from thirdhand.contract import cdr
from thirdhand.contract.messages import BASE, Attachment, JointState, PoseStamped
from thirdhand.contract.records import SIDES, SOURCES, Mode
from thirdhand.core.controller import Controller, outgoing, run
from thirdhand.core.frame import Event, Frame, Tick
from thirdhand.daemon import daemon
from thirdhand.daemon.cell_streams import Arrivals, CellStreams
from thirdhand.daemon.input_monitor import KEY_OF_SOURCE
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description

ROOT = Path(__file__).parents[1]
LOOP = str(Path(daemon.__file__))  # this program does the work of the daemon's loop
# left out like operators
ARITHMETIC = {
    str(ROOT / "service/thirdhand/core/vectors.py"),
    str(ROOT / "kmp/elementary.py"),
}
PERIODS = 80


class Walk:
    """The calls between files of this repository while `sys.setprofile` has `see`."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str, str, str]] = []

    def see(self, frame: FrameType, event: str, _: Any) -> None:
        """Record a call into another file."""
        if event != "call" or not self._is_ours(frame):
            return
        caller = frame.f_back
        while caller is not None and not self._is_ours(caller):
            caller = caller.f_back
        start = (
            LOOP if caller is None or caller.f_code.co_filename == __file__ else _file_of(caller)
        )
        function = "" if caller is None else caller.f_code.co_name
        end = _file_of(frame)
        call = (start, function, end, frame.f_code.co_name)
        if start != end and call not in self.calls:
            self.calls.append(call)

    @staticmethod
    def _is_ours(frame: FrameType) -> bool:
        file = frame.f_code.co_filename
        return file not in ARITHMETIC and (
            file.startswith((f"{ROOT}/service", f"{ROOT}/kmp")) or file == __file__
        )

    @property
    def files(self) -> list[str]:
        """The files in the order in which they are entered."""
        paths = dict.fromkeys([LOOP, *(end for *_, end, _ in self.calls)])
        return [str(Path(file).relative_to(ROOT)) for file in paths if file != __file__]

    @property
    def re_entries(self) -> int:
        """The number of calls into files that were entered before."""
        return len(self.calls) + 1 - len(self.files)


def _file_of(frame: FrameType) -> str:
    file = frame.f_code.co_filename
    return file.removesuffix("step.py") + "stage.py" if file.endswith("/step.py") else file


def walk() -> Walk:
    """The path of a sample while the arm follows."""
    settings = Settings()
    skill = shipped_skill().for_loop()
    trace = Walk()
    controller = Controller(settings, skill, urdf=robot_description(settings))
    hands = skill.hands[0].reshape(2, 3)
    names = settings.joints.names
    arrivals = {KEY_OF_SOURCE[source]: Arrivals() for source in SOURCES}

    def sample(side: str, index: int) -> PoseStamped:
        x, y, z = hands[SIDES.index(side)].tolist()
        return PoseStamped(
            1 + 2_000_000 * index, BASE, (x, y, z + 1e-4 * index), (0.0, 0.0, 0.0, 1.0)
        )

    for index in range(PERIODS):
        state = JointState(1 + 2_000_000 * index, names, settings.arm.posture, (0.0,) * len(names))
        inbox = [Event(f"hands/{side}", b"", sample(side, index)) for side in SIDES]
        frame = controller.step(Tick(index, (*inbox, Event("joints/state", b"", state))))
    if frame["mode"] != Mode.FOLLOW:
        raise SystemExit(f"the arm does not follow, but has mode {Mode(int(frame['mode'])).name}")
    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as listening,
        contextlib.closing(
            CellStreams(listening, settings, arrivals=arrivals, failed=print)
        ) as streams,
        open_session(connect=list(endpoints(listening))) as session,
    ):

        def publish(tick: Tick, frame: Frame) -> None:
            attachment = cdr.encode_attachment(
                Attachment(tick.index, 0, int(frame["hand_stamp_ns"]))
            )
            for key, payload in outgoing(frame, tick.index, names):
                streams.publish(key, payload, attachment)

        Publisher(session, settings.cell, "hands/left").put(
            cdr.encode_pose(sample("left", PERIODS))
        )
        newest: list[Event] = []
        until = time.monotonic() + 10.0
        while not newest and time.monotonic() < until:
            sys.setprofile(None)
            trace.calls.clear()
            sys.setprofile(trace.see)
            newest = streams.receive()
        run(controller, [Tick(PERIODS, tuple(newest))], [publish])
        sys.setprofile(None)
    return trace


def main() -> None:
    """Print the path and its counts."""
    trace = walk()
    print("\n".join(f"{number:2} {file}" for number, file in enumerate(trace.files, 1)))
    print(
        f"{len(trace.files)} files, {len(trace.calls)} calls between them, {trace.re_entries} "
        "re-entries"
    )
    if "--calls" in sys.argv:
        for start, caller, end, called in trace.calls:
            print(
                f"{Path(start).relative_to(ROOT)} {caller} -> {Path(end).relative_to(ROOT)} "
                f"{called}"
            )


if __name__ == "__main__":
    main()
