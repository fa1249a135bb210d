"""Skills on takes that are left out: what is judged, the rivals, recordings, and a reduced run."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from thirdhand.command_line import main as command
from thirdhand.contract.records import SIDES
from thirdhand.core.skill.model import LEVELS
from thirdhand.core.skill.skill import is_reachable
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import decoded
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.takes.demonstration_reader import write_demonstration
from thirdhand_sim.lab.partners import (
    Fold,
    Found,
    as_command,
    numbers_of,
    served,
    summary,
)
from thirdhand_sim.lab.people.into_reach import RigidMap, depth_m
from thirdhand_sim.lab.people.left_out import (
    JUDGED_HZ,
    LeftOut,
    judged,
    left_out,
    predicted,
    read,
)
from thirdhand_sim.lab.results import ExperimentError, Options, Results
from thirdhand_sim.lab.rivals.method import Predicted
from thirdhand_sim.lab.rivals.partners import (
    MEMORY_S,
    MOVES_MPS,
    RIVALS,
    carried,
    clock,
    in_mean_scene,
    left_out_by,
    past,
    scene_of,
)
from thirdhand_sim.made_tasks import takes

pytestmark = pytest.mark.thorough


def of_kind(kind: str, people: range) -> list[LeftOut]:
    return [left_out(f"{t.person}", "", t.demonstration) for t in takes(kind, people=people, each=1)]


@pytest.fixture(scope="module")
def shown() -> list[LeftOut]:
    return of_kind("three", range(4))


@pytest.fixture(scope="module")
def asked() -> list[LeftOut]:
    return of_kind("three", range(6, 8))


def rms_mm(said: list[Predicted], asked: list[LeftOut]) -> float:
    rows = [judged(*pair) for pair in zip(asked, said, strict=True)]
    return 1000 * float(np.sqrt(sum(r.squares for r in rows) / sum(r.samples for r in rows)))


def test_intake_estimates_the_hands_of_a_take(asked: list[LeftOut]) -> None:
    one = asked[0]
    stamps = (one.demonstration.stamps_ns - one.demonstration.stamps_ns[0]) * 1e-9
    seen = np.stack([np.interp(one.times, stamps, column) for column in one.demonstration.hands.T], axis=1)
    assert one.hands.shape == seen.shape == one.velocities.shape
    assert np.abs(one.hands - seen).max() < 0.03
    assert np.diff(one.times) == pytest.approx(1.0 / JUDGED_HZ)
    assert np.abs(np.gradient(seen, one.times, axis=0) - one.velocities).mean() < 0.05


def test_the_core_predicts_as_the_skill_does_where_hands_rest_and_each_take_anew(shown: list[LeftOut]) -> None:
    skill = learn([one.demonstration for one in shown])
    first, again = (predicted(skill, shown[0]) for _ in range(2))
    assert first.mean.tobytes() == again.mean.tobytes()
    asked = shown[0].hands[10:11]
    assert np.linalg.norm(first.mean[10] - skill.mean(asked)[0]) < 0.01
    assert first.covariance is not None
    assert np.linalg.eigvalsh(first.covariance).min() > 0


def test_what_lies_outside_of_the_arms_reach_is_not_clamped(shown: list[LeftOut]) -> None:
    beside = np.array([1.0, 0, 0, 0, 0, 0, 0])
    moved = [
        left_out(
            one.name, "", d._replace(left=d.left + beside, right=d.right + beside, tool=d.tool + beside, places=())
        )
        for one in shown[:2]
        for d in [one.demonstration]
    ]
    skill = learn([one.demonstration for one in moved])
    assert rms_mm([predicted(skill, one) for one in moved], moved) < 100


def test_a_shift_in_time_is_found_and_taken_out(asked: list[LeftOut]) -> None:
    one = asked[0]
    late = np.concatenate([np.repeat(one.tool[:1], 10, axis=0), one.tool[:-10]])
    found = judged(one, Predicted(late))
    assert found.shift_s == pytest.approx(-10 / JUDGED_HZ)
    assert found.shifted < 1e-12 < found.squares
    assert found.inside is None
    assert found.held is None
    assert judged(one, Predicted(one.tool)).shift_s == 0.0


def test_coverage_is_what_a_covariance_says(asked: list[LeftOut]) -> None:
    one, random = asked[0], np.random.default_rng(0)
    long = one._replace(tool=np.zeros((20_000, 3)))
    said = Predicted(0.02 * random.standard_normal((20_000, 3)), np.tile(4e-4 * np.eye(3), (20_000, 1, 1)))
    found = judged(long, said)
    assert found.inside is not None
    assert np.array(found.inside) / found.samples == pytest.approx(LEVELS, abs=0.01)


def test_told_are_moments_far_off_at_which_it_held_or_was_unsure(asked: list[LeftOut]) -> None:
    one, off = asked[0], np.array([[0.11, 0, 0], [0.11, 0, 0], [0.2, 0, 0], [0.09, 0, 0], [0, 0, 0], [0, 0, 0]])
    held, unsure = (np.array(flags, bool) for flags in ([1, 0, 0, 0, 1, 0], [1, 1, 0, 1, 0, 0]))
    found = judged(one._replace(tool=off), Predicted(np.zeros((6, 3)), held=held, uncertain=unsure))
    assert (found.wrong, found.told, found.held, found.unsure) == (3, 2, 2, 3)
    numbers = summary([found])
    assert (numbers["wrong"], numbers["told"], numbers["unsure"]) == pytest.approx((1 / 2, 2 / 3, 1 / 2))
    assert summary([judged(one, Predicted(one.tool))])["told"] is None


def test_what_is_carried_to_a_place_and_back_is_where_it_was(asked: list[LeftOut]) -> None:
    here, there = scene_of(asked[0])[2], scene_of(asked[1])[2]
    assert np.abs(carried(here, here, there) - there).max() < 0.005
    assert np.abs(carried(here + 0.01, here, here) - here - 0.01).max() < 1e-12
    same = in_mean_scene(asked[0], scene_of(asked[0]))
    assert same.hands == pytest.approx(asked[0].hands)
    assert same.velocities == pytest.approx(asked[0].velocities, abs=1e-9)
    now = round(MEMORY_S[0] * JUDGED_HZ) + 50
    before = past(same)[now, :6] + same.hands[now]
    assert before == pytest.approx(same.hands[now - round(MEMORY_S[0] * JUDGED_HZ)])


def test_rivals_that_see_more_err_less(shown: list[LeftOut], asked: list[LeftOut]) -> None:
    told = {name: rms_mm(left_out_by(rival, shown, asked, told=True), asked) for name, rival in RIVALS.items()}
    untold = {name: rms_mm(left_out_by(RIVALS[name], shown, asked, told=False), asked) for name in ("linear", "mean")}
    assert told["linear"] < untold["linear"] < untold["mean"]
    assert max(told[name] for name in told if name not in ("mean", "same elapsed time")) < untold["linear"]
    twice = of_kind("cyclic", range(4)), of_kind("cyclic", range(6, 8))
    by = {name: rms_mm(left_out_by(RIVALS[name], *twice, told=True), twice[1]) for name in RIVALS}
    assert by["HMM over demonstrations"] < 0.7 * by["Gaussian process"]


def test_a_rival_that_is_shown_the_take_itself_knows_it(asked: list[LeftOut]) -> None:
    for name in ("nearest neighbours", "Gaussian process", "HMM over demonstrations", "same elapsed time"):
        assert rms_mm(left_out_by(RIVALS[name], [asked[0]] * 2, asked[:1], told=False), asked[:1]) < 30, name


def test_takes_are_moved_into_the_arms_reach_by_one_rigid_map(shown: list[LeftOut]) -> None:
    reach, far = Settings().reach, beside(shown, 1.5)
    found = RigidMap.of(far, reach)
    moved = [found.moved(one) for one in far]
    assert np.quantile(np.concatenate([depth_m(one.tool, reach) for one in moved]), 0.05) > 0.0
    one, before = moved[0], far[0]
    for after, at in ((one.tool, before.tool), (one.hands[:, :3], before.hands[:, :3])):
        assert np.linalg.norm(after - after[0], axis=1) == pytest.approx(np.linalg.norm(at - at[0], axis=1))
    assert (one.tool - one.hands[:, 3:])[:, 2] == pytest.approx((before.tool - before.hands[:, 3:])[:, 2])
    assert np.linalg.norm(one.velocities) == pytest.approx(np.linalg.norm(before.velocities))
    assert one.demonstration.places[0].tool == pytest.approx(
        found.positions(np.array(before.demonstration.places[0].tool))
    )
    assert found.positions(before.demonstration.tool[:, :3]) == pytest.approx(one.demonstration.tool[:, :3])
    for point, expected in (((0.6, 0, 0.346), 0.25), ((0.1, 0, 0.346), -0.25), ((0.6, 0.0, 0.0), -0.02)):
        assert float(depth_m(np.array(point), reach)) == pytest.approx(expected)


def test_the_clock_runs_from_when_a_hand_first_moves(asked: list[LeftOut]) -> None:
    one = asked[0]
    speeds = np.linalg.norm(one.velocities.reshape(-1, 2, 3), axis=2).max(axis=1)
    begins = int(np.argmax(speeds > MOVES_MPS))
    found = clock(one)[:, 0]
    assert not found[: begins + 1].any()
    assert np.diff(found[begins:]) == pytest.approx(1.0 / JUDGED_HZ)
    assert not clock(one._replace(velocities=0 * one.velocities)).any()


def test_recordings_are_read(tmp_path: Path) -> None:
    times = np.arange(0, 4, 0.04)
    way = np.outer(np.sin(times), (0.3, 0.1, 0.0))
    unseen = np.full_like(way, np.nan)
    np.savez(tmp_path / "give_P1_1.npz", t=times, left=unseen, right=way, tool=way + 0.1)
    one = read(tmp_path / "give_P1_1.npz", named=True)
    assert one.conducts == "right"
    assert np.array_equal(one.left, one.right)
    assert [place.name for place in one.places] == ["start", "end"]
    assert one.places[1].tool == pytest.approx(way[-1] + 0.1)
    seen = left_out("give_P1_1", "P1", one)
    assert np.abs(seen.hands[:, :3] - np.stack([np.interp(seen.times, times, c) for c in way.T], axis=1)).max() < 0.03
    assert SIDES.index("right") == 1
    np.savez(tmp_path / "broken.npz", t=times, left=np.where(times[:, None] > 1, way, np.nan), right=way, tool=way)
    with pytest.raises(ExperimentError, match="not finite"):
        read(tmp_path / "broken.npz")
    np.savez(tmp_path / "other.npz", t=times)
    with pytest.raises(ExperimentError, match="not a recording"):
        read(tmp_path / "other.npz")


@pytest.mark.timeout(120)
def test_a_reduced_run_has_all_methods_and_says_what_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    from thirdhand_sim.lab.partners import run

    monkeypatch.setattr("thirdhand_sim.lab.partners.TASK_KINDS", ("three", "cyclic"))
    results = Results(tmp_path, "partners", said=False)
    found = json.loads(results.numbers(run(results, Options(share=0.5))).read_text())
    assert (tmp_path / "partners.png").read_bytes()[:4] == b"\x89PNG"
    assert found["recorded"] == {}
    methods = found["made"]["three"]["methods"]
    assert set(methods) == {f"{name}, told" for name in (*RIVALS, "service")}
    ours = methods["service, told"]
    assert ours["takes"] == 6
    assert ours["shifted_rms_mm"] < ours["rms_mm"] < methods["mean, told"]["rms_mm"]
    assert len(ours["coverage"]) == len(LEVELS)
    assert 0.0 <= ours["held"] <= 0.2
    cyclic = found["made"]["cyclic"]["methods"]["service, told"]
    # what it cannot learn or be told is refused with a reason, take by take or as a whole
    assert cyclic["takes"] + cyclic["refuses"] == 6
    assert bool(cyclic["reasons"]) == bool(cyclic["refuses"])


def beside(takes_: list[LeftOut], metres: float) -> list[LeftOut]:
    """The takes, with hands, tool and via-points moved along x."""
    moved, out = np.array([metres, 0, 0, 0, 0, 0, 0]), []
    for one in takes_:
        d = one.demonstration
        places = tuple(
            msgspec.structs.replace(
                p, **{part: tuple(np.add(getattr(p, part), moved[:3]).tolist()) for part in ("left", "right", "tool")}
            )
            for p in d.places
        )
        d = d._replace(left=d.left + moved, right=d.right + moved, tool=d.tool + moved, places=places)
        out.append(left_out(one.name, one.group, d))
    return out


@pytest.mark.parametrize("metres", [0.0, 1.0])
def test_a_skill_is_judged_and_refused_as_the_command_does(
    metres: float, shown: list[LeftOut], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = beside(shown, metres)
    files = [tmp_path / f"{one.name}.mcap" for one in moved]
    for path, one in zip(files, moved, strict=True):
        write_demonstration(path, one.demonstration)
    skill, refusals = as_command(moved, told=True)
    written = tmp_path / "skill.npz"
    assert command(["learn", *map(str, files), "--output", str(written)]) == bool(refusals) == (metres > 0)
    said = capsys.readouterr().err
    assert written.exists() == (not refusals)
    assert all(text in said for text in refusals)
    assert skill is not None
    if not refusals:
        same = decoded(written.read_bytes(), origin="skill.npz")
        np.testing.assert_allclose(same.mean(skill.hands), skill.mean(skill.hands), atol=1e-6)
    else:
        assert "arm's reach" in refusals[0]


def test_a_refused_fold_enters_no_mean_and_its_error_is_given_apart(shown: list[LeftOut], asked: list[LeftOut]) -> None:
    def found(takes_: list[LeftOut], tested: list[LeftOut]) -> Found:
        said = left_out_by(RIVALS["mean"], takes_, tested, told=True)
        rows = [judged(*pair) for pair in zip(tested, said, strict=True)]
        return Found(dict.fromkeys((f"{name}, told" for name in RIVALS), rows), {"service, told": fold(takes_, tested)})

    def fold(takes_: list[LeftOut], tested: list[LeftOut]) -> Fold:
        return served(takes_, tested, told=True)

    good, refused = found(shown, asked), found(beside(shown, 1.0), beside(asked, 1.0))
    alone, both = (numbers_of(rows)["methods"]["service, told"] for rows in ([good], [good, refused]))
    for one, folds, refuses in ((alone, 0, 0), (both, 1, len(asked))):
        assert (one["folds_refused"], one["refuses"], one["takes"]) == (folds, refuses, len(asked))
    assert both["rms_mm"] == alone["rms_mm"] < alone["beside_mm"]["mean"] == both["beside_mm"]["mean"]
    assert alone["in_spite_of_refusal"] == {"takes": 0}
    assert both["in_spite_of_refusal"]["takes"] == len(asked)
    assert both["in_spite_of_refusal"]["rms_mm"] == pytest.approx(alone["rms_mm"], rel=0.2)  # the same takes elsewhere
    nothing = numbers_of([refused])["methods"]["service, told"]
    assert nothing["takes"] == 0
    assert "rms_mm" not in nothing
    assert nothing["beside_mm"]["mean"] is None
    assert "arm's reach" in nothing["reasons"][0]


def test_a_prediction_is_held_within_the_arms_reach_where_one_is_given(shown: list[LeftOut]) -> None:
    far, reach = beside(shown, 1.0), Settings().reach
    skill, _ = as_command(far, told=True)
    assert skill is not None
    wider = replace(reach, outer=reach.outer + 1e-4)
    assert all(is_reachable(at, wider) for at in predicted(skill, far[0], reach=reach).mean)
    assert not any(is_reachable(at, wider) for at in predicted(skill, far[0]).mean)
