"""The mean of a primitive mixed with the average of the reference points nearby."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kmp import KMP, GaussianKernel, Gaussians
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill import SIGNS
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.model import NO_CLOCK, Seen
from thirdhand.core.skill.support import LocalErrors, mix, neighbour_table
from thirdhand.core.skill.tuning import (
    LEAST_STD_M,
    NEIGHBOUR_M,
    NEIGHBOUR_MASS,
    SUPPORT_MASS,
    UNSURE_M,
)

UNKNOWN_STD_M = 0.3


@pytest.fixture(scope="module")
def model() -> HandsKMP:
    """A smooth primitive of tools that jump, with held-out errors of 1 cm, half mixed."""
    random = np.random.default_rng(3)
    hands = random.uniform(-0.4, 0.4, (150, 6)) * (1.0, 1.0, 0.1, 0.1, 0.1, 0.1)
    tools = np.stack([np.sign(hands[:, 0]) * 0.2, hands[:, 1], 0.1 * hands[:, 0]], axis=1)
    primitive = KMP.fit(
        hands,
        Gaussians(tools, np.tile(0.05 * np.eye(3), (150, 1, 1))),
        kernel=GaussianKernel(1.0),
        lambda_mean=1.0,
    )
    errors = LocalErrors.of(primitive, hands, 0.01 * random.normal(size=(150, 3)), UNKNOWN_STD_M)
    return HandsKMP(primitive, errors=errors, neighbours=0.5)


def seen(hands: Vector, velocity: Vector, acceleration: Vector) -> Seen:
    moving = np.stack([hands, velocity, acceleration])
    return Seen(
        moving, np.ones(2), np.zeros((4, 6)), np.empty((0, 18)), 0.03, moving, np.zeros(64), 0.0,
        NO_CLOCK,
    )  # fmt: skip


def signs_of(model: HandsKMP, inputs: Vector, tools: Vector) -> Vector:
    return model.uncertainty(inputs, tools)[1]


def test_the_average_keeps_what_a_smooth_mean_blurs(model: HandsKMP) -> None:
    at = np.array([[-0.1, 0.1, 0, 0, 0, 0], [0.1, 0.1, 0, 0, 0, 0]])
    plain = replace(model, neighbours=0.0)
    wanted = np.array([-0.2, 0.2])
    mixed_m, plain_m = (np.abs(one.tools(at)[:, 0] - wanted).mean() for one in (model, plain))
    assert mixed_m < 0.9 * plain_m
    far = np.full((1, 6), 3.0)
    np.testing.assert_allclose(model.tools(far), plain.tools(far), atol=1e-12)


def test_the_motion_is_the_derivative_of_the_mean(model: HandsKMP) -> None:
    random = np.random.default_rng(4)
    step_s = 1e-3
    for _ in range(20):
        hands = random.uniform(-0.3, 0.3, 6)
        velocity, acceleration = random.normal(size=(2, 6))
        times = np.array([-step_s, 0.0, step_s])[:, None]
        before, now, after = model.tools(hands + times * velocity + 0.5 * times**2 * acceleration)
        motion = model.predict(seen(hands, velocity, acceleration), None)
        np.testing.assert_allclose(motion.position, now, atol=1e-6)
        np.testing.assert_allclose(motion.velocity, (after - before) / (2 * step_s), atol=2e-3)
        np.testing.assert_allclose(
            motion.acceleration, (after - 2 * now + before) / step_s**2, atol=0.02
        )


def test_without_a_share_the_motion_stays(model: HandsKMP) -> None:
    random = np.random.default_rng(5)
    motion = random.normal(size=(3, 3))
    mixed = motion.copy()
    table = neighbour_table(np.ones((4, 6)), np.ones((4, 3)))
    mix(random.normal(size=(3, 6)), table, np.ones(6), 0.0, 0.1, mixed, np.empty(SIGNS))
    np.testing.assert_array_equal(mixed, motion)


@pytest.mark.parametrize("radius", [0.0, 0.03])
def test_via_points_are_met_as_by_the_primitive(model: HandsKMP, radius: float) -> None:
    random = np.random.default_rng(6)
    for _ in range(10):
        left, right = random.uniform(-0.3, 0.3, (2, 3)) * (1.0, 1.0, 0.1)
        tool = tuple(random.uniform(-0.3, 0.3, 3).tolist())
        point = ViaPoint("there", tuple(left.tolist()), tuple(right.tolist()), tool, radius=radius)
        hands = np.array([[*point.left, *point.right]])
        missed_m = []
        for share in (0.0, 0.5):
            kind = replace(model, neighbours=share)
            adapted = kind.through([point], tolerance=0.03, weight=1.0 / 150)
            missed_m.append(float(np.linalg.norm(adapted.mean(hands)[0] - tool)))
        assert missed_m[1] < max(2.0 * missed_m[0], 2e-3)


def test_signs_grow_where_the_tool_is_doubtful(model: HandsKMP) -> None:
    """Spread where the tool jumps, distance of a tool that is elsewhere, and scatter far away."""
    inside = np.array([[0.25, 0.0, 0, 0, 0, 0]])
    at_jump = np.zeros((1, 6))
    far = np.full((1, 6), 2.0)
    calm, jumping, beyond = (signs_of(model, x, model.tools(x))[0] for x in (inside, at_jump, far))
    moved = signs_of(model, inside, model.tools(inside) + np.array([0.0, 0.0, 2 * UNSURE_M]))[0]
    spread, distance, scatter = slice(0, 6, 2), slice(1, 6, 2), slice(6, SIGNS)
    assert (jumping[spread] > calm[spread]).all()
    assert (moved[distance] > calm[distance] + 0.5).all()
    assert (beyond[scatter] > calm[scatter] + 1.0).all()
    assert np.exp(beyond[scatter]) * UNSURE_M == pytest.approx(3**0.5 * UNKNOWN_STD_M, rel=0.01)
    # a tool that is nowhere near is unknown, not far from its neighbours
    assert np.exp(beyond[0]) * UNSURE_M == pytest.approx(3**0.5 * UNKNOWN_STD_M, rel=0.01)
    assert NEIGHBOUR_M < 0.5
    assert model.predict(seen(inside[0], *np.zeros((2, 6))), None).signs == pytest.approx(
        calm, abs=1e-3
    )
    assert not len(model.predict(seen(inside[0], *np.zeros((2, 6))), np.eye(3)).signs)


def test_signs_are_those_of_their_equations(model: HandsKMP) -> None:
    errors = model.errors
    assert errors is not None
    base = model.primitive.base
    hands = np.random.default_rng(7).uniform(-0.4, 0.4, (10, 6))
    tools = model.tools(hands) + 0.02
    for row, tool, signs in zip(hands, tools, signs_of(model, hands, tools), strict=True):
        squares = ((base.inputs - row) ** 2).sum(axis=1)
        expected = []
        for width_m in NEIGHBOUR_M * np.array([1.0, 2.0, 4.0]):
            g = np.exp(-squares / (2 * width_m**2))
            mass, total = g.sum(), g.sum() + NEIGHBOUR_MASS
            off = base.reference.mean - tool
            scattered = g @ (base.reference.mean**2).sum(axis=1)
            scattered -= ((g @ base.reference.mean) ** 2).sum() / max(mass, NEIGHBOUR_MASS)
            spread = (3 * NEIGHBOUR_MASS * UNKNOWN_STD_M**2 + scattered) / total
            expected += [spread, ((g @ off / total) ** 2).sum()]
        near = np.exp(-(((errors.inputs - row) * errors.stretch) ** 2).sum(axis=1))
        for g in (near**2, near**0.25):
            scatter = g @ (errors.errors**2).sum(axis=1) + 3 * SUPPORT_MASS * UNKNOWN_STD_M**2
            expected.append(scatter / (SUPPORT_MASS + g.sum()))
        lengths = 0.5 * np.log(np.array(expected) / UNSURE_M**2 + (LEAST_STD_M / UNSURE_M) ** 2)
        np.testing.assert_allclose(signs, lengths, atol=1e-6)
