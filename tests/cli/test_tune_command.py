"""`thirdhand tune`: what it prints, draws and refuses."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from support.cell_commands import succeeded
from support.paths import RECORDINGS
from thirdhand.workbench.cli import tune
from thirdhand.workbench.report.variants import CHANGES

GOLDEN = str(RECORDINGS / "golden.mcap")
TAKE = str(RECORDINGS / "demonstration-1.mcap")


@pytest.mark.timeout(300)
def test_settings_are_tried_on_a_recording(tmp_path: Path) -> None:
    plot = tmp_path / "tune.png"
    done = succeeded("tune", GOLDEN, "--part", "2", "4.2", "--json", "--plot", str(plot))
    found = json.loads(done.stdout)
    assert [one["name"] for one in found["variants"]][:2] == ["as recorded", "follow = closely"]
    assert len(found["variants"]) == len(CHANGES)  # "as recorded", and all but the recording's own `follow`
    assert found["judged_s"] > 2.0
    left = found["hands"]["left"]
    assert left["noise_mm"] == pytest.approx(0.5, abs=0.15)
    assert found["variants"][0]["rejected"] == {}  # the samples that are rejected come later
    assert tomllib.loads(found["best"]["toml"]) == found["best"]["change"]
    assert plot.stat().st_size > 20_000


@pytest.mark.timeout(300)
def test_a_take_is_tuned_with_the_shipped_cell_and_skill(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tune, "CHANGES", CHANGES[:6])
    done = succeeded("tune", TAKE, "--part", "3", "8")
    assert "has no settings: those of the shipped cell are used; --config gives others" in done.stderr
    assert "has no skill: soldering, which is shipped, is used; --skill gives another" in done.stderr
    for words in (
        "Noise and tremor of the hands",
        "Settings, and how the tool follows",
        "as recorded",
        "max_jerk = 100",
    ):
        assert words in done.stdout
    assert "Leave the settings." in done.stdout or "Write into the cell's settings:\n\n[" in done.stdout
