"""Each experiment at a reduced size makes its figures, numbers and recording, and the numbers bear
out what it claims.
"""

from __future__ import annotations

import importlib
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("matplotlib", reason="the experiments draw with Matplotlib: pip install 'thirdhand[experiments]'")
pytest.importorskip(
    "movement_primitives", reason="ProMPs need movement_primitives: pip install 'thirdhand[experiments]'"
)

from support.paths import ROOT
from thirdhand_sim.lab.__main__ import main
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.load.live import is_evidence
from thirdhand_sim.lab.reproduction.table import METHODS
from thirdhand_sim.lab.reproduction.writing import recorded, write
from thirdhand_sim.lab.results import Array, ExperimentError
from thirdhand_sim.lab.scenes import draw
from thirdhand_sim.lab.separation import ThrustScript
from thirdhand_sim.lab.statistics import SCENES, wilson
from thirdhand_sim.scene import MOST_MOVED, Scene
from thirdhand_sim.script import Clock, Teacher

pytestmark = pytest.mark.timeout(300)
SHIPPED = ROOT / "recordings" / "experiments"


@pytest.fixture(scope="module")
def letters(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of letters as others record them."""
    folder = tmp_path_factory.mktemp("letters")
    for name in "DG":
        np.savez(
            folder / f"{name}.npz", **{f"demo{k:02d}": one[::2] for k, one in enumerate(write(name, count=6, seed=9))}
        )
    return folder


@pytest.fixture
def close_figures() -> Iterator[None]:
    from matplotlib import pyplot as plt

    yield
    plt.close("all")


def numbers(name: str, folder: Path, *more: str) -> dict[str, Any]:
    """The JSON of an experiment at a tenth of its size, once its files are there."""
    assert main([name, "--output", str(folder), "--share", "0.1", "--workers", "1", "--quiet", *more]) == 0
    found: dict[str, Any] = json.loads((folder / f"{name}.json").read_text())
    assert found["figures"]
    for figure in found["figures"]:
        assert (folder / figure).read_bytes()[:4] == b"\x89PNG"
    return found


@pytest.mark.usefixtures("close_figures")
@pytest.mark.thorough
class TestExperiments:
    """One test each."""

    def test_the_tool_follows_moving_hands_closer_and_more_smoothly_than_its_rivals(self, tmp_path: Path) -> None:
        found = numbers("motion", tmp_path)["by_follower"]
        ours = found["ours"]
        for rival in (name for name in found if not name.startswith("ours")):
            for group in ("clean", "recorded"):
                assert ours[group]["jerk_ratio"] < 0.7 * found[rival][group]["jerk_ratio"], rival
                if rival != "no smoothing":  # it is as near, and shakes
                    assert ours[group]["error_rms_mm"] < found[rival][group]["error_rms_mm"], rival
                # a rival that does not follow is none
                assert found[rival]["minimum jerk"]["error_rms_mm"] < 35, rival
                assert found[rival][group]["error_rms_mm"] < 35, rival
        for group in ("clean, skill of such hands", "recorded, skill of such hands"):
            others = [found[rival][group] for rival in found if group in found[rival] and rival != "ours"]
            assert others
            assert all(ours[group]["error_rms_mm"] < other["error_rms_mm"] for other in others)
        stops = ours["sudden stops"]
        assert stops["overshoot_mean_mm"] < 6
        assert stops["overshoot_worst_mm"] < 12
        assert stops["settled_worst_ms"] < 250
        assert all(group["top_speed"] <= 0.8 + 1e-6 for group in ours.values())
        assert (tmp_path / "motion.rrd").stat().st_size > 50_000

    def test_letters_go_through_their_desired_points_and_stay_as_they_were_elsewhere(
        self, tmp_path: Path, letters: Path
    ) -> None:
        found = numbers("letters", tmp_path, "--letters", str(letters))
        for summary in (found["model_summary"], found["recorded_summary"]):
            assert summary["largest_miss_at_desired_points_cm"] < 0.01
            assert summary["rms_deviation_elsewhere_cm"] < 1.0
        assert found["figures"] == ["letters.png"]  # both sets in one
        assert (tmp_path / "letters.rrd").stat().st_size > 1000

    def test_promp_meets_them_too_and_its_basis_functions_explode_on_a_grid_only(
        self, tmp_path: Path, letters: Path
    ) -> None:
        found = numbers("promp", tmp_path, "--letters", str(letters))
        assert found["figures"] == ["promp.png", "promp-dimensions.png"]
        for summary in (found["model_summary"], found["recorded_summary"]):
            assert summary["promp"]["largest_miss_cm"] < 0.01
            assert summary["promp_without_ridge"]["largest_miss_cm"] > 0.1
            for who in ("kmp", "promp"):
                both = summary[who]["mean_rms_deviation_elsewhere_cm"], summary[who]["largest_deviation_elsewhere_cm"]
                assert both[0] < both[1]
        at_six = {one["method"]: one for one in found["dimensions"] if one["inputs"] == 6}
        assert at_six["KMP"]["functions"] == 200
        assert at_six["ProMP, 10 per input"]["functions"] == 10**6
        assert at_six["ProMP, 10 per input"]["error"] is None
        # what the mixture costs, and that bases need no grid
        for method in ("kernel ridge, 200 samples", "ProMP, at 200 samples"):
            assert at_six[method]["functions"] == 200
            assert at_six[method]["error"] < at_six["KMP"]["error"]

    def test_the_arm_keeps_the_rule_of_speed_and_separation(self, tmp_path: Path) -> None:
        found = numbers("separation", tmp_path, "--share", "0.02")
        assert found["random"]["successes"] == found["scenes"] == 2
        assert found["thrust"]["successes"] == 2
        assert found["random"]["overlaps"] == 0
        assert found["random"]["excess_after_reaction"] < found["slip_m_per_s"]
        for kind in ("random", "thrust"):
            assert found[kind]["excess_lasts_s"] <= 0.13  # the reaction time
            assert found[kind]["pushed_mm"] < 2
            assert min(found[kind]["self_mm"], found[kind]["table_mm"]) > 5

    def test_learned_correlations_lower_the_cost_beside_controls_at_equal_distance(self, tmp_path: Path) -> None:
        found = numbers("correlation", tmp_path)
        assert found["cost_fall_percent"]["mean"] > 0
        assert found["largest_miss_of_a_via_point_cm"] < 0.01
        for trial in found["trials"]:
            for control in ("constant", "random"):
                assert trial[control]["distance_cm"] == pytest.approx(trial["learned"]["distance_cm"], rel=0.02)
            # begun at the one number and kept there, learning returns nothing worse
            assert trial["begun_at_c"]["cost_rad"] <= trial["constant"]["cost_rad"]

    def test_what_each_method_can_be_given(self, tmp_path: Path) -> None:
        found = numbers("table", tmp_path)["modelled"]
        largest = {
            who: {one: found[who][f"largest_miss_of_{one}_cm"] for one in ("start", "via", "end")} for who in METHODS
        }
        for who in ("kmp", "promp"):
            assert max(largest[who].values()) < 0.02
        assert largest["dmp"]["start"] < 0.02
        assert largest["dmp"]["end"] < 0.1
        assert min(largest["dmp"]["via"], *largest["gmm"].values()) > 1

    def test_hands_are_drawn_as_in_the_paper(self, tmp_path: Path) -> None:
        found = numbers("hands", tmp_path)
        assert found["figures"] == ["hands-stages.png", "hands.png"]
        assert is_evidence(found["evidence_is_periods_skipped_at_most"])
        assert not is_evidence(found["evidence_is_periods_skipped_at_most"] + 1)
        worth = {name: one["error_median_mm"] for name, one in found["beside_the_paper"].items()}
        assert min(worth, key=lambda name: worth[name]) == "ours"
        assert worth["one point a place"] > 3 * worth["ours"]

    def test_statistics_compare_eight_methods_in_the_same_scenes(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("thirdhand_sim.lab.statistics.SCENES", SCENES._replace(numbers=range(10)))
        monkeypatch.setattr("thirdhand_sim.lab.statistics.OURS_HZ", 250)
        found = numbers("statistics", tmp_path)
        reaching = ["ours", "none", "look_up", "gaussian_process_5"]
        assert list(found["methods"]) == [*reaching, "gaussian_process", "paper", "promp", "gmr"]
        assert found["scenes"] == 1
        # taught places are reached without any demonstration too
        assert [found["methods"][method]["successes"] for method in reaching] == [1, 1, 1, 1]
        assert found["methods"]["gmr"]["successes"] == 0


NAMED = {  # in these tests and their neighbours, with what they claim
    name
    for path in Path(__file__).parent.glob("test_*.py")
    for name in re.findall(
        r'(?:numbers|Results)\((?:tmp_path, )?"([a-z-]+)"|main\(\["([a-z-]+)"', path.read_text("utf-8")
    )
    for name in name
}


def test_an_experiment_without_a_test_of_its_own_makes_its_files_too(tmp_path: Path) -> None:
    assert len(NAMED & set(EXPERIMENTS)) > 14
    for name in (
        set(EXPERIMENTS) - NAMED - {"motion-of-others", "sensitivity", "camera"}
    ):  # recordings; hours; MediaPipe
        assert numbers(name, tmp_path)["experiment"] == name


DRAWN = [
    name
    for name in EXPERIMENTS
    if hasattr(importlib.import_module(f"thirdhand_sim.lab.{EXPERIMENTS[name].module}"), "draw_numbers")
]


def grey(path: Path) -> Array:
    """A picture's brightness (N, M), each the mean of 8 by 8 pixels: fonts differ a little."""
    one = np.asarray(Image.open(path).convert("L"), float)
    height, width = (8 * (side // 8) for side in one.shape)
    return one[:height, :width].reshape(height // 8, 8, width // 8, 8).mean(axis=(1, 3))


@pytest.mark.parametrize("name", DRAWN)
@pytest.mark.usefixtures("close_figures")
@pytest.mark.one_case
def test_the_shipped_figures_are_of_the_shipped_numbers(name: str, tmp_path: Path) -> None:
    shutil.copy(SHIPPED / f"{name}.json", tmp_path)
    assert main([name, "--output", str(tmp_path), "--redraw", "--quiet"]) == 0
    figures = list(tmp_path.glob("*.png"))
    assert figures
    for figure in figures:
        np.testing.assert_allclose(grey(figure), grey(SHIPPED / figure.name), atol=10, err_msg=figure.name)


def test_a_figure_of_other_numbers_is_another_one(tmp_path: Path) -> None:
    numbers = json.loads((SHIPPED / "people.json").read_text())
    numbers["methods"]["ours"]["success"]["mean"] -= 0.02
    (tmp_path / "people.json").write_text(json.dumps(numbers))
    assert main(["people", "--output", str(tmp_path), "--redraw", "--quiet"]) == 0
    assert np.abs(grey(tmp_path / "people.png") - grey(SHIPPED / "people.png")).max() > 10


def test_what_shows_more_than_its_numbers_is_not_drawn_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["correlation", "--output", str(tmp_path), "--redraw", "--quiet"]) == 1
    assert "run it without --redraw" in capsys.readouterr().err


@pytest.mark.parametrize("number", range(100))
def test_random_scenes_are_within_reach_and_end(number: int) -> None:
    drawn, nominal = draw(number, seed=SCENES.seed), Scene()
    for name in ("handover", "glass", "soldering"):
        place = getattr(drawn.scene, name)
        assert np.linalg.norm(np.subtract(place, getattr(nominal, name))) <= MOST_MOVED
        assert place[2] >= 0.05
    script = drawn.script()
    progress = [script.clock.at(t)[0] for t in np.arange(0, script.duration_s, 0.05)]
    assert min(progress) > -0.05  # before the start the hands rest
    assert script.clock.at(script.duration_s)[0] == pytest.approx(drawn.scene.duration_s, abs=1e-6)
    assert max(progress) <= drawn.scene.duration_s + 1e-6


def test_a_hand_is_thrust_where_the_tool_is_going_in_a_scene_that_is_too_slow_too() -> None:
    """In this scene the tool is nowhere 22 cm farther after 1.5 s."""
    drawn = draw(29, seed=7003)
    script = ThrustScript(drawn)
    teacher = Teacher(drawn.scene, seed=drawn.seed, clock=Clock(speed=drawn.speed, pauses=drawn.pauses))
    path = np.array([teacher.truth(t).position for t in script.at_s + np.arange(0.0, 1.5, 0.01)])
    there = script.truth(script.at_s + script.lasts_s)[script.side].position
    assert np.linalg.norm(path - there, axis=1).min() < 0.003
    assert 0.15 < np.linalg.norm(there - path[0]) < 0.22
    assert all(p.at_s + p.lasts_s <= script.at_s or p.at_s >= script.at_s + script.lasts_s for p in drawn.pauses)


def test_the_interval_of_a_rate_is_wilsons() -> None:
    assert wilson(98, 100) == pytest.approx((0.9300, 0.9945), abs=1e-4)  # as in Newcombe 1998, method 3
    assert wilson(100, 100)[1] == pytest.approx(1.0)


def test_written_letters_are_the_same_for_the_same_seed_and_vary_between_repetitions() -> None:
    one = write("G", seed=4)
    assert one.tobytes() == write("G", seed=4).tobytes()
    assert 0.2 < one.std(axis=0).mean() < 2.0


def test_a_folder_without_letters_says_what_is_needed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ExperimentError, match="demo00"):
        recorded(tmp_path)
    assert main(["letters", "--output", str(tmp_path), "--letters", str(tmp_path), "--share", "0.1", "--quiet"]) == 1
    assert "No letters in" in capsys.readouterr().err


def test_without_matplotlib_the_command_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["letters", "--output", str(tmp_path)]) == 1
    assert "thirdhand[experiments]" in capsys.readouterr().err
