"""The hands of a person at the bench, as a tracker, a browser or another program publishes them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thirdhand.contract.messages import BASE, PoseStamped, SceneObject
from thirdhand.contract.records import SIDES
from thirdhand.settings import palette
from thirdhand.settings.config import Settings
from thirdhand.workbench.takes.demonstration_reader import from_tracker, is_by_tracker
from thirdhand_sim.scene import ARRIVED_M, HAND_ORIENTATION, Point, Scene
from thirdhand_sim.script import Array, HandMotions, PointMotion, TaskProgress
from thirdhand_sim.world import LEVEL

# an event is observed for this time after it was reached, as it is in the scripted scene
OBSERVED_S = 0.8
PLACE_OPACITY = 0.3
HAND_COLOURS = dict(zip(SIDES, (palette.LEFT, palette.RIGHT), strict=True))
AT_REST = np.zeros(3)


class HandPlace(NamedTuple):
    """A place of one hand [m], and what the hand does there."""

    side: str
    at: Point
    task: str


def hand_places(scene: Scene) -> tuple[tuple[HandPlace, ...], ...]:
    """The places of the hands at each of the three events."""
    return (
        (HandPlace("left", scene.handover, "take the board"),),
        (
            HandPlace("left", scene.soldering, "lay the board here"),
            HandPlace("right", scene.iron, "take the iron"),
        ),
        (
            HandPlace("left", scene.soldering, "stay at the board"),
            HandPlace("right", scene.right_final, "solder here"),
        ),
    )


class TrackedHands:
    """Hands that are received while the bench runs, in place of a `HandScript`.

    The person decides when: an event is observed while the hands are within ARRIVED_M of its
    places. The next event begins OBSERVED_S after it was reached, or when the hands leave.
    """

    seed = 0

    def __init__(self, scene: Scene, settings: Settings, *, timeout_s: float = math.inf) -> None:
        """The settings map the hands to frame `base`. The task ends `timeout_s` [s] after its
        begin, whether its events were reached or not.
        """
        self.scene = scene
        self._settings = settings
        self._timeout_s = timeout_s
        self._places = hand_places(scene)
        self._newest: dict[str, Point] = {}  # [m] frame `base`
        # a frame that the settings do not know, in which hands arrived; they are ignored
        self.foreign = ""
        self.begin()

    def receive(self, side: str, pose: PoseStamped) -> None:
        """Store a sample of one hand. For any thread."""
        if pose.frame_id not in self._settings.tracker_frames:
            self.foreign = pose.frame_id
            return
        hands, x, y, z = self._settings.hands_in(pose.frame_id), *pose.position
        if is_by_tracker(f"hands/{side}", pose.frame_id, hands):
            x, y, z = from_tracker(np.array([pose.position]), hands)[0].tolist()
        self._newest[side] = x, y, z

    @property
    def refusal(self) -> str:
        """The remark on hands that are ignored, empty if none are."""
        return f"; those in frame {self.foreign!r} are ignored" if self.foreign else ""

    @property
    def ready(self) -> bool:
        """True once both hands were seen."""
        return len(self._newest) == len(SIDES)

    @property
    def duration_s(self) -> float:
        """Time of the task's end [s]: the last event is over, or the time-out has passed."""
        return self._ended_s

    def begin(self) -> None:
        """Begin the task anew."""
        self._over = 0
        self._reached_s = math.inf
        self._ended_s = self._timeout_s

    def truth(self, t: float) -> HandMotions:
        """The newest positions of both hands; before the first sample, the scene's start."""
        scene = self.scene
        left, right = (
            PointMotion(np.array(self._newest.get(side, start)), AT_REST, AT_REST)
            for side, start in zip(SIDES, (scene.left_start, scene.right_start), strict=True)
        )
        return HandMotions(left, right)

    def sample(self, t: float) -> tuple[Array, Array]:
        """The newest poses of the left and the right hand, (7,) each, as `HandScript.sample`."""
        left, right = (np.concatenate((hand.position, HAND_ORIENTATION)) for hand in self.truth(t))
        return left, right

    def progress(self, t: float, reached: int) -> TaskProgress:
        """The progress at a time `t` [s], when `reached` events in a row have been reached."""
        hands = self.truth(t)._asdict()
        if self._over == len(self._places):
            return TaskProgress(None, self._over)
        arrived = all(
            math.dist(hands[side].position, position) <= ARRIVED_M
            for side, position, _ in self._places[self._over]
        )
        if reached > self._over:
            self._reached_s = min(self._reached_s, t)
            if not arrived or t - self._reached_s >= OBSERVED_S:
                self._over = self._over + 1
                self._reached_s = math.inf
                if self._over == len(self._places):
                    self._ended_s = min(t, self._timeout_s)
                return TaskProgress(None, self._over)
        return TaskProgress(self._over if arrived else None, self._over)

    def places(self) -> tuple[SceneObject, ...]:
        """The places to which the hands belong next, as viewers draw them: a ball each, whose name
        is `left hand: ` or `right hand: ` and what the hand does there.
        """
        size = (2 * ARRIVED_M,) * 3
        return tuple(
            SceneObject(f"{side} hand: {task}", "ball", BASE, position, LEVEL, size, _faint(side))
            for side, position, task in (
                self._places[self._over] if self._over < len(self._places) else ()
            )
        )


def _faint(side: str) -> tuple[float, float, float, float]:
    red, green, blue = (value / 255 for value in HAND_COLOURS[side])
    return red, green, blue, PLACE_OPACITY
