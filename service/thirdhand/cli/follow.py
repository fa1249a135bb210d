"""`thirdhand follow`: drive an arm by a cell's commands."""

from __future__ import annotations

import argparse
import signal
import threading

from thirdhand.arms import DriveError, place_of
from thirdhand.cli.usage import reaching
from thirdhand.client import Client
from thirdhand.client.session import tried
from thirdhand.process import interrupt
from thirdhand.process.own_class import explained, own_class
from thirdhand.process.progress import say
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings


def follow(args: argparse.Namespace) -> int:
    """Drive the arm until Ctrl-C; exit code 0 with the arm at rest. Raises NotAcceptedError,
    DriveError, UnreachableError.
    """
    place = place_of(args.arm)
    settings = cell_of(str(args.config)) if args.config else Settings()
    reach = reaching(args, settings)
    cell = settings.cell if args.config and not args.cell else reach.cell
    with tried(lambda: reach.session(at_once=True), args.wait, silent=False) as session:
        # slow imports: a missing daemon is reported before
        from thirdhand.arms.arm import Arm
        from thirdhand.arms.drive import follow as driven
        from thirdhand.daemon.clock import ask_for_real_time

        status = Client(session, cell).wait_until_ready(timeout_s=args.wait, silent=False)
        if status.joints != settings.joints.names:
            raise DriveError(
                f"the daemon of cell {cell} commands {len(status.joints)} joints, "
                f"{', '.join(status.joints)}; the settings here have {len(settings.joints.names)}, "
                f"{', '.join(settings.joints.names)}: give the daemon's settings by --config"
            )
        kind = own_class(place, Arm)
        with explained(kind):
            arm = kind(settings, args.robot or "")
        if arm.takes_velocity and (args.lag is not None or args.gain is not None):
            raise DriveError(f"{args.arm} follows velocities, which need neither --lag nor --gain")
        if args.lag is not None:
            arm.lag_s = args.lag
        if args.gain is not None:
            arm.gain = args.gain
        stop = threading.Event()
        end = _Interruption(stop)
        ask_for_real_time()
        say(f"driving {args.arm} by cell {cell}; Ctrl-C ends it")
        playback = driven(arm, session, cell, stop=stop, wait_s=args.wait, interrupt=end.interrupt)
    say(
        f"ended at rest; delay {playback.delay_ticks:.1f} ticks; {playback.refused} commands were "
        "refused"
    )
    return 0


class _Interruption:
    """SIGINT and SIGTERM set `stop`; a loop that then stands still is interrupted."""

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self._interrupted = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._receive)

    def interrupt(self) -> None:
        """End the loop of the main thread as Ctrl-C does elsewhere; at once if it withstands."""
        if self._interrupted:
            interrupt.end_at_once()
        self._interrupted = True
        # wakes the main thread also in a call that blocks
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def _receive(self, *_: object) -> None:
        self._stop.set()
        if self._interrupted:
            raise KeyboardInterrupt
