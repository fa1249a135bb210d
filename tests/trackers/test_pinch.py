"""Pinches: press of the clutch, and the wished closure of the gripper."""

from __future__ import annotations

from typing import Any

import pytest

from thirdhand.client import Watch, endpoints, open_session
from thirdhand.workbench.trackers.pinch import Pinches

# distances of thumb and index tip of the left hand (None: not seen), and the expected states of the
# clutch
LEFT_M = {
    "parted": ([0.09], [False]),
    "pinched": ([0.09, 0.03, 0.019], [False, False, True]),
    "held between the two distances": (
        [0.01, 0.03, 0.039, 0.041, 0.03],
        [True, True, True, False, False],
    ),
    "out of sight": ([0.01, None, 0.03, 0.01], [True, False, False, True]),
}
CLOSURES = [(0.10, 0.0), (0.08, 0.0), (0.05, 0.5), (0.02, 1.0), (0.0, 1.0)]


def said(pinches: Pinches, distances_m: dict[str, float], watch: Watch) -> Any:
    """The first message that follows the distances. They are published repeatedly, as by a page,
    because a message that cannot be sent at once is dropped.
    """
    for stamp_ns in range(20):
        pinches.publish(distances_m, stamp_ns)
        if (value := next(watch)) is not None:
            return value
    raise AssertionError(f"{distances_m} was never heard")


@pytest.mark.parametrize(("left_m", "pressed"), LEFT_M.values(), ids=LEFT_M)
def test_left_hand_clutches_and_right_hand_grips(
    left_m: list[float | None], pressed: list[bool]
) -> None:
    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as hearing,
        Watch(hearing, "bench", "clutch", timeout_s=2) as clutch,
        Watch(hearing, "bench", "gripper/wish", timeout_s=2) as wish,
        open_session(connect=[endpoints(hearing)[0]]) as session,
    ):
        pinches = Pinches(session, "bench", clutch="left", gripper="right")
        for apart_m, is_pressed in zip(left_m, pressed, strict=True):
            assert said(pinches, {} if apart_m is None else {"left": apart_m}, clutch) is is_pressed
        for apart_m, closure in CLOSURES:
            assert said(pinches, {"right": apart_m}, wish) == pytest.approx(closure)
