"""The programs in examples/, run as they stand: tracker, follower, teacher and watcher with one
daemon; and the example of kmp.
"""

from __future__ import annotations

import importlib.util
import threading
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import thirdhand
from support.cell import serving
from support.paths import ROOT

EXAMPLES = ROOT / "examples"


def example(name: str) -> ModuleType:
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.thorough
def test_tracker_follower_teacher_and_watcher_work_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The programs get a second attempt with twice the time, as the machine may be busy."""
    output = ""
    ended = dict[str, Any]()
    with serving(tmp_path) as daemon:
        options = ["--connect", daemon.endpoint]
        example("teach").main(options)
        modules = {name: example(name) for name in ("watch", "follower")}
        hands: thirdhand.Hands = example("tracker").SwayingHands()
        for seconds in (2, 4, 8, 16):
            daemon.client.reset()

            def run(name: str, *arguments: str) -> None:
                ended[name] = modules[name].main([*options, *arguments])

            running = [
                threading.Thread(target=run, args=(name, "--seconds", f"{seconds}"))
                for name in modules
            ]
            for thread in running:
                thread.start()
            ended_s = time.monotonic() + seconds

            def is_over(ended_s: float = ended_s) -> bool:
                return time.monotonic() > ended_s

            hands.publish(daemon.session, is_over=is_over)
            for thread in running:
                thread.join(60)
            output += capsys.readouterr().out
            if "thirdhand: follow" in output:
                break
        received = daemon.client.status().received
    assert ended.keys() == modules.keys()
    assert received.keys() == {
        "hands/left",
        "hands/right",
        "joints/state",
        "joints/guided",
        "objects",
    }
    assert "thirdhand: follow" in output
    assert "commands arrive, at tick " in output
    assert "were none of this arm's" not in output
    assert "example: missed by " in output
    assert "refused: $.names[0]: no via-point 'no such via-point'" in output
    assert np.abs(ended["follower"]).max() > 0.1


def test_mathematics_alone_goes_through_the_point(capsys: pytest.CaptureFixture[str]) -> None:
    """The mean passes through the given point."""
    adapted = example("kmp_alone").main()
    assert np.allclose(adapted.mean(np.array([[1.0]])), [[0.20, 0.10]], atol=2e-3)
    assert len(capsys.readouterr().out.splitlines()) == 6
