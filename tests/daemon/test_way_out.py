"""A daemon whose arm is stuck reports it; the skill worker plans a way out, and the arm follows
it.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from support.cell import Tracker, serving

STUCK = [1.66, 0.73, 1.61, -0.13, 0.1, -0.97, -2.26]  # [rad] from here, joints reach their ends


@pytest.mark.thorough
def test_an_arm_that_is_stuck_says_so_and_comes_out(tmp_path: Path) -> None:
    config = tmp_path / "stuck.toml"
    files = f"[files]\nstate = {json.dumps(str(tmp_path / 'state'))}\n"
    network = '[network]\nlisten = ["tcp/127.0.0.1:0"]\n'
    config.write_text(f"{network}{files}[arm]\nposture = {STUCK}\n")
    with (
        serving(tmp_path, "--config", str(config), "--joints", "assumed") as daemon,
        Tracker(daemon.session) as hands,
    ):
        hands.left = (0.986, -0.354, 0.075)
        hands.right = (0.78, 0.06, 0.11)
        stuck = daemon.until(
            lambda status: "stuck" in status["flags"] or status["reason"] == "blocked", 30.0
        )
        assert "from its target" in stuck["because"], stuck
        assert stuck["remedy"]
        leaving = daemon.until(lambda status: "on its way out" in status["because"], 30.0)
        assert (leaving["mode"], leaving["reason"]) == ("hold", "blocked")
        following = daemon.until(
            lambda status: status["mode"] == "follow" and not status["because"], 30.0
        )
        assert not following["flags"] or "stuck" not in following["flags"]
    assert "a way out of" in daemon.log.read_text()
