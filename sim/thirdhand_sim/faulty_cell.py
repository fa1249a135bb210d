"""A complete cell for fault injection: service, scribe, skill worker, tracker and network as
processes, the bench's arm in real time, and the times of each fault.

with FaultyCell(folder) as cell:
    event = cell.suffer("tracker killed", Fault(lambda cell: cell.tracker.send(SIGKILL), ...))
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, Self

import zenoh

from thirdhand.client import Client, UnreachableError, open_session
from thirdhand.contract import cdr, channels
from thirdhand.daemon.clock import Deadlines
from thirdhand.daemon.launch import Launched, launched
from thirdhand.settings.config import Settings
from thirdhand_sim.bench import Bench
from thirdhand_sim.network import Bridge, Live
from thirdhand_sim.parts import CELL, CellPart, Link, as_usual_afterwards, before_others
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

FAST = 0.5  # [m/s] a fault strikes while the tool is faster
MOVES = 0.05  # [m/s] after a fault the tool moves again from this speed on
WATCHED_S = 1.0  # default time from a fault to its repair
STEADY_S = 1.5  # the arm follows for this time before a fault strikes
RESUMES_WITHIN_S = 60.0
SWING_TIMEOUT_S = 5.0  # longer than a period of the hands' swing


Network = Literal["relays", "router", "link"]
# time of leaving the service (time.monotonic() [s]), tick, bytes
Command = tuple[float, int, bytes]


class FaultError(RuntimeError):
    """A cell did not reach a required state; the message has the state."""


class FaultTimes(NamedTuple):
    """The times of a fault, of its repair, of the tool's next motion, and of the end of observation
    (time.monotonic() [s]), the tick of the fault, and the number of lost ticks.
    """

    fault: str
    struck_s: float
    mended_s: float
    moving_s: float
    ended_s: float
    tick: int
    lost: int


@dataclass(frozen=True)
class Fault:
    """A fault: its injection, its repair, True if the arm `stops`, the kind of network, and the
    time from injection to repair [s].
    """

    provoke: Callable[[FaultyCell], None]
    mend: Callable[[FaultyCell], None] = lambda cell: None
    stops: bool = True
    network: Network = "relays"
    lasts_s: float = WATCHED_S


@dataclass
class _Arm:
    """The bench's arm on the network, which follows commands and publishes its joints on a
    thread.
    """

    endpoint: str
    settings: Settings
    seed: int
    steps: list[tuple[float, ...]] = field(default_factory=list)  # time [s], tool [m], speed [m/s]

    def __post_init__(self) -> None:
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arm", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        before_others()
        with (
            Bench(HandScript(Scene(), seed=self.seed), settings=self.settings) as bench,
            open_session(connect=[self.endpoint]) as session,
            contextlib.closing(Bridge(session, Live(cell=CELL), bench.joint_names)) as bridge,
        ):
            deadlines = Deadlines(round(1 / bench.period_s))
            while not self._end.is_set():
                deadlines.wait()
                observation = bench.step(*bridge.commands.take())
                bridge.publish_joints(observation)
                self.steps.append(
                    (
                        time.monotonic(),
                        *observation.tool.position,
                        math.hypot(*observation.tool_velocity),
                    )
                )

    @property
    def speed(self) -> float:
        """Present speed of the tool [m/s]."""
        return self.steps[-1][4] if self.steps else 0.0

    def close(self) -> None:
        """End the thread."""
        self._end.set()
        self._thread.join()


class FaultyCell:
    """A running cell whose tool swings to and fro, with its files in `folder`.

    Tracker and arm reach the service each over its own relay, both over one router, or over a
    virtual cable to a network namespace. Raises FaultError, LaunchError and PartError.
    """

    def __init__(
        self,
        folder: Path,
        *,
        network: Network = "relays",
        settings: Settings | None = None,
        seed: int = Scene().seed,
    ) -> None:
        self.settings = settings or Settings()
        self.folder = folder
        self.records = folder / "records"
        self.network = network
        self.seed = seed  # of the hands
        self.commands: list[Command] = []  # commands of the service before its first restart
        self.unasked = 0  # number of faults that were not injected, caused by a busy machine
        self._parts = contextlib.ExitStack()
        self._life = contextlib.ExitStack()
        self._lives = 0

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as parts:
            if self.network == "router":
                self.router = self._part(parts, "router", "0")
            elif self.network == "link":
                self.link = parts.enter_context(contextlib.closing(Link()))
            parts.callback(self._life.close)
            self.begin_service()
            endpoint = self.service.endpoint
            if self.network == "relays":
                self.to_tracker, self.to_arm = (
                    self._part(parts, "relay", endpoint, "0") for _ in range(2)
                )
                to_tracker = self.to_tracker.endpoint
                to_arm = self.to_arm.endpoint
            else:
                to_tracker = to_arm = self.router.endpoint if self.network == "router" else endpoint
            # The operator connects to the service directly, to observe commands during faults of
            # the network.
            with as_usual_afterwards():
                self.session = parts.enter_context(open_session(connect=[self.service.endpoint]))
            self.client = Client(self.session, CELL)
            self.tracker = self._part(parts, "tracker", to_tracker, "--seed", str(self.seed))
            arm = _Arm(to_arm, self.settings, self.seed)
            self.arm = parts.enter_context(contextlib.closing(arm))
            self._listen()
            self.until_fast()
            self._parts = parts.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._parts.close()

    @staticmethod
    def _part(parts: contextlib.ExitStack, *arguments: str) -> CellPart:
        return parts.enter_context(contextlib.closing(CellPart(*arguments)))

    def begin_service(self) -> None:
        """Start the service, at its earlier endpoint if it ran before."""
        listen = f"tcp/{Link.ADDRESS if self.network == 'link' else '127.0.0.1'}:0"
        if self._lives:
            listen = self.service.endpoint
        self._lives += 1
        network = f"[network]\nlisten = [{listen!r}]\n"
        if self.network == "router":
            network += f"connect = [{self.router.endpoint!r}]\n"
        if self.network == "link":
            network += "allow_insecure = true\n"
        program = self.link.program if self.network == "link" else ("-m", "thirdhand")
        record = self.records if self._lives == 1 else self.folder / f"records-{self._lives}"
        self._life.close()
        self.service: Launched = self._life.enter_context(
            launched(
                self.folder, settings=self.settings, record=record, network=network, program=program
            )
        )

    def _listen(self) -> None:
        """Store every command that leaves the service."""

        def keep(sample: zenoh.Sample) -> None:
            if self._lives == 1 and sample.attachment is not None:
                tick = cdr.decode_attachment(sample.attachment.to_bytes()).tick
                self.commands.append((time.monotonic(), tick, sample.payload.to_bytes()))

        self.session.declare_subscriber(channels.key(CELL, "joints/command"), keep)

    def child(self, what: str) -> int:
        """The process id of the service's `scribe` or `skill worker`."""
        for path in Path(f"/proc/{self.service.process.pid}/task").glob("*/children"):
            for pid in path.read_text().split():
                if Path(f"/proc/{pid}/comm").read_text().strip() == what:
                    return int(pid)
        raise FaultError(f"no {what} was found among the children of the service")

    def until(
        self, what: Callable[[], bool], said: str, within_s: float = RESUMES_WITHIN_S
    ) -> float:
        """Wait for a condition and return the time at which it held [s]. Raises FaultError."""
        end = time.monotonic() + within_s
        while not what():
            if time.monotonic() > end:
                raise FaultError(
                    f"{said} within {within_s:g} s; the status: {self.client.status()}"
                )
            time.sleep(0.005)
        return time.monotonic()

    def until_fast(self, speed: float = FAST) -> float:
        """Wait until the tool is faster than `speed` and return the time [s]. Faults that were not
        injected are counted and reset.
        """
        end = time.monotonic() + RESUMES_WITHIN_S
        while time.monotonic() < end:
            with contextlib.suppress(FaultError, UnreachableError):
                return self.until(
                    lambda: self.arm.speed > speed,
                    "the tool was not fast",
                    within_s=SWING_TIMEOUT_S,
                )
            with contextlib.suppress(UnreachableError):
                if self.client.status().mode == "fault":
                    self.unasked += 1
                    self.client.reset()
        raise FaultError(
            f"the tool was not fast within {RESUMES_WITHIN_S:g} s: {self.client.status()}"
        )

    def suffer(self, name: str, fault: Fault) -> FaultTimes:
        """Inject a fault while the tool is fast, repair it, and return the times."""
        time.sleep(STEADY_S)
        self.until_fast()
        lost = self.client.status().scribe["lost"]
        self.until_fast()
        struck = time.monotonic()
        tick = self.commands[-1][1]
        fault.provoke(self)
        time.sleep(max(0.0, struck + fault.lasts_s - time.monotonic()))
        mended = time.monotonic()
        fault.mend(self)
        moving = self.until_fast(MOVES)
        lost = self.client.status().scribe["lost"] - lost
        return FaultTimes(name, struck, mended, moving, time.monotonic(), tick, lost)

    def close(self) -> int:
        """End the service and return its exit code."""
        return self.service.stop()
