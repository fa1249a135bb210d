"""The programs in examples/, run as they stand: a tracker with a daemon, and the example of kmp."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import thirdhand
from support.cell import serving
from support.examples import example


@pytest.mark.thorough
def test_tracker_moves_the_tool(tmp_path: Path) -> None:
    with serving(tmp_path, "--joints", "assumed") as daemon:
        hands: thirdhand.Hands = example("tracker").SwayingHands()
        began_s = time.monotonic()
        hands.publish(daemon.session, is_over=lambda: time.monotonic() > began_s + 2.0)
        assert daemon.client.status().received.keys() >= {"hands/left", "hands/right"}


def test_mathematics_alone_goes_through_the_point(capsys: pytest.CaptureFixture[str]) -> None:
    """The mean passes through the given point."""
    adapted = example("kmp_alone").main()
    assert np.allclose(adapted.mean(np.array([[1.0]])), [[0.20, 0.10]], atol=2e-3)
    assert len(capsys.readouterr().out.splitlines()) == 6
