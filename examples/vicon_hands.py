"""Publishes two objects of Vicon Tracker as hands, from its UDP object stream:
`python examples/vicon_hands.py --left left_hand --right right_hand`.

In Tracker, enable the UDP object stream to this machine. Frame `vicon`: Tracker's own, in metres;
`[hands]` or `[trackers.vicon]` says where it is. A third object may be the tool, for
demonstrations: `--tool iron`. Written after the description of the packets; no Vicon was there.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import struct
import sys
import time
from collections.abc import Iterator, Mapping
from math import cos, sin

from thirdhand.client import Publisher, client_settings
from thirdhand.contract.cdr import encode_pose
from thirdhand.contract.messages import PoseStamped, Quaternion

FRAME = "vicon"
PORT = 51001
# frame and number of items; kind and size of an item
HEAD = struct.Struct("<IB")
ITEM = struct.Struct("<BH")
OBJECT = struct.Struct("<24s6d")  # name, x y z [mm], rotations about the moving x, y and z [rad]


def quaternion(x: float, y: float, z: float) -> Quaternion:
    """The quaternion x y z w of rotations about the moving axes x, then y, then z [rad]."""
    (cx, sx), (cy, sy), (cz, sz) = ((cos(angle / 2), sin(angle / 2)) for angle in (x, y, z))
    return (
        sx * cy * cz + cx * sy * sz,
        cx * sy * cz - sx * cy * sz,
        cx * cy * sz + sx * sy * cz,
        cx * cy * cz - sx * sy * sz,
    )


def poses(
    packet: bytes, keys: Mapping[str, str], stamp_ns: int
) -> Iterator[tuple[str, PoseStamped]]:
    """Key and pose of each wanted object in a packet; `keys` are by the objects' names. An object
    that Tracker does not see has zeros, and is left out. Raises ValueError for another packet.
    """
    try:
        _, count = HEAD.unpack_from(packet)
        at = HEAD.size
        for _ in range(count):
            kind, size = ITEM.unpack_from(packet, at)
            name, *numbers = OBJECT.unpack_from(packet, at + ITEM.size)
            at += ITEM.size + size
            key = keys.get(name.split(b"\0")[0].decode(errors="replace"))
            if kind == 0 and key and any(numbers):
                x, y, z = (value / 1000 for value in numbers[:3])
                yield key, PoseStamped(stamp_ns, FRAME, (x, y, z), quaternion(*numbers[3:]))
    except struct.error as error:
        raise ValueError(
            f"{len(packet)} bytes are no packet of Vicon Tracker's UDP object stream: {error}"
        ) from None


def main() -> None:
    """Publishes until Ctrl-C."""
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in ("left", "right", "tool"):
        p.add_argument(f"--{name}", required=name != "tool", help="name of its object in Tracker")
    p.add_argument("--port", type=int, default=PORT, help="UDP port of the stream")
    p.add_argument(
        "--connect", action="append", help="of the daemon, of `thirdhand record` or of a router"
    )
    p.add_argument("--cell")
    args = p.parse_args()
    settings = client_settings(connect=args.connect, cell=args.cell)
    keys = {args.left: "hands/left", args.right: "hands/right"} | (
        {args.tool: "tool/pose"} if args.tool else {}
    )
    with (
        settings.session(timeout_s=None) as session,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stream,
    ):
        publishers = {key: Publisher(session, settings.cell, key) for key in keys.values()}
        stream.bind(("", args.port))
        said = ""
        while True:
            try:
                for key, pose in poses(stream.recv(65536), keys, time.time_ns()):
                    publishers[key].put(encode_pose(pose))
            except ValueError as error:  # anybody may send packets; the next one may be right
                if said != (said := str(error)):
                    print(said, file=sys.stderr, flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
