"""Evidence: origin of results, stale results, allowed seeds, and repetition of all experiments."""

from __future__ import annotations

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
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import ticks
from thirdhand.recordings.shipped import recordings, shipped_skill
from thirdhand.settings.config import Settings
from thirdhand_sim.golden import record
from thirdhand_sim.lab import evidence
from thirdhand_sim.lab.__main__ import main
from thirdhand_sim.lab.catalogue import EXPERIMENTS, Stream, overlap
from thirdhand_sim.lab.evidence import (
    RESULTS,
    core_digest,
    kmp_digest,
    options_of,
    origin,
    staleness,
    tree,
)
from thirdhand_sim.lab.people.comparison import sessions_of, tasks_of
from thirdhand_sim.lab.reproduction.letters import WRITTEN, gathered
from thirdhand_sim.lab.reproduction.writing import write
from thirdhand_sim.lab.results import ExperimentError, Options, Results

THREE = ("letters", "statistics", "table")
NAMED = {"commit", "date", "machine", "seeds", "options", "depends_on"}


class TestSeeds:
    """The table of seeds."""

    def test_seeds_are_disjoint(self) -> None:
        """No evaluation uses people or seeds of tuning or learning."""
        tuned = [stream for entry in EXPERIMENTS.values() for stream in entry.seeds.tuning.values()]
        assert tuned
        for name, experiment in EXPERIMENTS.items():
            others = [*tuned, *experiment.seeds.learned.values()]
            for evaluated, other in itertools.product(experiment.seeds.evaluation.values(), others):
                assert not evaluated.overlaps(other), f"{name}: {evaluated} and {other}"

    def test_streams_overlap(self) -> None:
        """Random streams overlap if they share a seed and a number."""
        stream = Stream("scene", 1, range(10))
        assert stream.overlaps(stream._replace(numbers=range(9, 12)))
        assert not any(
            map(
                stream.overlaps,
                (
                    stream._replace(numbers=range(10, 12)),
                    stream._replace(seed=2),
                    stream._replace(kind="x"),
                ),
            )
        )
        assert (list(stream.share(0.5)), list(stream.share(0.01, least=2))) == (
            [0, 1, 2, 3, 4],
            [0, 1],
        )


