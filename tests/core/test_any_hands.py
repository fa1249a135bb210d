"""The core under hands that no person has: alternating, noisy, told by two trackers, swapped, in
wild motion, held and let go at any time; the tool keeps its bounds.

`THIRDHAND_EXAMPLES=3000 pytest tests/core/test_any_hands.py` draws more.
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
from service.core.arm.arm import Arm
from service.core.controller import Controller
from service.core.frame import Tick, Vector, order
from service.core.setpoint.setpoint import STOP_BRAKE
from service.learning.skill_file import decoded
from support.in_process import ASSUMED, LEFT, RIGHT, hand
from support.paths import RECORDINGS
from support.wam import URDF

PERIOD_S, TICKS = 0.002, 1000
SECONDS, LOOPS = 2.0, st.sampled_from([500, 250, 1000])  # of a legal hand, and rates [Hz] of the loop
ARM = Arm(ASSUMED, URDF)
SKILL = replace(decoded((RECORDINGS / "soldering.npz").read_bytes(), origin="soldering"), threshold=math.inf)
FASTEST = ASSUMED.tool.max_speed
RISE, RISE_MPS = 1.01, 0.01  # of a stop over what the tool had or was coming to: joints' jerks differ
KINDS = ("alternating", "noisy", "two sources", "swapped", "trembling", "wandering")
MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "20"))


def samples(kind: str, spread_m: float, rate_hz: float, seed: int) -> list[tuple[float, Vector]]:
    """Times [s] and both hands (2, 3) [m], as trackers tell them."""
    random = np.random.default_rng(seed)
    centre = np.array([LEFT, RIGHT]) + random.uniform(-0.05, 0.05, (2, 3))
    way = random.standard_normal((2, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    out = []
    walk = np.zeros((2, 3))
    speed = np.zeros((2, 3))
    for k, t in enumerate(np.arange(0.0, TICKS * PERIOD_S, 1.0 / rate_hz)):
        at = centre.copy()
        if kind == "alternating":
            at += spread_m * way * (1 if k % 2 else -1)
        elif kind == "noisy":
            at += spread_m * random.standard_normal((2, 3))
        elif kind == "two sources":
            at += spread_m * way * math.sin(2.0 * math.pi * t) + (
                spread_m * way[::-1] if random.random() < 0.5 else 0.0
            )
        elif kind == "swapped":
            at = at[::-1] if (k // int(1 + rate_hz * spread_m * 3)) % 2 else at
        elif kind == "trembling":
            at += spread_m * way * math.sin(2.0 * math.pi * (1.0 + 11.0 * (seed % 100) / 100.0) * t)
        else:
            speed += random.standard_normal((2, 3)) * math.sqrt(1.0 / rate_hz) * 4.0 - 2.0 * speed / rate_hz
            walk += speed / rate_hz - walk / rate_hz
            at += walk * spread_m / 0.1
        out.append((float(t), at))
    return out


@example_settings(max_examples=MANY, deadline=None, derandomize=True)
@given(st.sampled_from(KINDS), st.floats(0.002, 0.2), st.sampled_from([30, 60, 100, 240, 500]), st.integers(0, 10**6))
def test_the_tool_keeps_its_speed_following_and_stopping(kind: str, spread_m: float, rate_hz: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    controller = Controller(ASSUMED, SKILL, urdf=URDF)
    told = samples(kind, spread_m, rate_hz, seed)
    turns = set(np.cumsum(random.integers(60, 400, 12)).tolist())
    held, allowed, beyond = False, 0.0, []
    for k in range(TICKS):
        inbox = []
        while told and told[0][0] <= k * PERIOD_S:
            at = told.pop(0)[1]
            inbox += [hand(side, tuple(at[i].tolist()), k + 1) for i, side in enumerate(SIDES)]
        if k in turns:
            held = not held
            inbox.append(order("hold" if held else "resume"))
        frame = controller.step(Tick(k, tuple(inbox)))
        assert frame["mode"] != Mode.FAULT, (k, frame["reason"])
        here = ARM.at(frame["joints"])
        speed, coming = ARM.speeds(here, frame["joint_velocities"], frame["joint_accelerations"])
        if frame["mode"] == Mode.FOLLOW:
            assert speed <= FASTEST + 1e-6
            allowed = RISE * coming + RISE_MPS
        elif speed > allowed:
            beyond.append((k, speed, allowed))
    assert not beyond, beyond[:3]


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
    lasts = max(1.875 * far / max_speed, math.sqrt(5.774 * far / STOP_BRAKE))
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
