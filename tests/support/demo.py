"""The demo in process and faster than real time: the service's core, its published commands, and
the bench that plays them back, each at its own rate.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np

from thirdhand.contract.cdr import encode_attachment
from thirdhand.contract.messages import Attachment
from thirdhand.contract.records import SIDES, Mode
from thirdhand.core.controller import Controller, outgoing
from thirdhand.core.frame import Event, Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.via_points import adapted
from thirdhand_sim.bench import Bench, TaskEvents
from thirdhand_sim.closed_loop import (
    HANDS_HZ,
    START_NS,
    begin_when_settled,
    hand_event,
    joints_event,
)
from thirdhand_sim.engines import world_of
from thirdhand_sim.lab.rehearsal import Rehearsed, rehearse
from thirdhand_sim.network import Commands, Gripper, Led
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript
from thirdhand_sim.world import World

SCENE = Scene()


class Played(NamedTuple):
    """Events of the task, the largest joint error against the command [rad], and True if the
    service followed during the whole script.
    """

    events: TaskEvents
    error_rad: float
    followed: bool


class Bytes:
    """Bytes as in a Zenoh sample."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def to_bytes(self) -> bytes:
        return self._data


class Sample(NamedTuple):
    """A substitute for a Zenoh sample."""

    payload: Bytes
    attachment: Bytes | None = None


@functools.cache
def taught() -> Skill:
    """The shipped skill with the nominal scene's via-points."""
    return adapted(shipped_skill(), SCENE.via_points(), tolerance=0.001).for_loop()


def soldered(
    cell: Settings | None = None,
    *,
    world: type[World] | None = None,
    look: Callable[[Bench], None] = lambda bench: None,
) -> Rehearsed:
    """A run of the nominal scene at 100 Hz, with its arrays."""
    return rehearse(
        HandScript(SCENE, seed=1),
        lambda _: taught(),
        settings=cell,
        rate_hz=100,
        world=world,
        keep=True,
        look=look,
    )


def assert_soldered(run: Rehearsed, cell: Settings) -> None:
    """Assert that a run succeeds within 3 mm, and that the arm follows within its speed limits."""
    assert run.events.success
    assert max(run.errors_mm) <= 3.0, run.errors_mm
    assert (run.frames["mode"][run.time_s > 0] == Mode.FOLLOW).all()
    assert (np.abs(run.frames["joint_velocities"]) <= cell.joints.velocity).all()
    assert np.abs(run.joints[:, 0] - run.frames["joints"]).max() < 3e-3


def played(settings: Settings, engine: str | None = None, *, bench_hz: int | None = None) -> Played:
    """One demo of the nominal scene; the bench has the rate of the settings by default.

    Raises BenchError.
    """
    period_s = settings.period_s
    names = settings.joints.names
    at_bench = msgspec.structs.replace(settings, rate_hz=bench_hz or settings.rate_hz)
    controller = Controller(settings, taught(), urdf=robot_description(settings))
    error_rad = 0.0
    followed = True
    index = 0
    with Bench(HandScript(SCENE, seed=1), settings=at_bench, world=world_of(engine)) as bench:
        commands = Commands(names)
        led = Led(bench, commands, Gripper())
        every = max(1, round(at_bench.rate_hz / HANDS_HZ))
        while not bench.finished:
            inbox: list[Event] = []
            while bench.tick * bench.period_s <= index * period_s + 1e-9:
                begin_when_settled(bench)
                observation = led.step()[0]
                stamp_ns = START_NS + round(bench.tick * bench.period_s * 1e9)
                if bench.tick % every == 0:
                    for side, pose in zip(
                        SIDES, bench.script.sample(observation.time_s), strict=True
                    ):
                        x, y, z, *orientation = pose.tolist()
                        inbox.append(hand_event(side, (x, y, z), stamp_ns, tuple(orientation)))  # type: ignore[arg-type]
                inbox.append(
                    joints_event(names, observation.joints, observation.joint_velocities, stamp_ns)
                )
            frame = controller.step(Tick(index, tuple(inbox)))
            tick_ns = START_NS + round(index * period_s * 1e9)
            for key, payload in outgoing(frame, tick_ns, names):
                if key == "joints/command":
                    attachment = Bytes(encode_attachment(Attachment(index, tick_ns, 0)))
                    commands.receive(Sample(Bytes(payload), attachment))  # type: ignore[arg-type]
                    error_rad = max(
                        error_rad, float(np.abs(frame["joints"] - observation.joints).max())
                    )
            followed &= bool(bench.waiting or frame["mode"] == Mode.FOLLOW)
            index += 1
        return Played(bench.events(), error_rad, followed)
