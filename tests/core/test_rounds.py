"""The shipped skill through a day: in every round of a session, its targets are as in the first."""

from __future__ import annotations

import numpy as np
import pytest

from support.in_process import ASSUMED, Loop
from thirdhand.contract.records import Mode
from thirdhand.core.frame import Event, Vector, order
from thirdhand.core.skill.skill import Skill
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

BACK_S = 2.0
REST_S = (1.5, 0.5, 1.0, 3.0, 0.5, 0.5)
HALF = 3  # number of the round that is broken off halfway
EVENTS = {  # the event of a round and its time
    1: ((3.0, "hold"), (4.0, "resume")),
    4: ((3.0, "fault"), (4.0, "reset")),
}


def way(first: Vector, last: Vector, period_s: float) -> Vector:
    """The hands (T, 2, 3) [m] on their return."""
    share = np.arange(period_s, BACK_S, period_s)[:, None, None] / BACK_S
    return first + share**3 * (10 - 15 * share + 6 * share**2) * (last - first)


@pytest.mark.thorough
def test_every_round_is_as_the_first(taught: Skill) -> None:
    """There is a hold, a fault and a round that is broken off; rests last 0.5 to 3 s."""
    script = HandScript(Scene(), seed=1)
    period_s = ASSUMED.period_s
    whole = np.array(
        [np.array(script.sample(t))[:, :3] for t in np.arange(0.0, script.duration_s, period_s)]
    )
    hands: list[Vector] = []
    begins: list[int] = []
    events: dict[int, Event] = {}
    for number, rest_s in enumerate(REST_S):
        if number:
            hands.append(way(hands[-1][-1], whole[0], period_s))
        rests = round(rest_s / period_s)
        # rounds are whole sample periods, so that samples of all rounds agree
        rests += -(sum(map(len, hands)) + rests) % 5
        hands.append(np.repeat(whole[:1], rests, axis=0))
        begins.append(sum(map(len, hands)))
        hands.append(whole[: len(whole) // 2] if number == HALF else whole)
        events |= {
            begins[-1] + round(at_s / period_s): order(kind)
            for at_s, kind in EVENTS.get(number, ())
        }
    positions = np.concatenate(hands)

    loop = Loop(ASSUMED, taught)
    loop.hands = lambda k: positions[k]
    frames = loop.run(len(positions), events)
    first, *others = (frames[begin : begin + len(whole)] for begin in begins)
    for number, later in enumerate(others, 1):
        if number != HALF:
            assert np.abs(later["target"] - first["target"]).max() < 0.001
            is_led = np.arange(len(whole)) * period_s < (5.0 if number in EVENTS else 0.5)
            assert (later["mode"][~is_led] == Mode.FOLLOW).all()
