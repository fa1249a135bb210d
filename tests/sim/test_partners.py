"""Skills on left-out takes: predictions, rivals, judgements, and a reduced run."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from thirdhand.command_line import main as command
from thirdhand.core.skill.model import LEVELS
from thirdhand.skills.skill_file import decoded
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.takes.demonstration_reader import write_demonstration
from thirdhand_sim.lab.partners import Found, SkillFold, as_command, numbers_of, served
from thirdhand_sim.lab.people.left_out import LeftOut, judged, left_out, predicted
from thirdhand_sim.lab.results import Options, Results
from thirdhand_sim.lab.rivals.method import Predicted
from thirdhand_sim.lab.rivals.partners import RIVALS, left_out_by
from thirdhand_sim.made_tasks import takes

pytestmark = pytest.mark.thorough


def of_kind(kind: str, people: range) -> list[LeftOut]:
    return [
        left_out(f"{t.person}", "", t.demonstration) for t in takes(kind, people=people, each=1)
    ]


@pytest.fixture(scope="module")
def shown() -> list[LeftOut]:
    return of_kind("three", range(4))


@pytest.fixture(scope="module")
def asked() -> list[LeftOut]:
    return of_kind("three", range(6, 8))


def rms_mm(said: list[Predicted], asked: list[LeftOut]) -> float:
    rows = [judged(*pair) for pair in zip(asked, said, strict=True)]
    return 1000 * float(np.sqrt(sum(r.squares for r in rows) / sum(r.samples for r in rows)))


def test_core_predicts_as_the_skill(shown: list[LeftOut]) -> None:
    """The hands rest, and the core starts anew with each take."""
    skill = learn([take.demonstration for take in shown])
    first, second = (predicted(skill, shown[0]) for _ in range(2))
    assert first.mean.tobytes() == second.mean.tobytes()
    asked = shown[0].hands[10:11]
    assert np.linalg.norm(first.mean[10] - skill.mean(asked)[0]) < 0.01
    assert first.covariance is not None
    assert np.linalg.eigvalsh(first.covariance).min() > 0


def test_coverage_is_what_a_covariance_says(asked: list[LeftOut]) -> None:
    take = asked[0]
    random = np.random.default_rng(0)
    long = take._replace(tool=np.zeros((20_000, 3)))
    prediction = Predicted(
        0.02 * random.standard_normal((20_000, 3)), np.tile(4e-4 * np.eye(3), (20_000, 1, 1))
    )
    score = judged(long, prediction)
    assert score.inside is not None
    assert np.array(score.inside) / score.samples == pytest.approx(LEVELS, abs=0.01)


def test_rivals_that_see_more_err_less(shown: list[LeftOut], asked: list[LeftOut]) -> None:
    informed = {
        name: rms_mm(left_out_by(rival, shown, asked, told=True), asked)
        for name, rival in RIVALS.items()
    }
    untold = {
        name: rms_mm(left_out_by(RIVALS[name], shown, asked, told=False), asked)
        for name in ("linear", "mean")
    }
    assert informed["linear"] < untold["linear"] < untold["mean"]
    assert (
        max(informed[name] for name in informed if name not in ("mean", "same elapsed time"))
        < untold["linear"]
    )
    twice = of_kind("cyclic", range(4)), of_kind("cyclic", range(6, 8))
    by = {name: rms_mm(left_out_by(RIVALS[name], *twice, told=True), twice[1]) for name in RIVALS}
    assert by["HMM over demonstrations"] < 0.7 * by["Gaussian process"]


@pytest.mark.timeout(120)
def test_reduced_run_has_all_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run reports refusals."""
    pytest.importorskip("matplotlib")
    from thirdhand_sim.lab.partners import run

    monkeypatch.setattr("thirdhand_sim.lab.partners.TASK_KINDS", ("three", "cyclic"))
    results = Results(tmp_path, "partners", said=False)
    result = json.loads(results.numbers(run(results, Options(share=0.5))).read_text())
    assert (tmp_path / "partners.png").read_bytes()[:4] == b"\x89PNG"
    assert result["recorded"] == {}
    methods = result["made"]["three"]["methods"]
    assert set(methods) == {f"{name}, told" for name in (*RIVALS, "service")}
    ours = methods["service, told"]
    assert ours["takes"] == 6
    assert ours["shifted_rms_mm"] < ours["rms_mm"] < methods["mean, told"]["rms_mm"]
    assert len(ours["coverage"]) == len(LEVELS)
    assert 0.0 <= ours["held"] <= 0.2
    cyclic = result["made"]["cyclic"]["methods"]["service, told"]
    # takes or skills that a method cannot use are refused with a reason, one by one or as a whole
    assert cyclic["takes"] + cyclic["refuses"] == 6
    assert bool(cyclic["reasons"]) == bool(cyclic["refuses"])


