"""Takes in which a track is wrong for a while: the skill is learned from the clean samples, wrong
stretches are named with their times, and a take with too few clean samples is refused.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from support import spoiled
from support.circling import circling
from support.paths import RECORDINGS
from support.spoiled import SPOILS, START_NS, Streams, streams_of, write_streams
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.takes.demonstration_reader import MIN_USABLE_SHARE, read_demonstration

SEEDS = 3
OFF_M = 0.02  # largest error of positions in a bridged stretch, which is shorter than 0.5 s
# [s] clean samples that may be lost with the bad ones
SLOW_TO_SETTLE = {
    spoiled.two_sources: 2.2,
    spoiled.swap: 2.2,
}
LOST_S = 0.5


@pytest.fixture(scope="module")
def clean() -> list[Demonstration]:
    """Takes at 25, 50 and 100 Hz: circling hands, a script, and modelled people.

    Their tools rest exactly, so a tracker's noise is added.
    """
    files = ("demonstration-1.mcap", "people/demonstration-9.mcap", "people/demonstration-6.mcap")
    takes = [circling(1, apart_m=0.03), *(read_demonstration(RECORDINGS / name) for name in files)]
    noise = [np.random.default_rng(7).normal(size=(len(take.tool), 7)) for take in takes]
    scale = np.array([5e-4] * 3 + [0.0] * 4)
    return [
        take._replace(tool=take.tool + scale * take_noise)
        for take, take_noise in zip(takes, noise, strict=True)
    ]


def read_back(path: Path, streams: Streams, said: list[str] | None = None) -> Demonstration:
    lines: list[str] = []
    got = read_demonstration(write_streams(path, streams), say=lines.append)
    if said is not None:
        said += lines
    return got


def named(said: list[str]) -> list[tuple[str, float, float]]:
    """The stretches named in the output: stream, begin and end [s]."""
    stretches = re.findall(
        r"(hands/left|hands/right|tool/pose) (\d+\.\d\d) to (\d+\.\d\d) s: ", " ".join(said)
    )
    return [(name, float(begin), float(end)) for name, begin, end in stretches]


@pytest.mark.parametrize("spoil", SPOILS, ids=lambda spoil: str(spoil.__name__))
@pytest.mark.one_case
def test_wrong_stretch_is_named_and_left_out(
    spoil: spoiled.Spoil, clean: list[Demonstration], tmp_path: Path
) -> None:
    """Samples outside the stretch are unchanged."""
    for number, take in enumerate(clean):
        for seed in range(SEEDS):
            random = np.random.default_rng([number, seed])
            seconds = take.seconds
            lasts_s = random.uniform(0.7, 2.5)
            begin_s = random.uniform(0.0, take.seconds[-1] - lasts_s)
            mask = (seconds >= begin_s) & (seconds < begin_s + lasts_s)
            name = ("left", "right", "tool")[random.integers(2 if spoil is spoiled.swap else 3)]
            streams = streams_of(take)
            remarks = list[str]()
            spoil(streams, name, mask, random)
            got = read_back(tmp_path / "a.mcap", streams, remarks)
            rows = np.searchsorted(take.stamps_ns - take.stamps_ns[0], got.stamps_ns - START_NS)
            for part in ("left", "right", "tool"):
                error_m = np.abs(getattr(got, part)[:, :3] - getattr(take, part)[rows, :3]).max(
                    axis=1
                )
                assert error_m[~mask[rows]].max() == 0.0, "what is not wrong is as it was"
                assert error_m.max() < OFF_M
            lost_s = float((~mask).sum() - (~mask[rows]).sum()) * take.period_s
            assert lost_s < SLOW_TO_SETTLE.get(spoil, LOST_S)
            if not mask[rows].any():
                stretches = [
                    stretch for stretch in named(remarks) if stretch[0] == spoiled.KEYS[name]
                ]
                assert any(
                    b < begin_s + 0.1 and e > begin_s + lasts_s - 0.1 for _, b, e in stretches
                ), remarks


@pytest.mark.parametrize("kept_s", [3.0, 8.0])
def test_a_take_without_enough_of_the_rest_is_refused(
    kept_s: float, clean: list[Demonstration], tmp_path: Path
) -> None:
    take = clean[1]
    streams = streams_of(clean[1])
    is_unseen = (take.seconds > kept_s) & (take.seconds < take.seconds[-1])
    spoiled.gap(streams, "right", is_unseen, np.random.default_rng(0))
    if kept_s / take.seconds[-1] > MIN_USABLE_SHARE:
        assert read_back(tmp_path / "a.mcap", streams).seconds[-1] == pytest.approx(kept_s)
        return
    with pytest.raises(
        RecordingError, match=r"3\.0 of 10\.6 s are usable, 50% needed: hands/right 3\.00 to"
    ):
        read_back(tmp_path / "a.mcap", streams)


def test_short_stretch_is_bridged(clean: list[Demonstration], tmp_path: Path) -> None:
    """A stretch longer than `unseen_ms` is not bridged."""
    take = clean[1]
    for lasts_s, begins in ((0.4, ()), (0.6, (300,))):
        streams = streams_of(take)
        mask = (take.seconds >= 2.995) & (take.seconds < 2.995 + lasts_s)
        spoiled.nans(streams, "left", mask, np.random.default_rng(0))
        got = read_back(tmp_path / "a.mcap", streams)
        assert got.begins == begins
        assert len(got.stamps_ns) == len(take.stamps_ns) - (int(mask.sum()) if begins else 0)


@pytest.mark.parametrize("which", [("left",), ("left", "right"), ("left", "right", "tool")])
@pytest.mark.parametrize("by_s", [-5.0, -3600.0, 3600.0])
def test_where_a_clock_begins_anew_the_times_of_recording_count(
    which: tuple[str, ...], by_s: float, clean: list[Demonstration], tmp_path: Path
) -> None:
    take = clean[1]
    streams = streams_of(clean[1])
    remarks = list[str]()
    for name in which:
        streams[name].stamps_ns[500:] += round(1e9 * by_s)
    got = read_back(tmp_path / "a.mcap", streams, remarks)
    assert (
        f"the clock of {', '.join(spoiled.KEYS[name] for name in which)} restarts or was set"
        in remarks[0]
    )
    np.testing.assert_array_equal(got.hands, take.hands)
    np.testing.assert_array_equal(got.tool, take.tool)
