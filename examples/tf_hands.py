"""Publishes two frames of ROS 2's /tf as hands, over rmw_zenoh:
`python examples/tf_hands.py --left left_hand --right right_hand --domain 0`.

The hands' frame is the parent that /tf names, like `optitrack` or `world`; `[hands]` or
`[trackers.NAME]` says where it is. Connect to the router of ROS 2 (`--connect
tcp/127.0.0.1:7447`), to which the daemon connects too. A third frame may be the tool: `--tool`.
"""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Iterator, Mapping

import zenoh

from service.client import client_settings, publisher
from service.contract import ros2
from service.contract.cdr import decode_transforms, encode_pose
from service.contract.messages import PoseStamped, WireError


def poses(message: bytes, keys: Mapping[str, str]) -> Iterator[tuple[str, PoseStamped]]:
    """Key and pose of each wanted frame in the bytes of a TFMessage; `keys` are by the frames'
    names. Raises WireError.
    """
    stamp_ns, transforms = decode_transforms(message)
    for one in transforms:
        if key := keys.get(one.child.lstrip("/")):
            yield key, PoseStamped(stamp_ns, one.parent.lstrip("/"), one.translation, one.rotation)


def main() -> None:
    """Publishes until Ctrl-C."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("left", "right", "tool"):
        p.add_argument(f"--{name}", required=name != "tool", help="name of its frame in /tf")
    p.add_argument("--domain", type=int, default=0, help="of ROS 2")
    p.add_argument("--topic", default="/tf")
    p.add_argument("--connect", action="append", help="of the router, or of the daemon where nodes connect to it")
    p.add_argument("--cell")
    args = p.parse_args()
    settings = client_settings(connect=args.connect, cell=args.cell)
    keys = {args.left: "hands/left", args.right: "hands/right"} | ({args.tool: "tool/pose"} if args.tool else {})
    with settings.session(timeout_s=None) as session:
        publishers = {key: publisher(session, settings.cell, key, express=True) for key in keys.values()}

        def publish(sample: zenoh.Sample) -> None:
            with contextlib.suppress(WireError):  # other messages than transforms are ignored
                for key, pose in poses(sample.payload.to_bytes(), keys):
                    publishers[key].put(encode_pose(pose))

        topic = ros2.Topic(args.topic, "tf2_msgs/msg/TFMessage", "/tf", heard=True)
        with session.declare_subscriber(ros2.key(args.domain, topic), publish):
            threading.Event().wait()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
