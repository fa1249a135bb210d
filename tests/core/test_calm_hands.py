"""The whole core with hands that tremble at rest, and that go slowly: what is left of tremor and
noise in the tool.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from service.contract.records import SIDES
from service.core.controller import Controller
from service.core.frame import Tick, Vector
from service.core.skill.skill import Skill
from service.learning.skill_file import decoded
from support.in_process import ASSUMED, frames, hand
from support.paths import RECORDINGS
from support.wam import URDF

PERIOD_S, EVERY = 0.002, 5  # of the loop, and ticks from sample to sample
NOISE_M = 0.0005  # of a tracker, each axis
COMES_S = 2.0  # in which the tool comes to where the hands want it
KNOWN_S = 2.0  # after which it is known how fast a slow hand goes
AS_PAPER = "experiments/as-paper"  # a function of where hands are alone
FAST = butter(4, 4.0, "highpass", fs=1.0 / PERIOD_S, output="sos")


def known(name: str) -> Skill:
    return replace(decoded((RECORDINGS / f"{name}.npz").read_bytes(), origin=name), threshold=math.inf)


def followed(skill: Skill, hands: Vector) -> np.ndarray:
    """The frames (T,) while a noisy tracker tells of hands (T, 6) [m]."""
    random = np.random.default_rng(1)
    told = hands + NOISE_M * random.standard_normal(hands.shape)
    ticks = [
        Tick(
            k,
            tuple(hand(side, tuple(at.tolist()), k + 1) for side, at in zip(SIDES, told[k].reshape(2, 3), strict=True)),
        )
        if k % EVERY == 0
        else Tick(k, ())
        for k in range(len(told))
    ]
    return frames(Controller(ASSUMED, skill, urdf=URDF), ticks)


def above_4_hz(values: Vector) -> float:
    """The root mean square of what is faster, once the tool has come."""
    fast = sosfiltfilt(FAST, values, axis=0)[round(COMES_S / PERIOD_S) : -250]
    return float(np.sqrt(np.mean(np.sum(fast**2, axis=1))))


@pytest.mark.parametrize("size_m", [0.0003, 0.001, 0.002])
@pytest.mark.parametrize("name", ["soldering", AS_PAPER])
def test_a_tremor_of_hands_at_rest_does_not_reach_the_tool(name: str, size_m: float) -> None:
    one, random, t = known(name), np.random.default_rng(0), np.arange(0.0, 5.0, PERIOD_S)
    hands = np.tile(one.hands.mean(axis=0), (len(t), 1))
    for side in (0, 3):
        rates = np.interp(t, np.arange(0.0, 6.0, 0.5), random.uniform(8.0, 12.0, 12))
        way = random.standard_normal(3)
        tremor = np.sin(2.0 * np.pi * np.cumsum(rates) * PERIOD_S)
        hands[:, side : side + 3] += size_m * tremor[:, None] * way / np.linalg.norm(way)
    found = followed(one, hands)
    assert above_4_hz(found["tool"]) < 0.0002
    axes = Rotation.from_quat(found["tool_orientation"]).apply((0.0, 0.0, 1.0))
    assert math.degrees(above_4_hz(axes)) < 0.2


def along(speed: float, parts: slice) -> Vector:
    """The tool's speed (T,) [m/s] on its way while hands, those parts of (6,), go evenly."""
    one, t = known(AS_PAPER), np.arange(0.0, 9.0, PERIOD_S)
    hands = np.tile(one.hands.mean(axis=0), (len(t), 1))
    way = np.array([0.3, 0.9, 0.3] * 2)[parts] / np.linalg.norm([0.3, 0.9, 0.3])
    hands[:, parts] += speed * np.maximum(t - COMES_S, 0.0)[:, None] * way
    tool = followed(one, hands)["tool"][round((COMES_S + KNOWN_S) / PERIOD_S) :]
    return np.asarray(np.diff(tool, axis=0) / PERIOD_S @ (tool[-1] - tool[0]) / np.linalg.norm(tool[-1] - tool[0]))


@pytest.mark.parametrize("speed", [0.002, 0.005, 0.02])
def test_a_tool_goes_evenly_with_a_slow_hand(speed: float) -> None:
    assert along(speed, slice(0, 3)).std() < 0.001


@pytest.mark.parametrize(("speed", "parts"), [(0.01, slice(0, 3)), (0.005, slice(0, 6))])
def test_a_tool_never_turns_back_where_slow_hands_go_on(speed: float, parts: slice) -> None:
    assert along(speed, parts).min() > 0.0
