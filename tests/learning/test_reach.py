"""Tool positions out of reach: compared with `[reach]` and with the joints' limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.followed import changed
from support.turning import sliding_cell
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.skill.skill import is_reachable
from thirdhand.recordings.shipped import ARMS, cell_of, shipped_skill
from thirdhand.settings.config import Reach, Settings, robot_description
from thirdhand.skills.reach import beyond_m, out_of_reach
from thirdhand.skills.skill_file import StoredSkill

WIDE = Reach(centre=(0.0, 0.0, 0.3), inner=0.01, outer=3.0, min_x=-1.0, min_z=-1.0)


def cell_with(arm: str, reach: Reach, folder: Path) -> Settings:
    cell = sliding_cell(folder) if arm == "sliding" else cell_of(arm)
    return changed(cell, reach=reach)


@pytest.mark.parametrize("arm", [*ARMS, "sliding"])
def test_reachable_places_are_within_reach(arm: str, tmp_path: Path) -> None:
    """Postures at the joints' limits are included."""
    cell = cell_with(arm, WIDE, tmp_path)
    lower = np.array(cell.joints.lower)
    upper = np.array(cell.joints.upper)
    random = np.random.default_rng(7)
    forward = ArmStage(cell, robot_description(cell))
    shares = random.uniform(size=(1500, len(lower)))
    shares[::2] = np.clip(2.0 * shares[::2] - 0.5, 0.0, 1.0)  # half of the joints are at a limit
    places = np.array([forward.at(q).position for q in lower + shares * (upper - lower)])
    inside = np.array([is_reachable(place, WIDE) for place in places])
    assert inside.mean() > 0.9
    assert not beyond_m(cell, places[inside]).any()


@pytest.mark.parametrize("arm", ARMS)
def test_unreachable_place_has_its_distance(arm: str, tmp_path: Path) -> None:
    cell = cell_with(arm, WIDE, tmp_path)
    # longer than any shipped arm
    shoulder = np.array(cell_of(arm).reach.centre)
    length = 1.0
    random = np.random.default_rng(3)
    for _ in range(20):
        outward = random.normal(size=3)
        outward /= np.linalg.norm(outward)
        away_m = random.uniform(0.3, 0.8)
        (distance_m,) = beyond_m(cell, (shoulder + (length + away_m) * outward)[None])
        # an arm reaches less far in some directions
        assert away_m - 0.1 < distance_m < away_m + 0.5


def test_distance_from_reach_is_exact() -> None:
    """The distance from a configured reach is exact."""
    reach = Settings().reach
    centre = np.array(reach.centre)
    cases = {
        0.05: centre + np.array([reach.outer + 0.05, 0.0, 0.0]),
        0.1: centre + np.array([reach.inner - 0.1, 0.0, 0.0]),
        0.03: np.array([0.6, 0.0, reach.min_z - 0.03]),
        0.0: np.array([0.6, 0.1, 0.3]),
    }
    assert beyond_m(Settings(), np.array(list(cases.values()))) == pytest.approx(
        list(cases), abs=1e-9
    )


@pytest.mark.parametrize(
    ("distances", "is_named", "is_refused"),
    [
        ((0.0, 0.0, 0.0, 0.0), True, False),
        ((0.4, 0.4, 0.4, 0.0), True, True),
        ((0.1, 0.1, 0.1, 0.1), True, False),  # each via-point can be taught again within reach
        ((0.1, 0.1, 0.1, 0.0), False, True),
        ((0.1, 0.1, 0.0, 0.0), False, False),
    ],
)
def test_skill_out_of_reach_is_refused(
    skill: StoredSkill, distances: tuple[float, ...], is_named: bool, is_refused: bool
) -> None:
    """Named via-points may be taught again, so they are refused less strictly."""
    judged = shipped_skill() if is_named else skill
    assert bool(judged.model.names) is is_named
    finding = out_of_reach(judged, np.array(distances), Settings())
    assert finding.is_refused is is_refused
    number = sum(distance > 0.0 for distance in distances)
    assert bool(finding.text) is bool(number)
    if number:
        assert (
            f"{number} of 4 positions of the tool in skill {judged.name!r} are out of the arm's "
            "reach" in finding.text
        )
        assert f"the farthest by {max(distances):.3f} m" in finding.text
        assert ("Learn a skill" in finding.text) is is_refused
