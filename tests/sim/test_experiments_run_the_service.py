"""Experiments measure the service: for the same hands, each family of experiments gives the same
bits as a separate `Controller`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import msgspec
import numpy as np
import pytest

pytest.importorskip("movement_primitives", reason="ProMPs need movement_primitives")

from support.in_process import ASSUMED, hand
from thirdhand.contract.records import SIDES, Mode
from thirdhand.contract.requests import TOLERANCE_M
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Event, Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.via_points import adapted
from thirdhand_sim.lab import rehearsal
from thirdhand_sim.lab.people.moving_hands import stops
from thirdhand_sim.lab.people.trials import TRIAL_HZ, SeenSession, seen, served
from thirdhand_sim.lab.reached import ours
from thirdhand_sim.lab.rivals import followers
from thirdhand_sim.lab.rivals.service import LearnedByService
from thirdhand_sim.people import person
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript
from thirdhand_sim.sessions import session
from thirdhand_sim.teach import via_points_of

pytestmark = pytest.mark.thorough

PREDICTED = ("target", "target_velocity", "target_acceleration", "covariance", "gate_m")


def of_the_service(skill: Skill, ticks: Iterable[Tick], settings: Settings) -> np.ndarray:
    """The frames of a controller without code of an experiment."""
    controller = Controller(settings, skill, urdf=robot_description(settings))
    return np.array([controller.step(tick) for tick in ticks])


@pytest.fixture(scope="module")
def shown() -> SeenSession:
    """A session in which the service also holds, and reaches its limit of the target's
    acceleration.
    """
    return seen(session(person("tuning", 0), 0, group="tuning", sigma_m=0.005))


@pytest.fixture(scope="module")
def taught(shown: SeenSession) -> Skill:
    return adapted(shipped_skill(), via_points_of(shown.session.told), tolerance=TOLERANCE_M)


@pytest.fixture(scope="module")
def wanted(shown: SeenSession, taught: Skill) -> np.ndarray:
    """The service's frames from the trackers' samples in the order of arrival."""
    inboxes: list[list[Event]] = [[] for _ in shown.times]
    for side, (stamps, samples) in zip(SIDES, shown.session.samples(), strict=True):
        for stamp, position in zip(stamps, samples, strict=True):
            arrives = int(np.ceil(stamp * TRIAL_HZ - 1e-9))
            if arrives < len(inboxes):
                inboxes[arrives].append(
                    hand(side, tuple(position.tolist()), 10**12 + round(1e9 * float(stamp)))
                )
    ticks = [Tick(k, tuple(inbox)) for k, inbox in enumerate(inboxes)]
    return of_the_service(taught, ticks, msgspec.structs.replace(ASSUMED, rate_hz=TRIAL_HZ))


class TestPeople:
    """`people`: every method's trial is a run of the service."""

    def test_ours_is_what_the_controller_decides(
        self, shown: SeenSession, wanted: np.ndarray
    ) -> None:
        """The rival "ours" is the controller's prediction and decision."""
        placed = LearnedByService(shipped_skill(), start=True).place(shown.session.told)
        frames = served(placed, shown)
        for name in (*PREDICTED, "mode", "reason", "setpoint", "tool"):
            assert frames[name].tobytes() == wanted[name].tobytes(), name
        assert 0 < (wanted["mode"] == Mode.FOLLOW).sum() < len(wanted)

    def test_hands_are_those_of_the_controller(
        self, shown: SeenSession, wanted: np.ndarray
    ) -> None:
        """The estimates equal the controller's."""
        assert shown.estimates[:, 0].tobytes() == wanted["hands"].tobytes()
        assert shown.estimates[:, 1].tobytes() == wanted["hand_velocities"].tobytes()


def test_motion_follows_through_controller() -> None:
    skill = shipped_skill()
    hands = stops(skill.hands.mean(axis=0), numbers=(0,), rate_hz=30, noise=0.002)[0]
    motion = followers.ours(skill, Settings())(hands)
    settle = followers.SETTLE_TICKS
    period_s = followers.PERIOD_S
    arrives = np.ceil(hands.stamps / period_s - 1e-9).astype(int) + settle
    ticks = []
    for k in range(settle + len(hands.truth)):
        rows = [hands.samples[np.flatnonzero(arrives == k)[-1]]] if k in arrives else []
        rows = [hands.truth[0]] if k < settle and k % 5 == 0 and not rows else rows
        samples = [
            (side, part)
            for row in rows
            for side, part in zip(SIDES, (row[:3], row[3:]), strict=True)
        ]
        ticks.append(
            Tick(
                k,
                tuple(hand(side, tuple(part.tolist()), 10**12 + k) for side, part in samples),
            )
        )
    expected = of_the_service(replace(skill, threshold=np.inf), ticks, ASSUMED)[settle:]
    for name, array in (
        ("target", motion.target),
        ("setpoint", motion.setpoint),
        ("tool", motion.tool),
    ):
        assert array is not None
        assert array.tobytes() == expected[name].tobytes(), name


@pytest.mark.parametrize("teach", [True, False])
def test_rehearsal_is_what_the_controller_does(
    teach: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`statistics`, `separation`, and `hands` in process."""
    consumed: list[Tick] = []
    run = rehearsal.run

    def kept(ticks: Iterable[Tick]) -> Iterator[Tick]:
        for tick in ticks:
            consumed.append(tick)
            yield tick

    monkeypatch.setattr(
        rehearsal, "run", lambda controller, ticks, taps: run(controller, kept(ticks), taps)
    )
    scene = Scene()
    skill = shipped_skill()
    skill_for = ours(scene) if teach else lambda bench: skill
    done = rehearsal.rehearse(
        HandScript(scene, seed=3, speed=2.0), skill_for, rate_hz=125, keep=True
    )
    taught = adapted(skill, scene.via_points(), tolerance=TOLERANCE_M) if teach else skill
    expected = of_the_service(taught, consumed, msgspec.structs.replace(Settings(), rate_hz=125))
    assert done.frames.tobytes() == expected.tobytes()
    assert (expected["mode"] == Mode.FOLLOW).mean() > 0.5
