"""A policy whose wishes are drawn at random: chunks and single poses, of which some are wrong."""

from __future__ import annotations

import math

import numpy as np

from thirdhand.contract import cdr
from thirdhand.contract.messages import BASE, PoseStamped, PoseWithCovarianceStamped
from thirdhand.core.frame import Event, Vector
from thirdhand.settings.config import Settings

SHARES_WRONG = (0.0, 0.0, 0.02, 0.2)
PLACES_M = np.array([[0.25, -0.5, 0.1], [0.75, 0.5, 0.6]])


def wish(
    position: Vector,
    orientation: Vector,
    stamp_ns: int,
    *,
    frame: str = BASE,
    covariance: tuple[float, ...] = (),
) -> Event:
    """A wish as an event."""
    pose = PoseStamped(stamp_ns, frame, tuple(map(float, position)), tuple(map(float, orientation)))
    if not covariance:
        return Event("tool/wish", cdr.encode_pose(pose), pose)
    whole = PoseWithCovarianceStamped(*pose, covariance)
    return Event("tool/wish", cdr.encode_pose_with_covariance(whole), whole)


class DrawnPolicy:
    """Wishes for a tool that goes from place to place."""

    def __init__(self, random: np.random.Generator, period_s: float, orientation: Vector) -> None:
        self._random = random
        self._period_s = period_s
        self._orientation = np.array(orientation)
        self._steps = int(random.choice([1, 1, 8, 30]))
        self._step_s = float(random.choice([0.002, 0.011, 0.033, 0.1]))
        self._every_s = float(random.choice([0.01, 0.05, 0.3, 0.9]))
        self._late_s = float(random.choice([0.0, 0.05, 0.4]))
        self._speed_mps = float(random.choice([0.05, 0.3, 1.5]))
        self._wrong = float(random.choice(SHARES_WRONG))
        self._place = random.uniform(*PLACES_M)
        self._goal = self._place
        self._next_s = 0.0

    @classmethod
    def of(
        cls, random: np.random.Generator, settings: Settings, orientation: Vector
    ) -> DrawnPolicy | None:
        """The policy of a session with these settings; None if no wishes lead there."""
        if not settings.skill.has_wishes:
            return None
        own = np.random.default_rng(int(random.integers(10**6)))
        return cls(own, settings.period_s, orientation)

    def events(self, now_s: float, time_ns: int, *, is_quiet: bool) -> list[Event]:
        """The wishes that arrive in a tick; once it is quiet, the same pose again and again."""
        random = self._random
        if now_s < self._next_s:
            return []
        self._next_s = now_s + (0.05 if is_quiet else self._every_s * random.uniform(0.3, 1.7))
        if is_quiet:
            return [wish(self._place, self._orientation, time_ns)]
        if random.random() < 0.1:
            self._goal = random.uniform(*PLACES_M)
        way = self._goal - self._place
        far_m = max(float(np.linalg.norm(way)), 1e-9)
        late_s = self._late_s * random.uniform(0.5, 1.5)
        out = []
        for k in range(self._steps):
            gone_m = min(self._speed_mps * k * self._step_s, far_m)
            position = self._place + gone_m / far_m * way + random.normal(0.0, 0.002, 3)
            stamp_ns = time_ns + round(1e9 * (k * self._step_s - late_s))
            out.append(self._perhaps_wrong(position, stamp_ns))
        moved_m = min(self._speed_mps * self._every_s, far_m)
        self._place = self._place + moved_m / far_m * way
        return out

    def _perhaps_wrong(self, position: Vector, stamp_ns: int) -> Event:
        random = self._random
        orientation = self._orientation
        frame = BASE
        covariance: tuple[float, ...] = ()
        if random.random() < 0.2:
            covariance = tuple((random.uniform(0.0, 1e-3) * np.eye(6)).ravel().tolist())
        if random.random() < self._wrong:
            match random.integers(8):
                case 0:
                    position = np.array([math.nan, 0.0, 0.0])
                case 1:
                    position = position + random.normal(0.0, 1.0, 3)
                case 2:
                    position = 1e9 * position
                case 3:
                    orientation = random.normal(size=4)
                case 4:
                    stamp_ns += round(1e9 * random.uniform(-1000.0, 1000.0))
                case 5:
                    frame = "elsewhere"
                case 6:
                    covariance = tuple((-np.eye(6)).ravel().tolist())
                case _:
                    stamp_ns = 0
        return wish(position, orientation, max(stamp_ns, 0), frame=frame, covariance=covariance)
