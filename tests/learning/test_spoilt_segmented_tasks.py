"""A task between via-points, taught by takes that are spoilt in every kind: what `thirdhand learn`
makes of them, beside what it makes of the same takes as they were.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from support import spoiled
from support.cell import told
from support.paths import RECORDINGS
from support.skills import figures_of
from thirdhand.core.skill.segmented import SegmentedKMP
from thirdhand.skills.skill_file import decoded
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.takes.demonstration_reader import read_demonstration
from thirdhand_sim.lab.people.left_out import judged, left_out, predicted

pytestmark = pytest.mark.thorough

TAUGHT, HELD_OUT = range(1, 7), range(7, 11)  # of the shipped people, two takes each
SIDES = ("left", "right", "tool")


class Learned(NamedTuple):
    """What is compared of a segmented skill."""

    segments: int
    gate_mm: float
    held_out_mm: float  # root mean square of its own figures
    others_mm: float  # of people who taught nothing, with their takes as they were


def learned(folder: Path, spoil: spoiled.Spoil | None) -> Learned:
    """The skill that `thirdhand learn` makes of the takes, one stretch of each spoilt."""
    files = []
    for number in TAUGHT:
        take, random = (
            read_demonstration(RECORDINGS / f"people/demonstration-{number}.mcap"),
            np.random.default_rng(number),
        )
        tool = take.tool + np.pad(3e-4 * random.normal(size=(len(take.tool), 3)), ((0, 0), (0, 4)))
        take = take._replace(tool=tool)
        begin_s, lasts_s = random.uniform(1.0, take.seconds[-1] - 4.0), random.uniform(0.7, 2.5)
        streams = spoiled.streams_of(take)
        if spoil is not None:
            mask = (take.seconds >= begin_s) & (take.seconds < begin_s + lasts_s)
            spoil(streams, SIDES[random.integers(2 if spoil is spoiled.swap else 3)], mask, random)
        files.append(spoiled.write_streams(folder / f"take-{number}.mcap", streams, places=take.places))
    out = folder / "skill.npz"
    done = told("learn", *map(str, files), "--output", str(out))
    assert done.returncode == 0, done.stderr
    skill = decoded(out.read_bytes(), origin="a file")
    assert isinstance(skill.model, SegmentedKMP)
    figures, squares, samples = figures_of(skill), 0.0, 0
    for number in HELD_OUT:
        other = read_demonstration(RECORDINGS / f"people/demonstration-{number}.mcap")
        seen = left_out("", "", other)
        one = judged(seen, predicted(adapted(skill, other.places, tolerance=0.05), seen))
        squares, samples = squares + one.squares, samples + one.samples
    segments = len(skill.model.task.corners)
    return Learned(segments, figures.gate_mm, figures.all.error_mm, 1000 * float(np.sqrt(squares / samples)))


@pytest.fixture(scope="module")
def unspoilt(tmp_path_factory: pytest.TempPathFactory) -> Learned:
    return learned(tmp_path_factory.mktemp("unspoilt"), None)


@pytest.mark.parametrize("spoil", [*spoiled.SPOILS, *spoiled.SUBTLE], ids=lambda spoil: str(spoil.__name__))
def test_a_segmented_skill_of_spoilt_takes_is_that_of_the_takes_as_they_were(
    spoil: spoiled.Spoil, unspoilt: Learned, tmp_path: Path
) -> None:
    """Its segments, its gate and its error on other people are the same. The error of the skill's
    own figures is of fewer seconds of six takes, between 12 and 81 mm each: it differs more.
    """
    got = learned(tmp_path, spoil)
    assert got.segments == unspoilt.segments
    assert got.gate_mm == pytest.approx(unspoilt.gate_mm, rel=0.05)
    assert got.others_mm == pytest.approx(unspoilt.others_mm, rel=0.1)
    assert got.held_out_mm < 1.6 * unspoilt.held_out_mm
