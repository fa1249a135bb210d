"""The true motion, noise and tremor of hands whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from thirdhand.contract.messages import BASE
from thirdhand.core.frame import Tick
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import Settings
from thirdhand.workbench.report.true_hands import TrueHand, true_hands, with_true_hands
from thirdhand_sim.closed_loop import START_NS, hand_event

PERIOD_S = 0.002
SETTINGS = Settings()
SECONDS = 14.0
SEEN_S = (0.5, SECONDS - 0.5)


def truth(times: np.ndarray) -> np.ndarray:
    """Reaches between two places, with rests."""
    share = np.clip(np.mod(times, 4.0) - 1.0, 0.0, 1.0) - np.clip(np.mod(times, 4.0) - 3.0, 0.0, 1.0)
    reach = share**3 * (10.0 - 15.0 * share + 6.0 * share * share)
    return np.array([0.7, -0.2, 0.2]) + reach[:, None] * np.array([0.15, 0.1, 0.1])


def seen(
    *, rate_hz: float = 100, noise: float = 0.0005, tremor: tuple[float, float] = (0.0, 0.0), outliers: int = 0
) -> tuple[list[Tick], TrueHand]:
    """Ticks with the samples of one hand, which arrive 10 to 14 ms late, and its truth found in
    them.
    """
    random = np.random.default_rng(5)
    times = np.arange(0.0, SECONDS, 1.0 / rate_hz)
    samples = truth(times) + noise * random.standard_normal((len(times), 3))
    samples[:, 1] += tremor[1] * np.sin(2.0 * math.pi * tremor[0] * times)
    for at in random.choice(np.arange(100, len(times) - 100), outliers, replace=False):
        samples[at : at + 3] += 0.1 * random.standard_normal(3)
    inboxes: dict[int, list] = {}
    for time, sample in zip(times, samples, strict=True):
        event = hand_event("left", tuple(sample.tolist()), START_NS + round(1e9 * time))
        inboxes.setdefault(math.ceil((time + random.uniform(0.01, 0.014)) / PERIOD_S), []).append(event)
    ticks = [Tick(i, tuple(inboxes.get(i, ()))) for i in range(round(SECONDS / PERIOD_S))]
    return ticks, true_hands(ticks, SETTINGS, origin="drawn")["left"]


@pytest.mark.parametrize(("rate_hz", "noise", "tremor"), [
    (100, 0.0005, (0.0, 0.0)),
    (100, 0.0005, (9.0, 0.001)),
    (120, 0.0003, (5.0, 0.002)),
    (60, 0.001, (4.5, 0.003)),
    (30, 0.002, (0.0, 0.0)),
])  # fmt: skip
def test_noise_and_tremor_are_told_apart_and_left_out_of_the_truth(
    rate_hz: float, noise: float, tremor: tuple[float, float]
) -> None:
    _, hand = seen(rate_hz=rate_hz, noise=noise, tremor=tremor)
    assert hand.rate_hz == pytest.approx(rate_hz, rel=0.01)
    assert hand.noise_mm == pytest.approx(1000 * noise, rel=0.35)
    found = hand.tremor()
    if tremor[1]:
        assert found is not None
        assert found.rate_hz == pytest.approx(tremor[0], abs=0.3)
        assert found.amplitude_mm == pytest.approx(1000 * tremor[1], rel=0.15)
    else:
        assert found is None
    times = np.arange(*SEEN_S, PERIOD_S)
    off = hand.at(times) - truth(times - 0.01)  # the ticks' clock is that of the quickest arrival
    largest_m = 0.7 * tremor[1] + 0.8 * noise + 0.0008
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < largest_m


def test_jumps_of_the_tracker_do_not_move_the_truth() -> None:
    times = np.arange(*SEEN_S, PERIOD_S)
    clean, spoilt = (seen(outliers=count)[1] for count in (0, 12))
    assert spoilt.untrusted >= 18
    off = np.linalg.norm(spoilt.at(times) - clean.at(times), axis=1)
    assert np.isfinite(off).mean() > 0.85
    assert np.nanmax(off) < 0.004


def test_nothing_is_known_in_a_long_gap_and_the_core_then_gets_no_sample() -> None:
    ticks, _ = seen()
    for i in range(2500, 2800):
        ticks[i] = Tick(i)
    hand = true_hands(ticks, SETTINGS, origin="drawn")["left"]
    known = np.isfinite(hand.at(np.arange(len(ticks)) * PERIOD_S)[:, 0])
    assert not known[2505:2795].any()
    assert known[300:2490].all()
    fed = list(with_true_hands(ticks, {"left": hand}, PERIOD_S))
    assert [bool(tick.inbox) for tick in fed] == known.tolist()
    (event,) = fed[1000].inbox
    assert (event.kind, event.value.frame_id) == ("hands/left", BASE)
    assert event.value.position == pytest.approx(truth(np.array([1000 * PERIOD_S - 0.01]))[0], abs=0.003)


def test_a_recording_without_hands_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"drawn has no 20 samples of one hand"):
        true_hands([Tick(i) for i in range(100)], SETTINGS, origin="drawn")
