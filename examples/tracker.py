"""A tracker of both hands: here two that sway where the shipped skill was learned; put your own
camera's poses in their place. Try: python examples/tracker.py --seconds 20
"""

from __future__ import annotations

import argparse
import math
import time

from service.client import Tracker, open_session

RATE_HZ = 100
LEFT, RIGHT = (0.98, -0.32, 0.06), (0.98, 0.32, 0.06)  # frame base [m]: x forward from the arm, y to its left, z up


def main(arguments: list[str] | None = None) -> None:
    """Publishes for so many seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="of the daemon or a router")
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args(arguments)
    with open_session(connect=[args.connect]) as session, Tracker(session) as tracker:
        begin = time.monotonic()
        while (t := time.monotonic() - begin) < args.seconds:
            sway = 0.02 * math.sin(2 * math.pi * 0.3 * t)
            seen_ns = time.time_ns()  # when the picture was taken, if your camera tells
            for side, (x, y, z) in (("left", LEFT), ("right", RIGHT)):
                tracker.publish(side, (x, y + sway, z), stamp_ns=seen_ns)
            time.sleep(1 / RATE_HZ)


if __name__ == "__main__":
    main()
