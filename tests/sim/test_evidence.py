"""Evidence: where a result is from, when it is stale, which seeds it may use, and how all results
are made anew.
"""

from __future__ import annotations

import ast
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="the experiments draw with Matplotlib")

from support.cell import thirdhand
from support.paths import ROOT
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import ticks
from thirdhand.recordings.shipped import recordings, shipped_skill
from thirdhand.settings.config import Settings
from thirdhand_sim.golden import record
from thirdhand_sim.lab import evidence
from thirdhand_sim.lab.__main__ import jobs, main
from thirdhand_sim.lab.catalogue import EXPERIMENTS, Stream
from thirdhand_sim.lab.evidence import (
    core_digest,
    kmp_digest,
    options_of,
    origin,
    staleness,
    tree,
)
from thirdhand_sim.lab.results import ExperimentError, Options

MODULES = sorted((ROOT / "sim" / "thirdhand_sim" / "lab").rglob("*.py"))
NAMED = {"commit", "date", "machine", "seeds", "options", "depends_on"}


class TestSeeds:
    """The table of seeds."""

    def test_nothing_is_evaluated_on_what_it_was_tuned_on_or_learned_from(self) -> None:
        tuned = [stream for one in EXPERIMENTS.values() for stream in one.seeds.tuning.values()]
        assert tuned
        for name, experiment in EXPERIMENTS.items():
            others = [*tuned, *experiment.seeds.learned.values()]
            for one, other in itertools.product(experiment.seeds.evaluation.values(), others):
                assert not one.overlaps(other), f"{name}: {one} and {other}"

    def test_streams_overlap_where_they_share_a_seed_and_a_number(self) -> None:
        one = Stream("scene", 1, range(10))
        assert one.overlaps(one._replace(numbers=range(9, 12)))
        assert not any(
            map(one.overlaps, (one._replace(numbers=range(10, 12)), one._replace(seed=2), one._replace(kind="x")))
        )
        assert (list(one.share(0.5)), list(one.share(0.01, least=2))) == ([0, 1, 2, 3, 4], [0, 1])

    @pytest.mark.parametrize(
        "path", [path for path in MODULES if path.stem not in ("catalogue", "evidence")], ids=lambda path: path.stem
    )
    def test_an_experiment_has_no_seed_of_its_own(self, path: Path) -> None:
        """A generator's first number, an argument and a constant `seed` come from elsewhere."""
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            given: list[ast.expr] = []
            if isinstance(node, ast.Call):
                given += [one.value for one in node.keywords if one.arg in ("seed", "random_state")]
                if isinstance(node.func, ast.Attribute) and node.func.attr == "default_rng":
                    given += node.args
            elif isinstance(node, ast.FunctionDef):
                named = [*node.args.args, *node.args.kwonlyargs]
                values = [*[None] * (len(node.args.args) - len(node.args.defaults)), *node.args.defaults]
                pairs = zip(named, [*values, *node.args.kw_defaults], strict=True)
                given += [value for one, value in pairs if one.arg == "seed" and value is not None]
            elif isinstance(node, ast.Assign):
                names, value = node.targets[0], node.value
                if isinstance(names, ast.Tuple) and isinstance(value, ast.Tuple):
                    given += [v for n, v in zip(names.elts, value.elts, strict=True) if "SEED" in ast.unparse(n)]
                elif "SEED" in ast.unparse(names):
                    given.append(value)
            for value in given:
                first = value.elts[0] if isinstance(value, ast.List) else value
                assert not isinstance(first, ast.Constant), f"{path.name}:{value.lineno}: {ast.unparse(value)}"


