"""Ticks decided before their deadline are those that a controller without rehearsal decides."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from support.drawn_policy import wish
from support.in_process import ASSUMED, Loop
from support.wam import URDF
from thirdhand.core.controller import Controller, no_lap, outgoing
from thirdhand.core.frame import Event, Tick, order
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.rehearsed_controller import RehearsedController
from thirdhand.settings.config import Settings, SkillSettings
from thirdhand.skills.via_points import adapted
from thirdhand_sim.scene import Scene

START_NS = 10**18
PERIOD_NS = 2_000_000
PEDAL = Event("pedal", b"", None)  # of a kind that does not exist


class Given(NamedTuple):
    """A cell, the skill that it begins with, and its ticks."""

    settings: Settings
    skill: Skill
    ticks: list[Tick]


def led_by_hands(skill: Skill) -> Given:
    """Hands, an arm that lags, orders and an adopted skill."""
    taught = adapted(skill, Scene().via_points(), tolerance=0.05)
    loop = Loop(Settings(), skill)
    loop.reports = lambda q, dq: (q + 0.003, dq)
    orders = {150: order("hold"), 170: order("resume"), 200: Event("skill", b"", taught)}
    loop.run(400, orders)
    ticks = [
        # the second ones are rejected
        Tick(tick.index, (*tick.inbox, *tick.inbox), START_NS + PERIOD_NS * tick.index)
        for tick, _ in loop.steps
    ]
    return Given(Settings(), skill, ticks)


def led_by_wishes(skill: Skill) -> Given:
    """Chunks of a policy, whose age depends on the time of a tick; some are too old."""
    led = SkillSettings(source="tool/wish", blend=True)
    settings = msgspec.structs.replace(ASSUMED, skill=led)
    tool = Controller(settings, skill, urdf=URDF).step(Tick(0))["tool"]
    ticks = []
    for index in range(400):
        now_ns = START_NS + PERIOD_NS * index
        ahead_ms = [0, 33, 66, -5000] if index % 50 == 0 else []
        offset = np.array([0.0, 1e-4 * index, 0.0])
        wishes = [wish(tool + offset, skill.orientation, now_ns + 10**6 * ms) for ms in ahead_ms]
        ticks.append(Tick(index, tuple(wishes), now_ns))
    return Given(settings, skill, ticks)


@pytest.mark.parametrize("session", [led_by_hands, led_by_wishes])
def test_rehearsed_ticks_are_decided_alike(skill: Skill, session: Callable[[Skill], Given]) -> None:
    """Only a rehearsal of an equal tick is taken; others leave no trace, nor do those that fail."""
    settings, first, ticks = session(skill)
    alone = Controller(settings, first, urdf=URDF)
    core = RehearsedController(settings, first)
    random = np.random.default_rng(7)
    taken = failed = 0
    for tick in ticks:
        part = tick.inbox[: int(random.integers(len(tick.inbox) + 1))]
        tried: Tick | None = [
            tick,
            Tick(tick.index, part, tick.time_ns),
            Tick(tick.index, tick.inbox, tick.time_ns + 1000),
            Tick(tick.index + 1, tick.inbox, tick.time_ns),
            None,
        ][random.integers(5)]
        before = core.controller.state.tobytes()
        if tried is not None:
            core.rehearse(tried, no_lap)
        if random.random() < 0.1:
            with pytest.raises(ValueError, match="nothing is done with an event"):
                core.rehearse(Tick(tick.index, (*tick.inbox, PEDAL), tick.time_ns), no_lap)
            tried = None
            failed += 1
        assert core.controller.state.tobytes() == before
        decided = core.decide(tick, no_lap)
        assert (core.controller.state.tobytes() == before) == (tried == tick)
        core.settle()
        taken += tried == tick

        frame = alone.step(tick)
        assert core.controller.state.tobytes() == alone.state.tobytes()
        assert decided.tick == tick
        assert decided.frame.tobytes() == frame.tobytes()
        assert decided.outputs == outgoing(frame, tick.time_ns, settings.joints.names)
    assert 0.1 * len(ticks) < taken < 0.9 * len(ticks)
    assert failed > 10
    assert core.controller.skill.digest == alone.skill.digest
    assert alone.intake.rejected.any()
    assert np.array_equal(core.controller.intake.rejected, alone.intake.rejected)
    assert core.controller.intake.refused == alone.intake.refused
    assert core.controller.decision.measured == alone.decision.measured
