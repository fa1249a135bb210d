"""Bench and core in closed loop, faster than real time, for the golden session, experiments and
tests.

The core gets the samples of the bench's hands and arm, and the bench follows the core's newest
frame, as over the network.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from thirdhand.contract import cdr
from thirdhand.contract.messages import BASE, JointState, PoseStamped, Quaternion, Vector3
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Event, Frame, Tick
from thirdhand.core.skill.pose import CLOSED, UNKNOWN

if TYPE_CHECKING:
    from thirdhand_sim.bench import Bench

HANDS_HZ = 100  # rate of hands and joint states
START_NS = 1_000_000_000_000  # first stamp; 0 would mean no stamp


def hand_event(
    side: str, position: Vector3, stamp_ns: int, orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)
) -> Event:
    """A sample of one hand as an event."""
    pose = PoseStamped(stamp_ns, BASE, position, orientation)
    return Event(f"hands/{side}", cdr.encode_pose(pose), pose)


def joints_event(
    names: tuple[str, ...], position: tuple[float, ...], velocity: tuple[float, ...], stamp_ns: int
) -> Event:
    """A sample of the arm's joints as an event."""
    state = JointState(stamp_ns, names, position, velocity)
    return Event("joints/state", cdr.encode_joints(state), state)


def begin_when_settled(bench: Bench) -> None:
    """Begin the script once the arm has settled."""
    if bench.waiting and bench.settled(bench.tick * bench.period_s):
        bench.begin()


class ClosedLoop:
    """A bench that makes ticks for the core, and gets the frame of each tick by `follow`."""

    def __init__(
        self,
        bench: Bench,
        *,
        direct: Callable[[Bench], None] = begin_when_settled,
        spoil: Callable[[Event], tuple[Event, ...]] = lambda event: (event,),
    ) -> None:
        """`direct` is called before each step and starts and turns the script. `spoil` returns the
        events that replace a sample of a hand.
        """
        self._bench = bench
        self._direct = direct
        self._spoil = spoil
        self._newest: Frame | None = None

    def follow(self, tick: Tick, frame: Frame) -> None:
        """Let the arm follow a frame in the next step."""
        self._newest = frame

    def ticks(self) -> Iterator[Tick]:
        """A tick for each period until the script is over."""
        bench = self._bench
        every = max(1, round(1 / (HANDS_HZ * bench.period_s)))
        while True:
            self._direct(bench)
            if bench.finished:
                return
            newest = self._newest
            if newest is not None and newest["commanded"]:
                position = tuple(newest["joints"].tolist())
                velocity = tuple(newest["joint_velocities"].tolist())
                is_gripper_known = newest["gripper"] != UNKNOWN
                observation = bench.step(
                    position,
                    velocity,
                    gripper=float(newest["gripper"] == CLOSED) if is_gripper_known else None,
                )
            else:
                observation = bench.step()
            inbox: list[Event] = []
            if bench.tick % every == 0:
                stamp_ns = START_NS + bench.tick * round(bench.period_s * 1e9)
                for side, pose in zip(SIDES, bench.script.sample(bench.time_s), strict=True):
                    x, y, z, *orientation = pose.tolist()
                    inbox += self._spoil(hand_event(side, (x, y, z), stamp_ns, tuple(orientation)))
                inbox.append(
                    joints_event(
                        bench.joint_names,
                        observation.joints,
                        observation.joint_velocities,
                        stamp_ns,
                    )
                )
            yield Tick(bench.tick, tuple(inbox))