class TestDigests:
    """What a result depends on."""

    def test_that_of_the_core_changes_with_what_it_decides_and_not_with_its_state(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        golden = Recording.open(recordings() / "golden.mcap")
        inputs = list(itertools.islice(ticks(golden), 1510))
        slower = msgspec.structs.replace(Settings(), tool=msgspec.structs.replace(Settings().tool, max_speed=0.1))
        paths = [tmp_path / name for name in ("first.mcap", "again.mcap", "slower.mcap")]
        for path, settings in zip(paths, (golden.settings, golden.settings, slower), strict=True):
            record(path, settings, shipped_skill(), inputs)
        first, again, other = map(core_digest, paths)
        assert first == again != other

        def digest_with(tick: int) -> str:
            """Of the first recording, with another checksum at a tick."""
            opened = Recording.open(paths[0])
            opened.checksums[tick] ^= 1
            monkeypatch.setattr(Recording, "open", lambda path: opened)
            try:
                return core_digest(paths[0])
            finally:
                monkeypatch.undo()

        assert digest_with(499) != first
        assert digest_with(500) == first  # covers the state; the frame is there as a whole

    def test_that_of_kmp_changes_from_a_millionth_on(self, monkeypatch: pytest.MonkeyPatch) -> None:
        compute: Callable[[], str] = kmp_digest.__wrapped__
        outputs, was = list(evidence.kmp_outputs()), compute()
        for off, same in ((1e-12, True), (2e-6, False)):
            monkeypatch.setattr(evidence, "kmp_outputs", lambda off=off: [*outputs[:-1], outputs[-1] + off])
            assert (compute() == was) == same

    def test_that_of_learning_is_the_checksum_of_what_is_learned_from_the_shipped_demonstrations(
        self, tmp_path: Path
    ) -> None:
        """To six digits: CPUs differ in the last ones."""
        again, takes = tmp_path / "soldering.npz", sorted((recordings() / "people").glob("*.mcap"))
        done = thirdhand("learn", *map(str, takes), "--output", str(again))
        assert done.returncode == 0, done.stderr
        with np.load(recordings() / "soldering.npz") as shipped, np.load(again) as learned:
            assert set(shipped) == set(learned)
            for name in set(shipped) - {"checksum", "figures"}:
                if shipped[name].dtype.kind == "f":
                    np.testing.assert_allclose(learned[name], shipped[name], rtol=1e-6, atol=1e-6, err_msg=name)
                else:
                    assert learned[name].tobytes() == shipped[name].tobytes(), name


def test_a_result_names_its_origin_and_a_folder_by_its_files(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.arange(3))
    given = Options(data=tmp_path, hands=tmp_path, share=0.5)
    found = origin("partners", given)
    assert set(found) == NAMED
    assert set(found["options"]) == {"share", "data"}  # it heeds no hands
    assert set(found["machine"]) == {"cpu", "cores", "python", "numpy", "scipy", "pin", "ruckig"}
    assert found["seeds"] == EXPERIMENTS["partners"].seeds.named()
    assert found["depends_on"] == tree()
    before = found["options"]["data"]
    assert before["files"] == 1
    np.savez(tmp_path / "a.npz", t=np.arange(3) + 1)
    assert options_of("partners", given)["data"] != before


def test_a_result_is_stale_where_what_it_depends_on_changed_and_only_there() -> None:
    here = {"core": "1", "learning": "2", "kmp": "3"}
    result = {"commit": "12ab", "depends_on": {"kmp": "3"}, "options": {"share": 1.0, "letters": {"files": 10}}}
    assert staleness("letters", result, here | {"core": "other"}) == ""
    assert staleness("letters", result, here | {"kmp": "other"}) == "kmp changed since 12ab"
    assert staleness("letters", result | {"depends_on": {}}, here) == "kmp changed since 12ab"
    assert "share 1.0" in staleness("letters", result, here, Options(share=0.1))
    assert "unknown version" in staleness("letters", {"figures": []}, here)
    assert staleness("letters", None, here)


def test_recorded_hands_are_a_result_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hands = Options(hands=tmp_path)
    assert list(jobs("motion", hands)) == list(jobs("motion-of-others", hands)) == ["motion-of-others"]
    assert list(jobs("motion", Options())) == ["motion"]
    assert set(jobs("all", Options())) == set(EXPERIMENTS) - {"motion-of-others"}
    made = jobs("all", hands)
    assert set(made) == set(EXPERIMENTS)
    assert [name for name, one in made.items() if one.hands] == ["motion-of-others"]
    with pytest.raises(SystemExit):
        main(["motion-of-others", "--output", str(tmp_path)])
    assert "--hands DIR" in capsys.readouterr().err


class TestAll:
    """`all` with three small experiments, of which one fails."""

    @pytest.fixture(autouse=True)
    def runs(self, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
        """How often each was run, and the error of the one that fails."""
        seen: dict[str, Any] = {"letters": 0, "promp": 0, "table": 0, "error": ExperimentError("no letters")}

        def module(name: str) -> ModuleType:
            def run(results: Any, options: Options) -> dict[str, Any]:
                seen[name] += 1
                if name == "promp" and seen["error"]:
                    raise seen["error"]
                return {"found": 1}

            one = ModuleType(name)
            one.run = run  # type: ignore[attr-defined]
            return one

        few = {name: EXPERIMENTS[name] for name in ("letters", "promp", "table")}
        for name in few:
            monkeypatch.setitem(sys.modules, f"thirdhand_sim.lab.{EXPERIMENTS[name].module}", module(name))
        monkeypatch.setattr(
            "thirdhand_sim.lab.__main__.EXPERIMENTS", {**few, "motion-of-others": EXPERIMENTS["motion-of-others"]}
        )
        return seen

    @pytest.mark.parametrize("error", [ExperimentError("no letters"), ValueError("of two kinds")])
    def test_goes_on_after_a_failure_and_makes_only_what_is_missing_the_next_time(
        self, runs: dict[str, Any], error: Exception, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        runs["error"] = error
        assert main(["all", "--output", str(tmp_path), "--quiet"]) == 1
        assert f"promp: {error}" in capsys.readouterr().err.replace("Traceback", "").replace("ValueError: ", "promp: ")
        runs["error"] = None
        assert main(["all", "--output", str(tmp_path), "--quiet"]) == 0
        assert [runs[name] for name in ("letters", "promp", "table")] == [1, 2, 1]
        assert main(["all", "--output", str(tmp_path), "--anew", "--quiet"]) == 0
        assert [runs[name] for name in ("letters", "promp", "table")] == [2, 3, 2]
        assert set(json.loads((tmp_path / "table.json").read_text())) > NAMED

    def test_makes_what_is_stale_and_lists_it(
        self, runs: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        runs["error"] = None
        assert main(["all", "--output", str(tmp_path), "--quiet"]) == 0
        path = tmp_path / "letters.json"
        path.write_text(path.read_text().replace(kmp_digest(), "of another version"))
        capsys.readouterr()
        assert main(["stale", "--output", str(tmp_path)]) == 0
        listed = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in listed] == ["letters", "motion-of-others", "2"]
        assert "kmp changed since" in listed[0]
        assert main(["all", "--output", str(tmp_path), "--quiet"]) == 0
        assert [runs[name] for name in ("letters", "promp", "table")] == [2, 1, 1]

    def test_keeps_a_result_of_recordings_that_are_not_given_again(
        self, runs: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        recorded, results = tmp_path / "recorded", tmp_path / "results"
        recorded.mkdir()
        assert main(["table", "--output", str(results), "--letters", str(recorded), "--quiet"]) == 0
        before = (results / "table.json").read_text()
        assert main(["table", "--output", str(results), "--quiet"]) == 1
        assert "name them by --letters DIR again" in capsys.readouterr().err
        assert (results / "table.json").read_text() == before
        assert runs["table"] == 1

    def test_a_file_that_is_no_result_is_named_and_the_others_are_made(
        self, runs: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        runs["error"] = None
        (tmp_path / "letters.json").write_text("{")
        for command in ("stale", "all"):
            assert main([command, "--output", str(tmp_path), "--quiet"]) == 1
            assert f"{tmp_path / 'letters.json'}: not the JSON of a result" in capsys.readouterr().err
        assert [runs[name] for name in ("letters", "promp", "table")] == [0, 1, 1]
