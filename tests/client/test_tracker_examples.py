"""The example programs for trackers, given synthetic rigid bodies, packets and messages."""

from __future__ import annotations

import signal
import socket
import struct
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.cell import until
from support.examples import example
from support.paths import ROOT
from thirdhand.client import Watch, endpoints, open_session
from thirdhand.contract.messages import PoseStamped


def test_rigid_bodies_that_are_tracked_are_hands() -> None:
    def body(number: int, *, tracked: bool = True) -> SimpleNamespace:
        return SimpleNamespace(
            id_num=number, pos=(0.1, 1.0, 0.2), rot=(0.0, 0.6, 0.0, 0.8), tracking_valid=tracked
        )

    keys = {1: "hands/left", 2: "hands/right", None: "tool/pose"}
    poses = dict(
        example("optitrack_hands").poses([body(2), body(1, tracked=False), body(7)], keys, 9)
    )
    assert poses == {
        "hands/right": PoseStamped(9, "optitrack", (0.1, 1.0, 0.2), (0.0, 0.6, 0.0, 0.8))
    }


def vicon_packet(*objects: tuple[bytes, tuple[float, ...]]) -> bytes:
    """A packet of Vicon Tracker's UDP object stream, padded as it comes."""
    items = b"".join(struct.pack("<BH24s6d", 0, 72, name, *numbers) for name, numbers in objects)
    return struct.pack("<IB", 7, len(objects)) + items + bytes(40)


VICON = vicon_packet(
    (b"iron", (1.0,) * 6), (b"left", (100.0, -200.0, 300.0, 0.4, -0.5, 0.6)), (b"right", (0.0,) * 6)
)
HTS = b"""Left wrist | f = 12 | t = 99:, 0.1, 1.2, 0.5, 0.1, -0.5, 0.5, 0.7
Left landmarks:, 1, 2, 3
Head pose:, 0, 0, 0, 0, 0, 0, 1
"""
KEYS = {"left": "hands/left", "right": "hands/right"}


def test_object_of_vicon_is_a_hand_in_metres() -> None:
    """An object that is not seen is no hand."""
    ((key, pose),) = example("vicon_hands").poses(VICON, KEYS, 9)
    assert (key, pose[:3]) == ("hands/left", (9, "vicon", (0.1, -0.2, 0.3)))
    np.testing.assert_allclose(
        pose.orientation, Rotation.from_euler("XYZ", [0.4, -0.5, 0.6]).as_quat(), atol=1e-12
    )


@pytest.mark.parametrize("packet", [b"", b"abc", VICON[:50], b"\0\0\0\0\xff" + bytes(300)])
def test_other_bytes_are_no_packet_of_vicon(packet: bytes) -> None:
    with pytest.raises(
        ValueError, match=f"{len(packet)} bytes are no packet of Vicon Tracker's UDP object stream"
    ):
        list(example("vicon_hands").poses(packet, KEYS, 9))


def test_wrist_of_the_streamer_is_right_handed() -> None:
    """Mirroring a rotation and a point, then rotating, equals rotating and then mirroring."""
    ((key, pose),) = example("hts_hands").poses(HTS, 9)
    assert (key, pose[:3]) == ("hands/left", (9, "hts", (0.1, 1.2, -0.5)))
    unity = Rotation.from_quat([0.1, -0.5, 0.5, 0.7])
    mirror = np.array([1.0, 1.0, -1.0])
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        Rotation.from_quat(pose.orientation).apply(mirror * point), mirror * unity.apply(point)
    )


@pytest.mark.parametrize("values", ["1, 2, 3", "0, 0, 0, 0, 0, 0, nan", "a, 0, 0, 0, 0, 0, 1"])
def test_a_wrist_without_seven_numbers_is_refused(values: str) -> None:
    with pytest.raises(
        ValueError, match=r"seven finite numbers after a wrist|could not convert string to float"
    ):
        list(example("hts_hands").poses(f"Right wrist:, {values}".encode(), 9))


@pytest.mark.parametrize(("name", "frame"), [("vicon_hands", "vicon"), ("hts_hands", "hts")])
def test_example_publishes_what_it_receives(name: str, frame: str) -> None:
    """The program continues after packets that it cannot read."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    named = ["--left", "left", "--right", "right"] if name != "hts_hands" else []
    packets = {"vicon_hands": VICON, "hts_hands": HTS}
    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as session,
        Watch(session, "thirdhand", "hands/left", timeout_s=0.2) as hands,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        command = [
            sys.executable,
            str(ROOT / "examples" / f"{name}.py"),
            *named,
            "--port",
            str(port),
            "--connect",
            *endpoints(session),
        ]
        running = subprocess.Popen(command, stderr=subprocess.PIPE)
        try:

            def received() -> PoseStamped | None:
                for packet in (b"nonsense", packets[name]):
                    sender.sendto(packet, ("127.0.0.1", port))
                pose: PoseStamped | None = next(hands)
                return pose

            assert until(received, within_s=60).frame_id == frame
        finally:
            running.send_signal(signal.SIGINT)
            _, errors = running.communicate(timeout=30)
    assert b"Traceback" not in errors
