"""`thirdhand learn`: table, file and picture; exit 1 and no file if the skill is unsafe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.cell import thirdhand
from support.cell_commands import assert_refused, succeeded
from support.fine_motion import fine
from support.paths import RECORDINGS
from thirdhand.skills.skill_file import decoded
from thirdhand.skills.stored_demonstrations import stored_demonstrations
from thirdhand.workbench.takes.demonstration_reader import write_demonstration
from thirdhand_sim.scene import Scene
from thirdhand_sim.teach import demonstrations


def written(folder: Path, name: str, *, count: int, seed: int) -> list[Path]:
    """The files of a teacher's demonstrations."""
    paths = [folder / f"{name}-{number}.mcap" for number in range(1, count + 1)]
    takes = demonstrations(Scene(), count=count, seed=seed)
    for path, demonstration in zip(paths, takes, strict=True):
        write_demonstration(path, demonstration.every(8))
    return paths


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("demonstrations")
    return written(folder, "demonstration", count=3, seed=1)


def test_a_skill_is_judged_drawn_and_written(files: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "skill.npz"
    plot = tmp_path / "skill.png"
    done = thirdhand("learn", *map(str, files), "--output", str(out), "--plot", str(plot))
    assert done.returncode == 0, done.stderr
    assert "demonstration-2 " in done.stdout
    assert "gate " in done.stdout
    assert plot.stat().st_size > 10_000
    skill = decoded(out.read_bytes(), origin="skill")
    assert (
        f"the target's standard deviation is above {1000 * skill.threshold:.0f} mm" in done.stdout
    )


def test_an_unsafe_skill_is_not_written(files: list[Path], tmp_path: Path) -> None:
    demonstration = demonstrations(Scene(), count=1, seed=1)[0].every(8)
    mirrored = demonstration.tool * np.array([1, -1, 1, 1, 1, 1, 1])
    write_demonstration(tmp_path / "mirrored.mcap", demonstration._replace(tool=mirrored))
    out = tmp_path / "skill.npz"
    takes = (*map(str, files), str(tmp_path / "mirrored.mcap"))
    done = assert_refused(1, "was not written: ", "learn", *takes, "--output", str(out))
    assert "contradict others" in done.stderr
    assert "unsafe: " not in done.stdout
    assert not out.exists()


def test_skill_with_a_residual_risk_names_who_accepts_it(tmp_path: Path) -> None:
    """One hand makes a fine motion that a noisy tracker hardly resolves."""
    takes = [tmp_path / f"fine-{seed}.mcap" for seed in range(4)]
    for seed, path in enumerate(takes):
        write_demonstration(path, fine(seed, 0.003))
    out = tmp_path / "skill.npz"
    for option, says in (
        ((), "it is not served until somebody accepts its residual risk, named above"),
        (("--accept-residual-risk", "Ada"), "its residual risk is accepted by Ada"),
    ):
        done = succeeded("learn", *map(str, takes), "--output", str(out), *option)
        assert "residual risk: 1" in done.stdout
        assert says in done.stderr
        assert (
            "accepted by Ada: 1" in decoded(out.read_bytes(), origin="skill").residual_risk
        ) == bool(option)


def test_a_skill_is_refined_by_takes_of_ones_own(files: list[Path], tmp_path: Path) -> None:
    theirs = tmp_path / "theirs.npz"
    mine = tmp_path / "mine.npz"
    done = succeeded("learn", *map(str, files), "--output", str(theirs))
    own_paths = written(tmp_path, "mine", count=2, seed=5)
    refine = ("learn", *map(str, own_paths), "--output", str(mine), "--from")
    done = succeeded(*refine, str(theirs))
    assert "the weight of your demonstrations against the skill's, with errors; " in done.stdout
    names = [
        demonstration.name
        for demonstration in stored_demonstrations(decoded(mine.read_bytes(), origin="mine"))
    ]
    assert names == [path.stem for path in (*own_paths, *files)]
    for skill, says in (
        (RECORDINGS / "experiments" / "as-paper.npz", "its file does not hold the demonstrations"),
        (own_paths[0], "not a skill"),
        (tmp_path / "missing.npz", "cannot read skill"),
    ):
        assert_refused(1, says, *refine, str(skill))
