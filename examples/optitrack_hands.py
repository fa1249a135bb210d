"""Publishes two rigid bodies of OptiTrack's Motive as hands, by NatNet: `pip install natnet`, then
`python examples/optitrack_hands.py --server 192.168.1.10 --local 192.168.1.20 --left 1 --right 2`.

Frame `optitrack`: Motive's own, in metres (by default y up); `[hands] base_from_tracker` says where
it is. A third body may be the tool, for demonstrations: `--tool 3`.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from thirdhand.client import Publisher, client_settings
from thirdhand.contract.cdr import encode_pose
from thirdhand.contract.messages import PoseStamped

FRAME = "optitrack"


def poses(
    bodies: Iterable[Any], keys: Mapping[int, str], stamp_ns: int
) -> Iterator[tuple[str, PoseStamped]]:
    """Key and pose of each of a frame's rigid bodies that is wanted, and is tracked in it.

    `keys` are what bodies are, by their numbers in Motive.
    """
    for body in bodies:
        if body.id_num in keys and body.tracking_valid:
            x, y, z = body.pos
            qx, qy, qz, qw = body.rot
            yield keys[body.id_num], PoseStamped(stamp_ns, FRAME, (x, y, z), (qx, qy, qz, qw))


def main() -> None:
    """Publishes until Ctrl-C."""
    from natnet import DataFrame, NatNetClient, NatNetError

    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--server", default="127.0.0.1", help="address of the machine with Motive")
    p.add_argument("--local", default="127.0.0.1", help="address of this machine on that network")
    for name in ("left", "right", "tool"):
        p.add_argument(
            f"--{name}", type=int, required=name != "tool", help="number of its rigid body"
        )
    p.add_argument(
        "--connect", action="append", help="of the daemon, of `thirdhand record` or of a router"
    )
    p.add_argument("--cell")
    args = p.parse_args()
    settings = client_settings(connect=args.connect, cell=args.cell)
    keys = {args.left: "hands/left", args.right: "hands/right", args.tool: "tool/pose"}
    with settings.session(timeout_s=None) as session:
        publishers = {key: Publisher(session, settings.cell, key) for key in keys.values()}

        def publish(frame: DataFrame) -> None:
            for key, pose in poses(frame.rigid_bodies, keys, time.time_ns()):
                publishers[key].put(encode_pose(pose))

        client = NatNetClient(args.server, args.local, use_multicast=False)
        client.on_data_frame_received_event.handlers.append(publish)
        while not client.connected:
            try:
                client.connect()
            except (TimeoutError, OSError, NatNetError) as error:
                reason = str(error) or "no answer"
                print(
                    f"waiting for Motive at {args.server}, which must stream as unicast: {reason}",
                    file=sys.stderr,
                )
                time.sleep(1)
        with client:
            client.run_async()
            while True:
                time.sleep(1)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
