"""The task with a person's hands: it waits for the person, one hand after the other, and is scored
like the scripted scene.
"""

from __future__ import annotations

import math

import msgspec
import pytest

from support.demo import SCENE, taught
from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.core.controller import Controller
from thirdhand.settings.config import Settings, parse, robot_description
from thirdhand_sim.bench import Bench, TaskEvents
from thirdhand_sim.closed_loop import ClosedLoop, begin_when_settled
from thirdhand_sim.scene import HAND_ORIENTATION, Point
from thirdhand_sim.tracked_hands import TrackedHands, hand_places

SPEED_M_S = 0.5
TIMEOUT_S = 40.0


class Player:
    """A person who moves one hand at a time to the places that the bench shows."""

    def __init__(self, hands: TrackedHands, *, segments: int) -> None:
        self._hands = hands
        self._stages = segments
        self._at: dict[str, Point] = {"left": SCENE.left_start, "right": SCENE.right_start}
        self.shown: list[str] = []

    def direct(self, bench: Bench) -> None:
        begin_when_settled(bench)
        names = [place.name for place in bench.script.places()]
        self.shown += [name for name in names if name not in self.shown]
        goals = [(place.name.split()[0], place.position) for place in bench.script.places()]
        moving = [(side, to) for side, to in goals if math.dist(self._at[side], to) > 1e-6]
        if moving and len(self.shown) <= self._stages:
            side, to = moving[0]
            share = min(1.0, SPEED_M_S * bench.period_s / math.dist(self._at[side], to))
            self._at[side] = tuple(
                a + share * (b - a) for a, b in zip(self._at[side], to, strict=True)
            )  # type: ignore[assignment]
        for side, position in self._at.items():
            self._hands.receive(side, PoseStamped(1, BASE, position, HAND_ORIENTATION))


def played(*, segments: int) -> tuple[TaskEvents, list[str], TrackedHands]:
    """The events if a person moves to the first places only, the instructions shown, and the
    hands.
    """
    settings = msgspec.structs.replace(Settings(), rate_hz=100)
    controller = Controller(settings, taught(), urdf=robot_description(settings))
    hands = TrackedHands(SCENE, settings, timeout_s=TIMEOUT_S)
    player = Player(hands, segments=segments)
    with Bench(hands, settings=settings) as bench:
        loop = ClosedLoop(bench, direct=player.direct)
        for tick in loop.ticks():
            loop.follow(tick, controller.step(tick))
        return bench.events(), player.shown, hands


def test_hands_in_turn_play_the_whole_task() -> None:
    """The hands move one after the other."""
    events, labels, hands = played(segments=5)
    assert events.success
    assert max(event.error_mm for event in (events.handover, events.grasp, events.carry)) < 5.0
    assert labels == [
        f"{side} hand: {task}" for segment in hand_places(SCENE) for side, _, task in segment
    ]
    assert hands.places() == ()
    assert events.carry.time_s < hands.duration_s < TIMEOUT_S


HEADSET = """
[hands]
frame = "webxr"
base_from_tracker = [1.45, 0.0, -0.75, 0.5, 0.5, 0.5, 0.5]
[trackers.unity]
unit = "cm"
axes = "left-handed"
base_from_tracker = [1.45, 0.0, -0.75, 0.5, 0.5, 0.5, 0.5]
"""


@pytest.mark.parametrize(
    ("frame", "position"),
    [(BASE, (0.9, 0.1, 0.05)), ("webxr", (0.1, 0.8, -0.55)), ("unity", (10.0, 80.0, 55.0))],
)
def test_hands_are_mapped_as_by_the_daemon(frame: str, position: Point) -> None:
    hands = TrackedHands(SCENE, parse(HEADSET, origin="a test"))
    for side in ("left", "right"):
        hands.receive(side, PoseStamped(1, frame, position, HAND_ORIENTATION))
    assert hands.ready
    assert tuple(hands.truth(0.0).left.position) == pytest.approx((0.9, 0.1, 0.05))
