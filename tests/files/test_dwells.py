"""Remarks on a take: via-points never reached, rests elsewhere, and unseen hands."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from thirdhand.contract.requests import ViaPoint
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.takes.demonstration_files import Summary, summary, table
from thirdhand.workbench.takes.demonstration_reader import write_demonstration
from thirdhand.workbench.takes.dwells import dwells, remarks_on_via_points
from thirdhand_sim.scene import Scene
from thirdhand_sim.teach import demonstrations

SCENE = Scene()
START = ViaPoint("start", SCENE.left_start, SCENE.right_start, SCENE.robot_start)


@pytest.fixture(scope="module")
def taken() -> Demonstration:
    """A demonstration of the scene, with its via-points named."""
    return demonstrations(SCENE, count=1, seed=1)[0]._replace(
        via_points=(START, *SCENE.via_points())
    )


def listed(taken: Demonstration, path: Path) -> Summary:
    """The take as `thirdhand record` shows it."""
    write_demonstration(path, taken)
    return summary(path)


def test_missed_via_point_is_named_with_its_distance(taken: Demonstration, tmp_path: Path) -> None:
    """The distance is the nearest that the tool came to the via-point."""
    vise = msgspec.structs.replace(
        taken.via_points[0], name="vise", tool=(0.5, 0.0, 0.9), follow="none"
    )
    report = listed(taken._replace(via_points=(*taken.via_points, vise)), tmp_path / "a.mcap")
    least = np.linalg.norm(taken.tool[:, :3] - vise.tool, axis=1).min()
    (remark,) = report.remarks
    assert remark == (
        f"via-point 'vise' was never reached: the tool's smallest distance was {1000 * least:.0f} "
        "mm, 100 mm needed"
    )
    assert remark in table(report)


def test_rest_far_from_all_via_points_is_noted(taken: Demonstration) -> None:
    """A rest far from all via-points may be a via-point that was not named."""
    # on the way to the glass, at the highest speed
    middle = int(np.argmax(np.abs(np.gradient(taken.tool[:, 1]))))
    period_ns = round(1e9 * taken.period_s)
    lasts = round(0.8 / taken.period_s)
    rows = np.concatenate(
        [np.arange(middle), np.full(lasts, middle), np.arange(middle, len(taken.stamps_ns))]
    )
    rested = taken._replace(
        stamps_ns=taken.stamps_ns[0] + period_ns * np.arange(len(rows)),
        **{side: getattr(taken, side)[rows] for side in ("left", "right", "tool")},
    )
    begin_s = middle * taken.period_s
    end_s = (middle + lasts) * taken.period_s
    assert any(abs(a - begin_s) < 0.2 and abs(b - end_s) < 0.2 for a, b in dwells(rested))
    assert remarks_on_via_points(taken) == []
    (remark,) = remarks_on_via_points(rested)
    assert remark.startswith("hands and tool rest from ")
    assert remark.endswith("is a via-point missing here?")


@pytest.mark.parametrize("end", ["begins", "ends"])
def test_a_take_that_begins_or_ends_in_motion_is_warned_of(
    end: str, taken: Demonstration, tmp_path: Path
) -> None:
    index = int(np.argmax(np.linalg.norm(np.gradient(taken.right[:, :3], axis=0), axis=1)))
    rows = slice(index, None) if end == "begins" else slice(None, index)
    cut = Demonstration._make(
        part[rows] if isinstance(part, np.ndarray) else part for part in taken
    )
    (remark,) = [line for line in listed(cut, tmp_path / "a.mcap").remarks if "in motion" in line]
    assert remark.startswith(f"it {end} in motion: ")
    assert "right 0." in remark
