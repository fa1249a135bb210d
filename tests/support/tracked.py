"""An intake without the other stages, which receives hands and arms sample by sample."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from support.wam import FRAME, JOINT_NAMES, STATE
from thirdhand.contract.messages import JointState, PoseStamped
from thirdhand.contract.records import Cause
from thirdhand.core.codes import ARM_HEARD
from thirdhand.core.frame import Record, Vector, blank, copied
from thirdhand.core.intake.hand_estimator import is_fresh
from thirdhand.core.intake.stage import Intake
from thirdhand.settings.config import HandSettings, Settings, TrackerSettings

PERIOD_S = 0.002
LEFT = 0
RIGHT = 1
STRAIGHT = (0.0, 0.0, 0.0, 1.0)


class Hands:
    """An intake and its state, advanced tick by tick."""

    def __init__(
        self,
        hands: HandSettings | None = None,
        *,
        rate_hz: int = 500,
        trackers: dict[str, TrackerSettings] | None = None,
    ) -> None:
        self.settings = Settings(
            hands=hands or HandSettings(), rate_hz=rate_hz, trackers=trackers or {}
        )
        self.intake = Intake(self.settings)
        self.state: Record = blank(STATE)
        self.intake.begin(self.state)
        self.advance()

    def advance(self, ticks: int = 1) -> None:
        self.intake.advance(self.state, ticks)

    def hand(
        self,
        stamp_ns: int,
        position: tuple[float, ...] = (0.5, 0.1, 0.2),
        turn: tuple[float, ...] = STRAIGHT,
        side: int = LEFT,
    ) -> Vector:
        """The filtered position (3,) [m] after one more sample."""
        self.intake.take_hand(self.state, side, PoseStamped(stamp_ns, "base", position, turn))  # type: ignore[arg-type]
        return np.array(self.state["hands"][side, 0])

    def arm(
        self,
        stamp_ns: int,
        names: tuple[str, ...] = JOINT_NAMES,
        position: tuple[float, ...] = (0.1,) * 7,
        velocity: tuple[float, ...] = (),
    ) -> None:
        self.intake.take_arm(self.state, JointState(stamp_ns, names, position, velocity))

    def fresh(self, side: int = LEFT) -> bool:
        stale_ticks = max(1, round(self.settings.hands.stale_ms / 1000 * self.settings.rate_hz))
        return bool(is_fresh(self.state, side, stale_ticks))

    def heard(self) -> bool:
        """True if the arm has reported its joints recently enough."""
        return bool(self.intake.step(copied(self.state), blank(FRAME), 0, []) & ARM_HEARD)

    def rejected(self) -> dict[Cause, int]:
        return {
            cause: int(self.state["rejected"][cause])
            for cause in Cause
            if self.state["rejected"][cause]
        }


def follow(
    hands: Hands,
    where: Callable[[float], Vector],
    *,
    until_s: float,
    rate_hz: int = 100,
    noise: Vector | None = None,
) -> Vector:
    """The filter's states (T, 3, 3) at each tick while a hand is sampled at a rate."""
    states = []
    taken = 0
    for tick in range(round(until_s / PERIOD_S)):
        if tick:
            hands.advance()
        if tick * PERIOD_S * rate_hz >= taken - 1e-9:
            stamp_s = tick * PERIOD_S
            position = where(stamp_s) + (0.0 if noise is None else noise[taken])
            hands.hand(1_000_000_000 + round(stamp_s * 1e9), tuple(position.tolist()))
            taken += 1
        states.append(hands.state["hands"][LEFT].copy())
    assert hands.rejected() == {}
    return np.array(states)
