"""Policies over Zenoh: a program's wishes lead the tool, and wrong ones do no harm."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.cell import LISTENING, Daemon, Tracker, serving
from thirdhand.client import Connection, open_session
from thirdhand.client.session import RefusedError
from thirdhand.contract import cdr
from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay

LED = f'{LISTENING}\n[skill]\nsource = "tool/wish"\n'
BLENDED = f"{LED}blend = true\n"


def is_following(status: dict[str, Any]) -> bool:
    return status["mode"] == "follow"


def start_of(daemon: Daemon) -> np.ndarray:
    """The tool's position (3,) [m]."""
    return np.array(daemon.until(lambda status: status["tool_m"] is not None)["tool_m"])


def recorded(folder: Path) -> Recording:
    (path,) = folder.glob("*.mcap")
    result = replay(path)
    assert result.exact, result.text()
    return Recording.open(path)


@pytest.mark.timeout(180)
def test_a_program_leads_the_tool_in_chunks(tmp_path: Path) -> None:
    """The tool follows within 5 mm of its path, and the recording replays exactly."""
    records = tmp_path / "records"
    with serving(tmp_path, "--joints", "assumed", "--record", str(records), network=LED) as daemon:
        assert daemon.until(lambda s: s["reason"] == "no_wish")["because"]
        start = start_of(daemon)
        cell = Connection(daemon.session)
        begun_s = time.monotonic()
        while (now_s := time.monotonic() - begun_s) < 4.0:
            ahead_s = now_s + np.arange(20) / 30
            offs = np.outer(np.sin(ahead_s), [0.0, 0.08, 0.04])
            stamp_ns = time.time_ns()
            time.sleep(0.15)  # the policy thinks
            turn = (1.0, 0.0, 0.0, 0.0)
            poses = [(*(start + off).tolist(), *turn) for off in offs]
            cell.wish_chunk(poses, step_s=1 / 30, stamp_ns=stamp_ns, std=(0.01, 0.1))
        status = daemon.until(is_following)
        assert status["hands"] == "neither"
        assert status["sources"]["wish"]["fresh"]
        ahead = time.monotonic() - begun_s
        off = np.array(status["tool_m"]) - start
        assert off[1] == pytest.approx(0.08 * np.sin(ahead), abs=0.02)
        assert status["std_m"] == pytest.approx(0.01, abs=1e-4)
        assert daemon.until(lambda s: s["reason"] == "stale_wish")["remedy"]
    steps = recorded(records).steps()
    kinds = [kind for step in steps for kind, _ in step.events]
    assert kinds.count("tool/wish") > 300


@pytest.mark.timeout(180)
def test_a_cell_without_a_skill_refuses_to_be_taught(tmp_path: Path) -> None:
    with serving(tmp_path, "--joints", "assumed", network=LED) as daemon:
        start_of(daemon)
        cell = Connection(daemon.session)
        with pytest.raises(RefusedError, match="follows the wishes on tool/wish"):
            cell.teach("a", left=(1, 0, 0), right=(1, 0.3, 0), tool=(0.5, 0, 0.3))
        with pytest.raises(RefusedError, match="has no skill"):
            cell.set_segment("a")
        with pytest.raises(RefusedError, match="has no skill"):
            cell.correct()
        assert "no skill whose task" in cell.begin().note
        assert cell.hold().mode == "hold"


@pytest.mark.timeout(180)
def test_wrong_wishes_are_counted_and_explained(tmp_path: Path) -> None:
    """Of a flood, of a second program and of nonsense nothing reaches the arm."""
    with serving(tmp_path, "--joints", "assumed", network=LED) as daemon:
        start = tuple(start_of(daemon).tolist())
        turn = (1.0, 0.0, 0.0, 0.0)
        cell = Connection(daemon.session)
        cell.wish((*start, *turn))
        daemon.until(is_following)

        def put(position: tuple[float, ...], after_s: float = 0.0, frame: str = BASE) -> None:
            pose = PoseStamped(time.time_ns() + round(1e9 * after_s), frame, position, turn)
            daemon.session.put("thirdhand/tool/wish", cdr.encode_pose(pose))

        with open_session(connect=[daemon.endpoint]) as other:
            pose = PoseStamped(time.time_ns(), BASE, (9.0, 9.0, 9.0), turn)
            for _ in range(20):
                cell.wish((*start, *turn))
                other.put(
                    "thirdhand/tool/wish",
                    cdr.encode_pose(pose),
                    source_info=None,
                )
                time.sleep(0.01)
        status = daemon.until(lambda s: s["rejected"].get("other_publisher", 0) >= 20)
        time.sleep(0.7)

        for words, send in {
            "not_finite": lambda: put((float("nan"), 0.0, 0.0)),
            "out_of_range": lambda: put((1e6, 0.0, 0.0)),
            "older": lambda: put(start, -5.0),
            "ahead": lambda: put(start, 5.0),
            "wrong_frame": lambda: put(start, frame="camera"),
            "malformed tool/wish": lambda: daemon.session.put("thirdhand/tool/wish", b"?"),
        }.items():
            send()
            status = daemon.until(lambda s, words=words: s["rejected"].get(words))
            assert status["sources"]["wish"]["refused"]
            assert status["sources"]["wish"]["advice"]

        for _ in range(2000):  # as fast as they go
            put(start)
        np.testing.assert_allclose(daemon.until(is_following)["tool_m"], start, atol=2e-3)


@pytest.mark.timeout(180)
def test_skill_and_policy_share_the_control(tmp_path: Path) -> None:
    """A sure policy moves the target of a skill whose hands are seen; the recording replays."""
    records = tmp_path / "records"
    with (
        serving(
            tmp_path, "--joints", "assumed", "--record", str(records), network=BLENDED
        ) as daemon,
        Tracker(daemon.session),
    ):
        alone = daemon.until(lambda s: s["mode"] == "follow" and s["target_m"])
        wanted = np.add(alone["target_m"], [0.0, 0.05, 0.0])
        cell = Connection(daemon.session)
        for _ in range(60):
            cell.wish([*wanted, 1.0, 0.0, 0.0, 0.0], std=(1e-4, 1e-2))
            time.sleep(0.02)
        both = daemon.until(is_following)
        assert np.linalg.norm(np.array(both["target_m"]) - wanted) < 0.01
        again = daemon.until(
            lambda s: np.allclose(s["target_m"] or 0.0, alone["target_m"], atol=2e-3)
        )
        assert again["mode"] == "follow"
    recorded(records)
