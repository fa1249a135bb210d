"""Watches all cells of a network, ten times a second, and says whenever one changes what it does.
Try: python examples/watch.py --seconds 60
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time

from thirdhand import cells, client_settings


def main(arguments: list[str] | None = None) -> None:
    """Watches for so many seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", action="append", help="of the daemon or a router")
    parser.add_argument("--seconds", type=float, default=math.inf, help="else until Ctrl-C")
    args = parser.parse_args(arguments)
    said: dict[str, str] = {}
    with client_settings(connect=args.connect).session(timeout_s=None) as session:
        end = time.monotonic() + args.seconds
        while time.monotonic() < end:
            now = {
                cell.name: f"{cell.status.mode} {cell.status.reason}".strip()
                if cell.status
                else "does not answer"
                for cell in cells(session)
            }
            for name in sorted(said.keys() | now.keys()):
                if now.get(name) != said.get(name):
                    print(f"{name}: {now.get(name, 'gone')}", flush=True)
            said = now
            time.sleep(0.1)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
