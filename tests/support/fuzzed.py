"""Legal hands, an arm and requests as bytes, many of them damaged; and the assertions on a
recording of such a session.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from random import Random

import numpy as np

from support.arm_geometry import ArmGeometry
from support.bounds import Session, broken
from support.explained import explained_controller
from support.hostile_bytes import mutated
from support.in_process import LEFT, RIGHT
from support.wam import JOINT_NAMES
from thirdhand.contract import cdr
from thirdhand.contract.messages import BASE, JointState, PoseStamped
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Frame, Vector
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay, ticks
from thirdhand.settings.config import robot_description
from thirdhand.skills.skill_file import decoded

QUIET_S = 1.0  # in one second of every two nothing is damaged
ASKED = ("hold", "resume", "reset", "via_points", "skill", "status")
DECODERS = {"via_points": "via_points", "skill": "skill_request"}  # other requests have no content
REQUEST = {"via_points": b'{"op": "list"}', "skill": b'{"name": "soldering"}'}


class Traffic:
    """Messages (key, bytes) for every moment: two hands that reach there and back at up to 1 m/s,
    an arm that follows its commands, sometimes a request; damaged in every other second.
    """

    def __init__(self, seed: int) -> None:
        self._random = Random(seed)
        self.joints: Vector | None = None  # [rad] reported by the arm

    def at(self, t: float, stamp_ns: int) -> Iterator[tuple[str, bytes]]:
        """The messages at a time [s] since the start, stamped with it."""
        random = self._random
        hostile = t % (2.0 * QUIET_S) >= QUIET_S
        for side, home in zip(SIDES, (LEFT, RIGHT), strict=True):
            x, y, z = home
            away = 0.06 * math.sin(2.0 * math.pi * t / 1.5)
            pose = cdr.encode_pose(
                PoseStamped(
                    stamp_ns, BASE, (x - abs(away), y + away, z + 0.05), (0.0, 0.0, 0.0, 1.0)
                )
            )
            yield (
                f"hands/{side}",
                mutated("pose", pose, random) if hostile and random.random() < 0.3 else pose,
            )
        if self.joints is not None:
            message = JointState(
                stamp_ns, JOINT_NAMES, tuple(self.joints.tolist()), (0.0,) * len(JOINT_NAMES)
            )
            state = cdr.encode_joints(message)
            yield (
                "joints/state",
                mutated("joints", state, random) if hostile and random.random() < 0.3 else state,
            )
        if hostile and random.random() < 0.1:
            key = random.choice(ASKED)
            yield key, mutated(DECODERS.get(key, "nothing"), REQUEST.get(key, b"{}"), random)
        if not hostile and random.random() < 0.1:
            yield random.choice(("resume", "reset")), b"{}"


def assert_recorded_session_keeps_the_bounds(path: Path) -> np.ndarray:
    """Returns the recorded frames (T,): the core computes them from the recorded bytes bit for bit,
    and they keep every bound.
    """
    result = replay(path)
    assert result.exact, result.text()
    recording = Recording.open(path)
    settings = recording.settings
    urdf = robot_description(recording.settings)
    skill = decoded(recording.skill, origin=str(path))
    controller = explained_controller(settings, skill, urdf=urdf)
    frames: list[Frame] = []
    measured: list[Vector] = []
    for tick in ticks(recording):
        frames.append(controller.step(tick))
        measured.append(controller.state["measured"].copy())
    count = len(frames)
    assert count == result.ticks
    session = Session(
        settings=settings,
        geometry=ArmGeometry(settings, urdf),
        frames=np.array(frames),
        measured=np.array(measured),
        boxes=np.tile(skill.workspace, (count, 1, 1)),
        receiving=np.zeros((count, 2), bool),
        hands=np.zeros((count, 2, 3)),
        # true hands are not recorded, only reported ones
        still_s=np.zeros((count, 2)),
        noise_m=0.0,
        quiet_from=count,
        arm_follows=False,
        deadlines_kept=False,
    )
    assert not broken(session), broken(session)
    return session.frames
