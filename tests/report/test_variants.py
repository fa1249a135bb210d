"""Settings tried on a recording's hands: the figures and the proposal."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from support.paths import RECORDINGS
from thirdhand.contract.records import Mode
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.recordings.recording import Recording
from thirdhand.settings.config import Settings, parse
from thirdhand.workbench.report.tracking import TrackingFigures
from thirdhand.workbench.report.variants import (
    CHANGES,
    Change,
    JudgedHands,
    VariantFigures,
    best,
    changed,
    toml,
    tried,
    written_change,
)
from thirdhand.workbench.takes.recorded_hands import RecordedHands, recorded_hands

GOLDEN = RECORDINGS / "golden.mcap"
CALM: Change = {"tool": {"max_jerk": 100.0}}


@pytest.fixture(scope="module")
def hands() -> RecordedHands:
    return recorded_hands(GOLDEN, part=(9.7, 14.2))


@pytest.fixture(scope="module")
def judged_hands(hands: RecordedHands) -> JudgedHands:
    return JudgedHands.of(hands)


def test_a_recording_without_its_arm_is_followed_as_it_was(golden: Path) -> None:
    whole = recorded_hands(golden, part=(0.0, 5.0))
    frames = whole.frames(whole.settings)
    recorded = np.array([s.frame for s in Recording.open(golden).steps() if s.frame is not None])[: len(frames)]
    follows = recorded["mode"] == Mode.FOLLOW
    assert follows.mean() > 0.9
    assert np.linalg.norm(frames["target"] - recorded["target"], axis=1)[follows].max() < 1e-6
    off = np.linalg.norm(frames["tool"] - recorded["tool"], axis=1)[follows]
    assert np.median(off) < 1e-4
    assert (frames["rejected"] == recorded["rejected"]).all()


def test_settings_are_judged_by_the_true_hands(judged_hands: JudgedHands) -> None:
    own, calm = tried(judged_hands, (CALM, {"tool": {"max_jerk": 400.0}}))  # the second is no change
    assert (own.name, calm.name) == ("as recorded", "max_jerk = 100")
    assert 2.0 < own.tracking.error_mm < 30.0
    assert own.tracking.lag_ms > 0.0
    assert calm.tracking.jerk < 0.7 * own.tracking.jerk
    assert calm.tracking.error_mm > own.tracking.error_mm
    assert own.rejected == calm.rejected
    assert own.rejected["not_finite"] == 13
    ideal = judged_hands._replace(target=judged_hands.frames["tool"])
    assert ideal.figures("perfect", {}, judged_hands.frames).tracking.error_mm == 0.0


def test_every_change_is_valid_in_the_shipped_cell_and_can_be_written_to_a_file() -> None:
    for change in CHANGES:
        settings = changed(Settings(), change)
        assert (settings is None) is (change == {"tool": {"follow": "default"}})
        if settings is None:
            continue
        assert parse(toml(change), origin="tune") == settings
    words: Change = {"tool": {"orientation": "full"}}
    assert parse(toml(words), origin="tune").tool.orientation == "full"
    assert written_change(words) == "orientation = full"
    assert changed(Settings(), {"tool": {"max_speed": 9.0}}) is None
    assert changed(Settings(), {"tool": {"max_speed": Settings().tool.max_speed}}) is None


def figures(
    error_mm: float, jerk: float, overshoot_mm: float = 2.0, held_s: float = 0.0, change: Change = CALM
) -> VariantFigures:
    seen = TrackingFigures(error_mm, 2 * error_mm, 40.0, jerk, overshoot_mm, 3)
    return VariantFigures("x", change, seen, {"hold: stale_hand": held_s}, {}, {})


@pytest.mark.parametrize(("variant", "chosen"), [
    (figures(5.0, 30.0), True),  # errs less
    (figures(5.9, 30.0), False),  # hardly less
    (figures(5.0, 40.0), False),  # with more jerk
    (figures(5.0, 30.0, overshoot_mm=4.0), False),
    (figures(5.0, 30.0, held_s=0.5), False),
    (figures(6.1, 20.0), True),  # calmer for the same error
    (figures(7.0, 20.0), False),
    (figures(5.0, 30.0, change={"tool": {"max_jerk": 500.0}}), False),  # raises a limit of motion
    (figures(5.0, 30.0, overshoot_mm=math.nan), True),
])  # fmt: skip
def test_the_best_trade_off_costs_nothing_else(variant: VariantFigures, chosen: bool) -> None:
    found, reason = best([figures(6.0, 30.0, change={}), variant], Settings())
    assert (found is variant) is chosen
    assert ("instead of" in reason) is chosen


def test_a_part_keeps_what_lasts_and_must_hold_ticks() -> None:
    whole = recorded_hands(GOLDEN)
    taught = {event.kind for tick in whole.ticks for event in tick.inbox if event.kind == "skill"}
    late = recorded_hands(GOLDEN, part=(15.0, 16.0))
    assert taught == {event.kind for event in late.ticks[0].inbox} & {"skill"}
    assert len(late.ticks) in (499, 500, 501)
    with pytest.raises(RecordingError, match=r"lasts 20\.0 s: a part from 30 to 40 s is empty"):
        recorded_hands(GOLDEN, part=(30.0, 40.0))


def test_hands_that_the_arm_does_not_follow_are_refused_with_the_reasons() -> None:
    with pytest.raises(RecordingError, match=r"follows for 0\.\d s .*hold: operator 0\.\d s"):
        JudgedHands.of(recorded_hands(GOLDEN, part=(8.9, 9.7)))
