"""Teaches one via-point to a running daemon, looks how well it is met, and forgets it again.
Try: python examples/teach.py
"""

from __future__ import annotations

import argparse
import contextlib

from thirdhand.client import Client, RefusedError, client_settings
from thirdhand.contract.requests import ViaPoint

HANDOVER = ViaPoint(
    "example",
    left=(0.62, -0.28, 0.30),
    right=(0.98, 0.32, 0.06),
    tool=(0.54, -0.28, 0.38),  # where the tool is to go with the hands there [m]
    std=0.001,  # how exactly [m]
    radius=0.03,  # also for hands so far off [m]
    follow="left",  # within that the tool moves with the left hand
)


def main(arguments: list[str] | None = None) -> None:
    """Prints what the daemon answers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", action="append", help="of the daemon or a router")
    args = parser.parse_args(arguments)
    settings = client_settings(connect=args.connect)
    with settings.session(timeout_s=None) as session:
        client = Client(session, settings.cell)
        client.wait_until_ready(timeout_s=None)
        reply = client.add([HANDOVER])
        print(f"in force since tick {reply.tick}")
        for point in client.via_points():
            print(f"{point.name}: missed by {1000 * point.missed_by_m:.1f} mm")
        try:
            client.remove("no such via-point")
        except RefusedError as error:
            print(f"refused: {error}")
        client.remove(HANDOVER.name)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
