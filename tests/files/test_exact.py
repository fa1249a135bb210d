"""Sessions with each kind of skill replay bit for bit on other kinds of processors: every kernel of
OpenBLAS, no vector units, and no fused multiply-add in the C library.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from support.in_process import ASSUMED
from support.kinds import KINDS, learned
from support.paths import RECORDINGS, ROOT
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.controller import Controller, start_state
from thirdhand.core.frame import Tick, order
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import Recorder
from thirdhand.settings.config import robot_description
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import skill_in
from thirdhand.skills.via_points import adapted
from thirdhand_sim.lab.people.left_out import CORE_HZ, hand_events
from thirdhand_sim.scene import Scene

PROCESSORS = {
    "Prescott": {"OPENBLAS_CORETYPE": "Prescott"},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "Sandybridge": {"OPENBLAS_CORETYPE": "Sandybridge"},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "no AVX-512 in NumPy": {"NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX"},
    "no FMA in the C library": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2"},
    "generic": {"NUMBA_CPU_NAME": "generic"},  # compiles all functions again
}
REPLAYED = """
import sys
from pathlib import Path
from thirdhand.process import one_blas_thread
from thirdhand.recordings.replay import replay
for name in sys.argv[1:]:
    result = replay(Path(name))
    if not result.exact:
        print(name, result.text())
"""


def corrected() -> tuple[Skill, Demonstration]:
    """The shipped skill with an additional via-point that attracts the tool, and a take."""
    skill = skill_in(RECORDINGS / "soldering.npz")
    _, take = learned("cyclic")
    middle = skill.hands.mean(axis=0)
    tool = skill.tool_positions.mean(axis=0) + np.array([0.02, 0.0, 0.03])
    pull = ViaPoint(
        "correction-1", *(tuple(part.tolist()) for part in (middle[:3], middle[3:], tool))
    )
    return adapted(skill, (*Scene().via_points(), pull), tolerance=0.05), take


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A recording for each kind of skill: noisy hands that are unseen for a while, and a hold."""
    folder = tmp_path_factory.mktemp("sessions")
    out = [RECORDINGS / "golden.mcap"]
    settings = msgspec.structs.replace(ASSUMED, rate_hz=CORE_HZ)
    for number, kind in enumerate((*KINDS, "corrected")):
        skill, take = corrected() if kind == "corrected" else learned(kind)
        random = np.random.default_rng(number)
        left, right = (
            hand + random.normal(0.0, [0.001] * 3 + [0.01] * 4, hand.shape)
            for hand in (take.left, take.right)
        )
        received = hand_events(take._replace(left=left, right=right), range(2))
        unseen = slice(len(received) // 2, len(received) // 2 + CORE_HZ)
        received[unseen] = [[] for _ in received[unseen]]
        received[len(received) // 4].append(order("hold"))
        received[len(received) // 4 + 50].append(order("resume"))
        out.append(folder / f"{number}.mcap")
        controller = Controller(settings, skill, urdf=robot_description(settings))
        with Recorder(
            out[-1], settings=settings, skill=skill.file, state=start_state(settings, skill)
        ) as recorder:
            for index, inbox in enumerate(received):
                tick = Tick(index, tuple(inbox))
                recorder.write(
                    tick,
                    controller.step(tick),
                    time_ns=10**18 + index * round(settings.period_s * 1e9),
                )
    return out


@pytest.mark.timeout(600)
@pytest.mark.thorough
@pytest.mark.parametrize("processor", PROCESSORS)
def test_sessions_with_each_kind_of_skill_replay_bit_for_bit(
    sessions: list[Path], processor: str
) -> None:
    command = [sys.executable, "-c", REPLAYED, *map(str, sessions)]
    environment = os.environ | PROCESSORS[processor]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=580, check=False, env=environment, cwd=ROOT
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
