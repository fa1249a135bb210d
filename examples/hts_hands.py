"""Publishes the hands of a Meta Quest that runs the app Hand Tracking Streamer, by UDP:
`python examples/hts_hands.py`, and in the app the address of this machine and port 9000.

Frame `hts`: y up, -z ahead, metres, from the headset's origin; `[hands]` or `[trackers.hts]` says
where it is. The pose is the wrist's. Written after the description of the packets; no headset was
there.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import socket
import sys
import time
from collections.abc import Iterator

from thirdhand.client import Publisher, client_settings
from thirdhand.contract.cdr import encode_pose
from thirdhand.contract.messages import PoseStamped

FRAME = "hts"
PORT = 9000
KEYS = {"left wrist": "hands/left", "right wrist": "hands/right"}


def poses(packet: bytes, stamp_ns: int) -> Iterator[tuple[str, PoseStamped]]:
    """Key and pose of each wrist in a packet: lines like `Left wrist:, x, y, z, qx, qy, qz, qw` in
    Unity's left-handed axes, whose z is turned round here. Other lines are ignored. Raises
    ValueError for a wrist without seven finite numbers.
    """
    for line in packet.decode(errors="replace").splitlines():
        label, _, values = line.partition(":")
        if key := KEYS.get(label.split("|")[0].strip().lower()):
            numbers = [float(value) for value in values.split(",") if value.strip()]
            if len(numbers) != 7 or not all(map(math.isfinite, numbers)):
                raise ValueError(f"{line[:80]!r} given; seven finite numbers after a wrist needed")
            x, y, z, qx, qy, qz, qw = numbers
            yield key, PoseStamped(stamp_ns, FRAME, (x, y, -z), (-qx, -qy, qz, qw))


def main() -> None:
    """Publishes until Ctrl-C."""
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--port", type=int, default=PORT, help="UDP port to which the app sends")
    p.add_argument(
        "--connect", action="append", help="of the daemon, of `thirdhand record` or of a router"
    )
    p.add_argument("--cell")
    args = p.parse_args()
    settings = client_settings(connect=args.connect, cell=args.cell)
    with (
        settings.session(timeout_s=None) as session,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream,
    ):
        publishers = {key: Publisher(session, settings.cell, key) for key in KEYS.values()}
        stream.bind(("", args.port))
        said = ""
        while True:
            try:
                for key, pose in poses(stream.recv(65536), time.time_ns()):
                    publishers[key].put(encode_pose(pose))
            except ValueError as error:  # anybody may send packets; the next one may be right
                if said != (said := str(error)):
                    print(said, file=sys.stderr, flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
