"""The controller of a cell, which decides the next tick before its deadline where it can."""

from __future__ import annotations

from typing import NamedTuple

from thirdhand.core.controller import Controller, outgoing
from thirdhand.core.frame import Frame, Lap, Outputs, Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import Settings, robot_description


class DecidedTick(NamedTuple):
    """A tick, its frame, and the messages to publish for it."""

    tick: Tick
    frame: Frame
    outputs: Outputs


class RehearsedController:
    """A controller and its twin, on which the next tick is rehearsed.

    If the tick takes in the same as the rehearsed one, the twin has its frame and its messages, bit
    for bit. Else the rehearsal has brought code and data into the processor's caches. All methods
    are for the loop; other threads read `controller`.
    """

    def __init__(self, settings: Settings, skill: Skill) -> None:
        self._joints = settings.joints.names
        urdf = robot_description(settings)
        self.controller = Controller(settings, skill, urdf=urdf)
        self._twin = Controller(settings, skill, urdf=urdf)
        self._rehearsed: DecidedTick | None = None
        self._twin_leads = False  # the newest tick was the rehearsed one

    def rehearse(self, tick: Tick, lap: Lap) -> None:
        """Decide what is likely to be the next tick, without consequence for the controller."""
        self.settle()
        self._rehearsed = None
        self._twin.copy_from(self.controller)
        self._rehearsed = self._decided(self._twin, tick, lap)

    def decide(self, tick: Tick, lap: Lap) -> DecidedTick:
        """The frame and the messages of a tick, by the rehearsal if it was of an equal one. Call
        `settle` once they are published.
        """
        self.settle()
        rehearsed = self._rehearsed
        if rehearsed is None or rehearsed.tick != tick:
            return self._decided(self.controller, tick, lap)
        self._twin_leads = True
        return rehearsed

    def settle(self) -> None:
        """Have the controller take over what the twin decided. Nothing is done without need."""
        if self._twin_leads:
            self.controller.copy_from(self._twin)
            self._twin_leads = False

    def _decided(self, controller: Controller, tick: Tick, lap: Lap) -> DecidedTick:
        frame = controller.step(tick, lap)
        return DecidedTick(tick, frame, outgoing(frame, tick.time_ns, self._joints))
