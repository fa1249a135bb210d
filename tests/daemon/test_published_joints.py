"""A running daemon and joint states as robots publish them: the arm is found among other content of
its topic, and missing joints are named.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Iterator

import pytest

from support.cell import Daemon, serving
from support.repeated import repeated
from thirdhand.contract import cdr
from thirdhand.contract.messages import JointState
from thirdhand.settings.config import Settings

JOINTS = Settings().joints.names
AT = dict(zip(JOINTS, Settings().arm.posture, strict=True))
NAN = math.nan


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with serving(tmp_path_factory.mktemp("joints")) as running:
        yield running


def state(*names: str, velocity: tuple[float, ...] | None = None, **others: float) -> JointState:
    """A joint state of arm joints at the arm's posture, and of `others`."""
    named = {name: AT[name] for name in names} | others
    unmeasured = (NAN,) * len(named)
    velocities = unmeasured if velocity is None else velocity
    return JointState(time.time_ns(), tuple(named), tuple(named.values()), velocities, unmeasured)


@contextlib.contextmanager
def published(daemon: Daemon, messages: Callable[[int], list[JointState]]) -> Iterator[None]:
    """A context in which `messages(k)` are published every 4 ms, k = 0, 1, ..."""
    counted = itertools.count()
    with daemon.session.declare_publisher("thirdhand/joints/state") as publisher:

        def publish() -> None:
            for message in messages(next(counted)):
                publisher.put(cdr.encode_joints(message))

        with repeated(publish, 0.004):
            yield


CASES: dict[str, Callable[[int], list[JointState]]] = {
    "positions only": lambda k: [state(*JOINTS)],
    "fewer velocities than joints": lambda k: [
        state(*JOINTS, velocity=(0.0,) * 7, left_finger=0.1, right_finger=NAN)
    ],
    "a gripper between": lambda k: (
        [state(left_finger=0.1) for _ in range(4)] + [state(*JOINTS[::-1])] * (k % 5 == 0)
    ),
    "a humanoid": lambda k: [
        state(
            *JOINTS, **{f"humanoid/left_hand_ring_finger_distal_joint_{i}": 0.0 for i in range(65)}
        )
    ],
    "two publishers": lambda k: (
        [state(*JOINTS[:4])] * (k % 2) + [state(finger=1.0), state(*JOINTS[4:], finger=1.0)]
    ),
    "a joint each": lambda k: [state(name) for name in JOINTS],
    "every joint twice": lambda k: [state(name) for name in (*JOINTS[:3], *JOINTS[:3], *JOINTS)],
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.one_case
def test_the_arm_is_found_whatever_else_its_topic_carries(daemon: Daemon, case: str) -> None:
    daemon.until(lambda now: now["reason"] == "arm_not_ready")
    before = daemon.client.status().rejected
    with published(daemon, CASES[case]):
        status = daemon.until(lambda now: now["reason"] == "no_hands")
    lost = {cause: n - before.get(cause, 0) for cause, n in status["rejected"].items()}
    assert not any(lost.values()), lost
