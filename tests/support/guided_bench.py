"""The bench with an arm that a person may lead by hand, which its driver reports."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

import numpy as np
import zenoh

from thirdhand.client import Publisher
from thirdhand.contract import cdr
from thirdhand.core.frame import Vector
from thirdhand.daemon.clock import Deadlines
from thirdhand.settings.config import Settings
from thirdhand_sim.bench import Bench
from thirdhand_sim.network import Bridge, Led, Live
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

LED_RADPS = 0.5
SETTLED_RAD = 0.003


class GuidedBench:
    """A simulated arm in a thread: it follows the cell's commands, or is led by `lead`."""

    def __init__(self, session: zenoh.Session, settings: Settings) -> None:
        self._session = session
        self._settings = settings
        self._goal: Vector | None = None
        self._joints = np.zeros(len(settings.joints.names))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def lead(self, by: Vector) -> None:
        """Lead the arm from its present joints by an offset (J,) [rad], and hold it there; the
        driver reports guiding.
        """
        self._goal = self._joints + by

    @property
    def is_led_there(self) -> bool:
        """True once the arm has reached the offset."""
        return self._goal is not None and bool(
            np.abs(self._goal - self._joints).max() < SETTLED_RAD
        )

    def let_go(self) -> None:
        """End guiding: the arm rests, and follows commands again."""
        self._goal = None

    def _run(self) -> None:
        publisher = Publisher(self._session, self._settings.cell, "joints/guided")
        with Bench(HandScript(Scene(), seed=1), settings=self._settings) as bench:
            bridge = Bridge(self._session, Live(cell=self._settings.cell), bench.joint_names)
            drive = Led(bench, bridge.commands, bridge.gripper)
            deadlines = Deadlines(self._settings.rate_hz)
            before = -1
            while not self._stop.is_set():
                index = deadlines.wait()[0]
                if (goal := self._goal) is None:
                    observation = drive.step(index - before)[0]
                else:
                    step = goal - self._joints
                    step *= min(
                        1.0, LED_RADPS * bench.period_s / max(float(np.abs(step).max()), 1e-9)
                    )
                    observation = bench.step(tuple((self._joints + step).tolist()))
                    # playback restarts where the arm was released
                    drive = Led(bench, bridge.commands, bridge.gripper)
                    bridge.commands.queued()
                before = index
                self._joints = np.array(observation.joints)
                bridge.publish_joints(observation)
                publisher.put(cdr.encode_bool(goal is not None))
            bridge.close()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()