def beside(takes_: list[LeftOut], metres: float) -> list[LeftOut]:
    """The takes, with hands, tool and via-points moved along x."""
    moved = np.array([metres, 0, 0, 0, 0, 0, 0])
    out = []
    for take in takes_:
        d = take.demonstration
        via_points = tuple(
            msgspec.structs.replace(
                p,
                **{
                    part: tuple(np.add(getattr(p, part), moved[:3]).tolist())
                    for part in ("left", "right", "tool")
                },
            )
            for p in d.via_points
        )
        d = d._replace(
            left=d.left + moved, right=d.right + moved, tool=d.tool + moved, via_points=via_points
        )
        out.append(left_out(take.name, take.group, d))
    return out


@pytest.mark.parametrize("metres", [0.0, 1.0])
def test_judged_and_refused_as_the_command_does(
    metres: float, shown: list[LeftOut], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The judgement equals that of the command `learn`."""
    moved = beside(shown, metres)
    files = [tmp_path / f"{take.name}.mcap" for take in moved]
    for path, take in zip(files, moved, strict=True):
        write_demonstration(path, take.demonstration)
    skill, refusals = as_command(moved, told=True)
    written = tmp_path / "skill.npz"
    assert (
        command(["learn", *map(str, files), "--output", str(written)])
        == bool(refusals)
        == (metres > 0)
    )
    stderr = capsys.readouterr().err
    assert written.exists() == (not refusals)
    assert all(text in stderr for text in refusals)
    assert skill is not None
    if not refusals:
        restored = decoded(written.read_bytes(), origin="skill.npz")
        np.testing.assert_allclose(restored.mean(skill.hands), skill.mean(skill.hands), atol=1e-6)
    else:
        assert "arm's reach" in refusals[0]


def test_refused_fold_enters_no_mean(shown: list[LeftOut], asked: list[LeftOut]) -> None:
    """The error of a refused fold is listed separately."""

    def found(takes_: list[LeftOut], tested: list[LeftOut]) -> Found:
        predictions = left_out_by(RIVALS["mean"], takes_, tested, told=True)
        rows = [judged(*pair) for pair in zip(tested, predictions, strict=True)]
        return Found(
            dict.fromkeys((f"{name}, told" for name in RIVALS), rows),
            {"service, told": fold(takes_, tested)},
        )

    def fold(takes_: list[LeftOut], tested: list[LeftOut]) -> SkillFold:
        return served(takes_, tested, told=True)

    good = found(shown, asked)
    refused = found(beside(shown, 1.0), beside(asked, 1.0))
    alone, pooled = (
        numbers_of(rows)["methods"]["service, told"] for rows in ([good], [good, refused])
    )
    for summary, folds, refuses in ((alone, 0, 0), (pooled, 1, len(asked))):
        assert (summary["folds_refused"], summary["refuses"], summary["takes"]) == (
            folds,
            refuses,
            len(asked),
        )
    assert (
        pooled["rms_mm"]
        == alone["rms_mm"]
        < alone["beside_mm"]["mean"]
        == pooled["beside_mm"]["mean"]
    )
    assert alone["in_spite_of_refusal"] == {"takes": 0}
    assert pooled["in_spite_of_refusal"]["takes"] == len(asked)
    # these are the same takes, moved
    assert pooled["in_spite_of_refusal"]["rms_mm"] == pytest.approx(alone["rms_mm"], rel=0.2)
    nothing = numbers_of([refused])["methods"]["service, told"]
    assert nothing["takes"] == 0
    assert "rms_mm" not in nothing
    assert nothing["beside_mm"]["mean"] is None
    assert "arm's reach" in nothing["reasons"][0]
