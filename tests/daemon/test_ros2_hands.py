"""Hands that are frames of /tf, as nodes of rmw_zenoh publish them. Two trackers, each with its
mapping, are followed among many other frames; malformed, foreign and stale frames are refused; the
recording replays exactly.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from zenoh_ros2_sdk import ROS2Publisher

from support.cell import LEFT, RIGHT, Daemon, serving, until
from support.ros2_nodes import guarded, header, port, typed
from thirdhand.client import endpoints, open_session
from thirdhand.contract import cdr, channels, ros2
from thirdhand.contract.messages import Quaternion, Transform, Vector3
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import parse
from thirdhand.workbench.trackers.capture import Capture

DOMAIN = 13
KIND = "tf2_msgs/msg/TFMessage"
KEY = ros2.key(DOMAIN, ros2.Topic("/tf", KIND, "/tf"))
CELL = f"""
rate_hz = 250
[network]
listen = ["tcp/127.0.0.1:0"]
connect = ["{{router}}"]
ros2_domain = {DOMAIN}
[ros2]
hands = ["/tf:left_wrist", "/tf:right_wrist"]
tool = "/tf:iron"
tf = "/tf"
[hands]
frame = "world"
base_from_tracker = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
[trackers.mocap]
unit = "mm"
[arm]
source = "assumed"
[files]
state = "{{state}}"
"""
STRAIGHT = (0.0, 0.0, 0.0, 1.0)
OTHERS = [Transform("base_link", f"link_{i}", (0.1, 0.2, 0.3), STRAIGHT) for i in range(48)]


def of_left(at: Vector3 = LEFT, turn: Quaternion = STRAIGHT, parent: str = "world") -> Transform:
    """The left wrist in frame `world`, whose origin is at x = 0.5 m."""
    return Transform(parent, "left_wrist", (at[0] - 0.5, at[1], at[2]), turn)


class Wrists:
    """Publishes two wrists on /tf at 100 Hz until closed: the left one by a session among the links
    of a robot, the right one by a node of its own.
    """

    def __init__(self, at: str) -> None:
        self.node = ROS2Publisher("/tf", **typed(KIND), **port(at, DOMAIN))
        self.session = open_session(connect=[at])
        self.times = 1  # messages of other frames before each one of the left wrist
        self._end, self._thread = threading.Event(), threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        types = self.node.session_mgr.store.types
        names = ("Vector3", "Quaternion", "Transform", "TransformStamped")
        vector, quaternion, transform, stamped = (
            types[f"geometry_msgs/msg/{name}"] for name in names
        )
        while not self._end.wait(0.01):
            now_ns = time.time_ns()
            for _ in range(self.times):
                self.session.put(KEY, cdr.encode_transforms(now_ns, OTHERS))
            self.session.put(
                KEY, cdr.encode_transforms(now_ns, [*OTHERS[:24], of_left(), *OTHERS[24:]])
            )
            pose = transform(vector(*(1000.0 * value for value in RIGHT)), quaternion(*STRAIGHT))
            self.node.publish(transforms=[stamped(header(types, "mocap"), "right_wrist", pose)])

    def __enter__(self) -> Wrists:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self.node.close()
        self.session.close()


def bad() -> dict[str, bytes]:
    """One message for each cause of a rejection."""
    now_ns = time.time_ns()
    sound = cdr.encode_transforms(now_ns, [of_left()])
    return {
        "not_finite": cdr.encode_transforms(now_ns, [of_left((math.nan, 0.0, 0.0))]),
        "not_a_rotation": cdr.encode_transforms(now_ns, [of_left(turn=(0.0, 0.0, 0.0, 0.0))]),
        "out_of_range": cdr.encode_transforms(now_ns, [of_left((900.0, 0.0, 0.0))]),
        "wrong_frame": cdr.encode_transforms(now_ns, [of_left(parent="left_elbow")]),
        "older": cdr.encode_transforms(now_ns - 86_400 * 10**9, [of_left()]),
        "malformed": sound[:-8],
    }


MALFORMED = (
    cdr.encode_transforms(1, [of_left(parent="a" * 9000)]),
    cdr.encode_transforms(1, [of_left()] + 400 * OTHERS[:1]),
    cdr.CDR_HEADER + b"\xff\xff\xff\xff" + b"left_wrist\0" * 9,
)


@pytest.mark.thorough
def test_hands_are_found_among_many_frames(tmp_path: Path, router: zenoh.Session) -> None:
    """Bad frames are refused."""
    (endpoint,) = endpoints(router)
    (tmp_path / "tf.toml").write_text(CELL.format(router=endpoint, state=tmp_path))
    serve = ("--config", str(tmp_path / "tf.toml"), "--record", str(tmp_path / "records"))
    with serving(tmp_path, *serve) as daemon, Wrists(endpoint) as wrists:

        def is_followed(now: dict[str, Any]) -> bool:
            return bool(
                now["mode"] == "follow"
                and all(now["sources"][side]["fresh"] for side in ("left", "right"))
            )

        status = daemon.until(is_followed, 30)
        np.testing.assert_allclose(
            [status["hands_m"][side] for side in ("left", "right")], [LEFT, RIGHT], atol=0.005
        )
        assert [status["sources"][side]["frame"] for side in ("left", "right")] == [
            "world",
            "mocap",
        ]
        assert status["sources"]["left"]["clock_ms"] < 1000
        assert_refused(daemon, wrists.session)
        wrists.times = 10  # 1000 messages a second of 48 frames
        before = daemon.client.ask("status")["tick"]
        daemon.until(lambda now: now["tick"] > before + 500)
        assert is_followed(daemon.client.ask("status"))
        assert daemon.end() == 0
    (recording,) = (tmp_path / "records").glob("*.mcap")
    result = replay(recording)
    assert result.exact, result.text()


def assert_refused(daemon: Daemon, session: zenoh.Session) -> None:
    """Each bad message is counted by its cause, and the arm follows the sound ones."""
    for cause, message in bad().items():
        assert cause not in daemon.client.ask("status")["sources"]["left"]["rejected"]
        session.put(KEY, message)
        status = daemon.until(
            lambda now, cause=cause: now["sources"]["left"]["rejected"].get(cause)
        )  # type: ignore[misc]
        assert status["mode"] == "follow", cause
    for count, message in enumerate(MALFORMED, start=2):
        session.put(KEY, message)
        daemon.until(
            lambda now, count=count: now["sources"]["left"]["rejected"]["malformed"] == count
        )  # type: ignore[misc]
    assert not daemon.client.ask("status")["sources"]["right"]["rejected"].keys() & bad().keys()


def test_demonstrations_are_captured_of_frames_too(tmp_path: Path) -> None:
    """With certificates of a tracker and of a recorder."""
    settings = parse(CELL.format(router="tcp/127.0.0.1:1", state=tmp_path), origin="tf.toml")
    topics = [*ros2.of_settings(settings.ros2)]
    right = Transform("/mocap", "/right_wrist", (1.0, 2.0, 3.0), STRAIGHT)
    tool = (0.4, 0.0, 0.2)
    frames = [of_left(), right, Transform("base", "iron", tool, STRAIGHT)]
    sessions = guarded(tmp_path, settings.cell, DOMAIN, topics, "recorder", "tracker", "observer")
    with (
        sessions as (_, recorder, tracker, observer),
        contextlib.closing(Capture(recorder, settings.cell, settings)) as captured,
    ):

        def is_complete() -> bool:
            observer.put(KEY, cdr.encode_transforms(2, [of_left((0.0, 0.0, 0.0))]))
            tracker.put(KEY, cdr.encode_transforms(1, frames))
            tracker.put(KEY, cdr.encode_transforms(1, frames)[:-1])
            captured.collect()
            return not captured.missing and len(captured.malformed) == 3

        until(is_complete, "the frames were not heard")
        poses = {
            key: channels.POSE.decode(captured.samples[key][-1].payload) for key in ros2.FRAMES
        }
        assert [(pose.stamp_ns, pose.frame_id, pose.position) for pose in poses.values()] == [
            (1, "world", of_left().translation),
            (1, "mocap", (1.0, 2.0, 3.0)),
            (1, "base", tool),
        ]
        np.testing.assert_allclose(captured.samples["hands/right"][-1].at, (0.001, 0.002, 0.003))
