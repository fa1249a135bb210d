"""Legal hands: with noise, late samples and short dropouts the core neither faults nor holds.

`THIRDHAND_EXAMPLES=3000 pytest tests/core/test_legal_hands.py` draws more.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace

import msgspec
import numpy as np
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from service.contract.records import SIDES, Cause, Mode
from service.core.controller import Controller
from service.core.frame import Tick
from service.core.setpoint.tuning import HAND_BRAKE_MPS2
from service.learning.skill_file import decoded
from support.in_process import ASSUMED, LEFT, RIGHT, hand
from support.paths import RECORDINGS
from support.wam import URDF

SECONDS, LOOPS = 2.0, st.sampled_from([500, 250, 1000])  # of a legal hand, and rates [Hz] of the loop
SKILL = replace(decoded((RECORDINGS / "soldering.npz").read_bytes(), origin="soldering"), threshold=math.inf)
MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "20"))


@example_settings(max_examples=MANY, deadline=None, derandomize=True)
@given(st.floats(0.1, 1.5), st.floats(0.0, 0.003), st.floats(30.0, 500.0), LOOPS, st.integers(0, 10**6))
def test_a_legal_hand_never_faults_nor_jumps_and_hardly_holds(
    max_speed: float, noise_m: float, rate_hz: float, loop_hz: int, seed: int
) -> None:
    """Reaches there and back at up to 1.5 m/s, with noise, late samples and dropouts of 30 to 90
    ms.
    """
    random = np.random.default_rng(seed)
    settings = msgspec.structs.replace(ASSUMED, rate_hz=loop_hz)
    controller, ticks = Controller(settings, SKILL, urdf=URDF), round(SECONDS * loop_hz)
    way = random.standard_normal((2, 3))
    way *= random.uniform(0.05, 0.3) / np.linalg.norm(way, axis=1, keepdims=True)
    far = np.linalg.norm(way, axis=1).max()
    # a minimum-jerk reach, which no hand brakes harder at its end than the setpoint takes it to
    lasts = max(1.875 * far / max_speed, math.sqrt(5.774 * far / HAND_BRAKE_MPS2))
    stamps = np.arange(0.0, SECONDS, 1.0 / rate_hz)
    missing = np.zeros(len(stamps), bool)
    for at in random.uniform(0.0, SECONDS, 2):
        missing |= (stamps > at) & (stamps < at + random.uniform(0.03, 0.09) - 1.0 / rate_hz)
    told = stamps[~missing]
    held = 0
    for k in range(ticks):
        inbox = []
        while len(told) and told[0] <= k / loop_hz:
            turns, u = divmod(told[0] / lasts, 1.0)
            there = u**3 * (10 - 15 * u + 6 * u * u)
            moved = way * (1.0 - there if turns % 2 else there) + noise_m * random.standard_normal((2, 3))
            inbox = [
                hand(s, tuple((np.array((LEFT, RIGHT)[i]) + moved[i]).tolist()), k + 1) for i, s in enumerate(SIDES)
            ]
            told = told[1:]
        frame = controller.step(Tick(k, tuple(inbox)))
        assert frame["mode"] != Mode.FAULT, (k, frame["reason"])
        held += frame["mode"] == Mode.HOLD
    assert frame["rejected"].tolist() == [0] * len(Cause)
    assert held <= 0.02 * ticks
