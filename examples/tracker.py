"""A tracker of both hands: here two that sway where the shipped skill was learned; put your own
camera's poses in their place. Try: python examples/tracker.py --seconds 20
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time

from thirdhand import Tracker, client_settings

RATE_HZ = 100
# frame base [m]: x forward from the arm, y to its left, z up
LEFT = (0.98, -0.32, 0.06)
RIGHT = (0.98, 0.32, 0.06)


def main(arguments: list[str] | None = None) -> None:
    """Publishes for so many seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--connect", action="append", help="of the daemon, of `thirdhand record` or of a router"
    )
    parser.add_argument("--seconds", type=float, default=math.inf, help="else until Ctrl-C")
    args = parser.parse_args(arguments)
    client = client_settings(connect=args.connect)
    with (
        # None: it waits for who listens, whoever is started first
        client.session(timeout_s=None) as session,
        Tracker(session, client.cell, timeout_s=None) as tracker,
    ):
        begin = time.monotonic()
        while (t := time.monotonic() - begin) < args.seconds:
            sway = 0.02 * math.sin(2 * math.pi * 0.3 * t)
            seen_ns = time.time_ns()  # when the picture was taken, if your camera tells
            for side, (x, y, z) in (("left", LEFT), ("right", RIGHT)):
                tracker.publish(side, (x, y + sway, z), stamp_ns=seen_ns)
            time.sleep(1 / RATE_HZ)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
