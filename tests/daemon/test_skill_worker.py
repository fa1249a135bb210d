"""The skill worker: another process makes the same skills to the bit as this one, and errors come
back with their words.
"""

from __future__ import annotations

import inspect
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from support.paths import RECORDINGS
from thirdhand.client import Client
from thirdhand.client.connection import Connection
from thirdhand.contract.requests import ANSWER_TIMEOUT_S
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.request_inbox import ADOPTION_TIMEOUT_S
from thirdhand.daemon.skill_worker import WORK_TIMEOUT_S, SkillWorker
from thirdhand.skills.skill_file import SkillError
from thirdhand.skills.via_points import adapted, in_force
from thirdhand_sim.scene import Scene

VIA_POINTS = Scene().via_points()
SOLDERING = RECORDINGS / "soldering.npz"


def process_of(worker: SkillWorker) -> int:
    """The process id of a running skill worker."""
    pid = worker.start().pid
    assert pid is not None
    return pid


def is_there(pid: int) -> bool:
    """True if a process exists, also as a zombie."""
    return Path(f"/proc/{pid}").exists()


def assert_same_bits(one: Skill, other: Skill) -> None:
    random = np.random.default_rng(0)
    hands, velocities, accelerations = (
        random.normal((0.8, 0.0, 0.2), 0.1, (2, 3)) for _ in range(3)
    )
    assert one.digest == other.digest
    assert one.file == other.file
    predicted, expected = (
        bits(skill.predict(hands, velocities, accelerations)) for skill in (one, other)
    )
    assert predicted == expected


def bits(value: object) -> bytes:
    """The bytes of arrays and numbers, and of those in a tuple."""
    if isinstance(value, tuple):
        return b"".join(map(bits, value))
    return b"" if value is None else np.asarray(value).tobytes()


@pytest.mark.parametrize("count", [3, 1, 0])
def test_adaptation_there_gives_the_same_bits(
    skill_worker: SkillWorker, skill: Skill, count: int
) -> None:
    """A skill that the worker adapted predicts the same bits as one adapted in this process."""
    adapted_skill = skill_worker.adapt(skill, VIA_POINTS[:count], tolerance=0.05)
    assert_same_bits(adapted_skill, adapted(skill, VIA_POINTS[:count], tolerance=0.05))
    assert adapted_skill.via_points == VIA_POINTS[:count]
    assert in_force(adapted_skill) == in_force(adapted(skill, VIA_POINTS[:count], tolerance=0.05))


def test_errors_come_back_and_do_not_end_the_process(
    skill_worker: SkillWorker, skill: Skill, tmp_path: Path
) -> None:
    skill_worker.load(SOLDERING)
    started = process_of(skill_worker)
    with pytest.raises(SkillError, match=r"tolerance is -1 m; 0 or more accepted"):
        skill_worker.adapt(skill, VIA_POINTS[:1], tolerance=-1.0)
    with pytest.raises(SkillError, match=r"cannot read skill .*nowhere\.npz: No such file"):
        skill_worker.load(tmp_path / "nowhere.npz")
    with pytest.raises(SkillError, match=r"cannot read skill .*: Is a directory"):
        skill_worker.load(tmp_path)
    (tmp_path / "broken.npz").write_bytes(SOLDERING.read_bytes()[:5000])
    with pytest.raises(SkillError, match=r"broken\.npz: not a skill"):
        skill_worker.load(tmp_path / "broken.npz")
    assert_same_bits(skill_worker.load(SOLDERING), skill)
    assert process_of(skill_worker) == started


def test_a_killed_process_is_replaced_at_the_next_request(
    skill_worker: SkillWorker, skill: Skill
) -> None:
    skill_worker.load(SOLDERING)
    started = process_of(skill_worker)
    os.kill(started, signal.SIGKILL)
    # the skill worker itself detects that its process is dead
    os.waitid(os.P_PID, started, os.WEXITED | os.WNOWAIT)
    assert_same_bits(skill_worker.load(SOLDERING), skill)
    assert process_of(skill_worker) != started
    assert not is_there(started)


def test_closing_leaves_no_process(skill: Skill) -> None:
    """The skills remain usable, and closing may be repeated."""
    skill_worker = SkillWorker()
    skill_worker.close()
    adapted_skill = skill_worker.adapt(skill, VIA_POINTS, tolerance=0.05)
    started = process_of(skill_worker)
    skill_worker.close()
    skill_worker.close()
    assert not is_there(started)
    assert_same_bits(adapted_skill, adapted(skill, VIA_POINTS, tolerance=0.05))
    with pytest.raises(ValueError, match="read-only"):
        adapted_skill.model.primitive.inputs[0, 0] = 1.0


def test_a_workshop_that_hangs_is_replaced_and_a_slow_one_is_not(
    skill: Skill, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("thirdhand.daemon.skill_worker.HUNG_S", 0.5)
    worker = SkillWorker()
    try:
        worker.load(SOLDERING)
        stopped = process_of(worker)
        os.kill(stopped, signal.SIGSTOP)
        with pytest.raises(SkillError, match=r"made no progress for 0\.5 s; nothing was changed"):
            worker.load(SOLDERING)
        assert not is_there(stopped)
        assert_same_bits(worker.load(SOLDERING), skill)
        slowed = process_of(worker)
        os.kill(slowed, signal.SIGSTOP)
        threading.Timer(0.3, os.kill, [slowed, signal.SIGCONT]).start()
        assert_same_bits(worker.load(SOLDERING), skill)
        assert process_of(worker) == slowed
    finally:
        worker.close()


def test_time_of_a_request_counts_from_its_arrival(skill_worker: SkillWorker) -> None:
    """The time does not count from the start of the processing."""
    with ThreadPoolExecutor(1) as pool, skill_worker._busy:  # noqa: SLF001  # an earlier request

        def late(left_s: float) -> None:
            with skill_worker.due(time.monotonic() - WORK_TIMEOUT_S + left_s):
                skill_worker.load(SOLDERING)

        for left_s in (0.2, -1.0):
            with pytest.raises(SkillError, match="busy with earlier requests; nothing was changed"):
                pool.submit(late, left_s).result(2.0)
    assert WORK_TIMEOUT_S + ADOPTION_TIMEOUT_S < ANSWER_TIMEOUT_S
    for waiting in (Client, Connection):
        assert inspect.signature(waiting).parameters["timeout_s"].default == ANSWER_TIMEOUT_S
