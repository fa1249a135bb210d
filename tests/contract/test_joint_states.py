"""Joint states as robots publish them: which messages give the state of an arm, and when."""

from __future__ import annotations

import math
import random

import pytest

from thirdhand.contract.joint_states import JointStates, measured
from thirdhand.contract.messages import JointState, WireError

NAMES = ("a", "b", "c")
NAN = math.nan
STATE = JointState(1, NAMES, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("message", "velocity"),
    [
        (STATE, (0.1, 0.2, 0.3)),
        (STATE._replace(velocity=()), (0.0, 0.0, 0.0)),
        (STATE._replace(velocity=(NAN,) * 3, effort=(NAN,) * 3), (0.0, 0.0, 0.0)),
        (STATE._replace(velocity=(0.1, NAN, 0.3)), (0.1, 0.0, 0.3)),
        (STATE._replace(velocity=(0.1, 0.2)), (0.0, 0.0, 0.0)),
        (STATE._replace(velocity=(0.1,) * 9), (0.0, 0.0, 0.0)),
        (STATE._replace(velocity=(0.1, math.inf, 0.3)), (0.1, math.inf, 0.3)),
        (
            JointState(1, ("c", "x", "a", "b"), (3.0, NAN, 1.0, 2.0), (0.3, NAN, 0.1, 0.2)),
            (0.1, 0.2, 0.3),
        ),
    ],
)
def test_unmeasured_velocity_is_zero(message: JointState, velocity: tuple[float, ...]) -> None:
    """Other values are unchanged."""
    assert measured(message, NAMES) == ((1.0, 2.0, 3.0), velocity)


def part(names: str, stamp_ns: int, value: float = 0.5) -> JointState:
    return JointState(stamp_ns, tuple(names), (value,) * len(names), (NAN,) * len(names))


def test_messages_without_joints_of_the_arm_are_ignored() -> None:
    """The ignored messages are named once no state arrives."""
    states = JointStates(NAMES, 0.1)
    fingers = part("xy", 1)
    for k in range(300):
        at_s = k / 1000
        assert states.take(fingers, at_s) is None
        assert states.incomplete(fingers, at_s) is None
        assert states.take(STATE._replace(position=()), at_s) is None  # it has velocities only
        if k % 10 == 0:
            assert states.take(STATE, at_s) is STATE
    for k in range(300, 500):
        assert states.take(fingers, k / 1000) is None
    assert states.incomplete(fingers, 0.5) is fingers


@pytest.mark.parametrize("split", ["a bc", "c ba", "a b c", "ab bc ca", "ax by cz"])
def test_partial_publishers_give_states_at_the_slowest_rate(split: str) -> None:
    """If each publisher has some of the joints, states have the rate of the slowest publisher."""
    states = JointStates(NAMES, 0.1)
    samples = []
    parts = split.split()
    dice = random.Random(1)
    for k in range(500):
        at_s = k / 1000
        for number in dice.sample(range(len(parts)), len(parts)):
            # the first publishes at 100 Hz, the others at 1000 Hz
            if k % (1 + 9 * (number == 0)) == 0:
                state = states.take(part(parts[number], k + 1, value=at_s), at_s)
                samples += [] if state is None else [(at_s, state)]
    assert len(samples) >= 49
    for at_s, state in samples:
        assert state.names == NAMES
        assert all(at_s - value <= 0.011 for value in state.position)
        assert state.velocity == (0.0, 0.0, 0.0)
    stamps = [state.stamp_ns for _, state in samples]
    assert stamps == sorted(stamps)
    # two publishers of a joint may repeat a stamp
    assert len(set(stamps)) == len(stamps) or split == "ab bc ca"


def test_joints_of_a_publisher_that_ended_are_named() -> None:
    """Without them there are no states."""
    states = JointStates(NAMES, 0.1)
    for k in range(400):
        at_s = k / 1000
        state = states.take(part("ab", k + 1), at_s)
        assert state is None
        whole = states.take(part("c", k + 1), at_s) if k < 100 else None
        assert (whole is not None) == (k < 100)
    assert at_s > 0.3
    lacking = states.incomplete(part("ab", 400), at_s)
    assert lacking is not None
    with pytest.raises(WireError, match=r"joints \['c'\] missing among 2, a, b"):
        measured(lacking, NAMES)


def test_parts_that_are_too_old_are_not_assembled() -> None:
    states = JointStates(NAMES, 0.1)
    assert states.take(part("a", 1), 0.0) is None
    assert states.take(part("bc", 2), 60.0) is None
    assert states.take(part("a", 3), 60.05) is not None


def test_a_stamp_that_does_not_advance_shows_in_the_state() -> None:
    states = JointStates(NAMES, 0.1)
    stamps = set()
    for k in range(1, 50):
        states.take(part("ab", 7), k / 1000)
        state = states.take(part("c", 7 + k), k / 1000)
        assert state is not None
        stamps.add(state.stamp_ns)
    assert stamps == {7}


def test_joint_without_a_position_comes_from_its_publisher() -> None:
    """A joint without a measured position is taken from the publisher that measures it."""
    states = JointStates(NAMES, 0.1)
    assert states.take(part("ab", 1, value=NAN), 0.0) is None
    assert states.take(part("bc", 1), 0.0) is None
    state = states.take(part("a", 2), 0.001)
    assert state is not None
    assert state.position == (0.5, 0.5, 0.5)