class TestDigests:
    """Digests of the code and data on which a result depends."""

    def test_core_digest_changes_with_decisions(self, tmp_path: Path) -> None:
        golden = Recording.open(recordings() / "golden.mcap")
        inputs = list(itertools.islice(ticks(golden), 1510))
        slower = msgspec.structs.replace(
            Settings(), tool=msgspec.structs.replace(Settings().tool, max_speed=0.1)
        )
        paths = [tmp_path / name for name in ("first.mcap", "again.mcap", "slower.mcap")]
        for path, settings in zip(paths, (golden.settings, golden.settings, slower), strict=True):
            record(path, settings, shipped_skill(), inputs)
        first, second, other = map(core_digest, paths)
        assert first == second != other

    def test_kmp_digest_changes_from_a_millionth_on(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Smaller changes leave the digest of kmp."""
        compute: Callable[[], str] = kmp_digest.__wrapped__
        outputs = list(evidence.kmp_outputs())
        was = compute()
        for change, is_equal in ((1e-12, True), (2e-6, False)):
            monkeypatch.setattr(
                evidence, "kmp_outputs", lambda off=change: [*outputs[:-1], outputs[-1] + off]
            )
            assert (compute() == was) == is_equal

    def test_learning_digest_is_that_of_shipped_skill(self, tmp_path: Path) -> None:
        """Numbers are compared to six digits, as CPUs differ in the last ones."""
        path = tmp_path / "soldering.npz"
        takes = sorted((recordings() / "people").glob("*.mcap"))
        done = thirdhand("learn", *map(str, takes), "--output", str(path))
        assert done.returncode == 0, done.stderr
        with np.load(recordings() / "soldering.npz") as shipped, np.load(path) as learned:
            assert set(shipped) == set(learned)
            for name in set(shipped) - {"checksum", "figures"}:
                if shipped[name].dtype.kind == "f":
                    np.testing.assert_allclose(
                        learned[name], shipped[name], rtol=1e-6, atol=1e-6, err_msg=name
                    )
                else:
                    assert learned[name].tobytes() == shipped[name].tobytes(), name


def test_result_names_its_origin(tmp_path: Path) -> None:
    """A folder is named by its files."""
    np.savez(tmp_path / "a.npz", t=np.arange(3))
    options = Options(data=tmp_path, hands=tmp_path, share=0.5)
    result = origin("partners", options)
    assert set(result) == NAMED
    assert set(result["options"]) == {
        "share",
        "seed_offset",
        "data",
    }  # this experiment has no option for hands
    assert set(result["machine"]) == {"cpu", "cores", "python", "numpy", "scipy", "pin", "ruckig"}
    assert result["seeds"] == EXPERIMENTS["partners"].seeds.named()
    names = EXPERIMENTS["partners"].depends_on
    assert result["depends_on"] == {name: tree()[name] for name in names}
    before = result["options"]["data"]
    assert before["files"] == 1
    np.savez(tmp_path / "a.npz", t=np.arange(3) + 1)
    assert options_of("partners", options)["data"] != before


def test_result_is_stale_where_dependency_changed() -> None:
    """Other changes do not make a result stale."""
    digests = {"core": "1", "learning": "2", "kmp": "3"}
    result = {
        "commit": "12ab",
        "depends_on": {"kmp": "3"},
        "options": {"share": 1.0, "letters": {"files": 10}},
    }
    assert staleness("letters", result, digests | {"core": "other"}) == ""
    assert staleness("letters", result, digests | {"kmp": "other"}) == "kmp changed since 12ab"
    assert staleness("letters", result | {"depends_on": {}}, digests) == "kmp changed since 12ab"
    assert "share 1.0" in staleness("letters", result, digests, Options(share=0.1))
    assert "unknown version" in staleness("letters", {"figures": []}, digests)
    assert staleness("letters", None, digests)


class TestSeedOffset:
    """Experiments that are repeated with other seeds."""

    def test_moves_the_evaluation_and_nothing_else(self) -> None:
        for name, experiment in EXPERIMENTS.items():
            moved = experiment.seeds.moved(1000)
            assert moved.moved(-1000) == experiment.seeds
            assert (moved.learned, moved.tuning) == experiment.seeds[2:0:-1]
            for key, stream in experiment.seeds.evaluation.items():
                assert len(moved.evaluation[key].numbers) == len(stream.numbers)
                assert not moved.evaluation[key].overlaps(stream)
            assert overlap(name, 0) == overlap(name, 1000) == ""

    def test_result_says_so_and_is_not_the_shipped_one(self) -> None:
        """A result without the option was made without an offset."""
        options = Options(seed_offset=5)
        result = origin("letters", options)
        assert result["options"]["seed_offset"] == 5
        assert result["seeds"]["evaluation"] == {"letters": "written letter 1: 5 to 9"}
        assert staleness("letters", result, tree(), options) == ""
        assert "seed_offset 5" in staleness("letters", result, tree())
        earlier = origin("letters", Options())
        del earlier["options"]["seed_offset"]
        assert staleness("letters", earlier, tree()) == ""
        assert "seed_offset 0" in staleness("letters", earlier, tree(), options)

    @pytest.mark.parametrize(
        ("arguments", "reason"),
        [
            (["letters", "--seed-offset", "-1"], "0 or more"),
            (["letters", "--seed-offset", "1", "--output", str(RESULTS)], "another folder"),
            (["sensitivity", "--seed-offset", "1"], "no random evaluation"),
            (["people", "--seed-offset", "1", "--set", "tuning"], "--set tuning"),
            (["motion", "--seed-offset", "100"], "moving hands 0: 300 to 305"),
        ],
    )
    def test_refuses_what_it_cannot_move(
        self, arguments: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit):
            main(["--output", str(tmp_path), *arguments])
        assert reason in " ".join(capsys.readouterr().err.split())

    def test_letters_are_the_next_ones_of_the_stream(self, tmp_path: Path) -> None:
        results = Results(tmp_path, "letters", said=False)
        [sets] = gathered(results, Options(share=0.1, seed_offset=5)).values()
        many = write("B", count=10, seed=WRITTEN.seed)
        [letter] = [letter for letter in sets if letter.name == "B"]
        np.testing.assert_array_equal(letter.demonstrations, many[5:])

    def test_people_and_scenes_are_others(self) -> None:
        moved = {task.first for task in tasks_of(Options(seed_offset=24), 2)}
        assert moved == {24}
        first, second = (
            [trial.session.told for trial in sessions_of("test", "", 1, 1, None, number)]
            for number in (0, 24)
        )
        assert not np.array_equal(first[0].board, second[0].board)


class TestAll:
    """`all` with three small experiments, of which one fails."""

    @staticmethod
    def run_all(folder: Path, *more: str) -> int:
        """The exit code of a run of the three experiments."""
        return main(["all", "--output", str(folder), "--quiet", *more])

    @pytest.fixture(autouse=True)
    def runs(self, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
        """The number of runs of each experiment, and the error of the failing one."""
        counts: dict[str, Any] = {
            "letters": 0,
            "statistics": 0,
            "table": 0,
            "error": ExperimentError("no letters"),
        }

        def module(name: str) -> ModuleType:
            def run(results: Any, options: Options) -> dict[str, Any]:
                counts[name] += 1
                if name == "statistics" and counts["error"]:
                    raise counts["error"]
                return {"found": 1}

            stub = ModuleType(name)
            stub.run = run  # type: ignore[attr-defined]
            return stub

        few = {name: EXPERIMENTS[name] for name in THREE}
        for name in few:
            monkeypatch.setitem(
                sys.modules, f"thirdhand_sim.lab.{EXPERIMENTS[name].module}", module(name)
            )
        monkeypatch.setattr(
            "thirdhand_sim.lab.__main__.EXPERIMENTS",
            {**few, "motion-of-others": EXPERIMENTS["motion-of-others"]},
        )
        return counts

    @pytest.mark.parametrize("error", [ExperimentError("no letters"), ValueError("of two kinds")])
    def test_goes_on_after_a_failure(
        self,
        runs: dict[str, Any],
        error: Exception,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        """The next run makes only missing results."""
        runs["error"] = error
        assert self.run_all(tmp_path) == 1
        assert f"statistics: {error}" in capsys.readouterr().err.replace("Traceback", "").replace(
            "ValueError: ", "statistics: "
        )
        runs["error"] = None
        assert self.run_all(tmp_path) == 0
        assert [runs[name] for name in THREE] == [1, 2, 1]
        assert self.run_all(tmp_path, "--anew") == 0
        assert [runs[name] for name in THREE] == [2, 3, 2]
        assert set(json.loads((tmp_path / "table.json").read_text())) > NAMED

    def test_makes_what_is_stale_and_lists_it(
        self, runs: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        runs["error"] = None
        assert self.run_all(tmp_path) == 0
        path = tmp_path / "letters.json"
        path.write_text(path.read_text().replace(kmp_digest(), "of another version"))
        capsys.readouterr()
        assert main(["stale", "--output", str(tmp_path)]) == 0
        listed = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in listed] == ["letters", "motion-of-others", "2"]
        assert "kmp changed since" in listed[0]
        assert self.run_all(tmp_path) == 0
        assert [runs[name] for name in THREE] == [2, 1, 1]

    def test_file_that_is_no_result_is_named(
        self, runs: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """The other results are made."""
        runs["error"] = None
        (tmp_path / "letters.json").write_text("{")
        for command in ("stale", "all"):
            assert main([command, "--output", str(tmp_path), "--quiet"]) == 1
            assert (
                f"{tmp_path / 'letters.json'}: not the JSON of a result" in capsys.readouterr().err
            )
        assert [runs[name] for name in THREE] == [0, 1, 1]
