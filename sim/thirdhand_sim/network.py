"""The bench on the network, in real time: it publishes hands and joint states, and receives joint
commands.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
import zenoh

from thirdhand.arms.playback import Playback
from thirdhand.client import Command, Publisher
from thirdhand.contract import cdr, channels, messages, requests
from thirdhand.contract.records import SIDES
from thirdhand.daemon.clock import Deadlines
from thirdhand_sim.bench import Bench, Observation, TaskEvent, TaskEvents
from thirdhand_sim.observed_world import ObservedWorld
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import Array
from thirdhand_sim.tracked_hands import TrackedHands

THINGS_HZ = 10
# the bench runs for this time after the last hands, so that the service can stop the arm
FINAL_STOP_S = 1.0
QUIET_S = 1.0  # a silence of commands is reported after this time
MOST_QUEUED = 256  # commands wait in a queue of this length while the bench is held up
DRIVE_HEADROOM = 1.25  # drive limits / command limits, so that the arm can catch up after a hold-up


class BenchError(RuntimeError):
    """The bench cannot run; the message has the cause."""


class RunReport(msgspec.Struct, frozen=True, kw_only=True):
    """The report of a run: its events, and the timing of commands."""

    success: bool
    events: TaskEvents
    # from a published hand to the first received command that answers it
    latency_ms: requests.Percentiles
    answered: int  # number of hand samples among `hands` that a command answered
    hands: int
    commands: int
    rejected: int
    largest_gap_ms: float  # longest time between received commands
    periods: int  # number of the bench's periods while the script ran
    skipped: int  # number of these that the bench missed
    longest_pause_ms: float  # longest pause of the bench
    begun_ns: int  # begin of the script by the system clock
    seed: int
    scene: Scene


@dataclass(frozen=True)
class Dropout:
    """A time in the script [s] in which one hand is hidden."""

    start_s: float
    lasts_s: float
    hand: Literal["left", "right"] = "left"

    def at(self, time_s: float) -> bool:
        """True if the hand is hidden at a time of the script [s]."""
        return self.start_s <= time_s < self.start_s + self.lasts_s


@dataclass(frozen=True, kw_only=True)
class Live:
    """The bench's settings on the network, and its end."""

    cell: str = "thirdhand"
    hands_hz: int = 100
    once: bool = False
    duration_s: float = math.inf
    wait_s: float = 60.0  # timeout of the first command, and of the first tracked hands
    dropout: Dropout | None = None


class Commands:
    """The newest joint command, and statistics of all received ones. For any thread."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._lock = threading.Lock()
        self._newest: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self._queue: deque[Command] = deque(maxlen=MOST_QUEUED)
        self.last_error = ""
        self.restart()

    def restart(self) -> None:
        """Reset the statistics."""
        with self._lock:
            self.count = self.rejected = self._answered_ns = self._last_ns = 0
            self.largest_gap_ms = 0.0
            self.latencies_ms: list[float] = []
            self._since_ns = time.time_ns()

    def receive(self, sample: zenoh.Sample) -> None:
        """Store a command. Its latency counts only for the first answer to each hand stamp."""
        now_ns = time.time_ns()
        now = time.perf_counter_ns()
        try:
            message = cdr.decode_joints(sample.payload.to_bytes())
            command = messages.in_order(message, self._names)
            attachment = (
                cdr.decode_attachment(sample.attachment.to_bytes()) if sample.attachment else None
            )
            if not messages.finite(command[0] + command[1]):
                raise messages.WireError("a joint that is not finite")
        except messages.WireError as error:
            with self._lock:
                self.rejected += 1
                self.last_error = str(error)
            return
        with self._lock:
            self._newest = command
            self._queue.append(Command(message.stamp_ns, *command, *(attachment or (-1, 0, 0))))
            self.count += 1
            if self._last_ns:
                self.largest_gap_ms = max(self.largest_gap_ms, (now - self._last_ns) / 1e6)
            self._last_ns = now
            if attachment and attachment.hand_stamp_ns > max(self._answered_ns, self._since_ns):
                self._answered_ns = attachment.hand_stamp_ns
                self.latencies_ms.append((now_ns - attachment.hand_stamp_ns) / 1e6)

    def take(self) -> tuple[tuple[float, ...], tuple[float, ...]] | tuple[None, None]:
        """The newest command, position [rad] and velocity [rad/s], if it was not taken before."""
        with self._lock:
            newest = self._newest
            self._newest = None
        return newest or (None, None)

    def queued(self) -> list[Command]:
        """All commands since the last call, in the order of arrival, for `Playback`."""
        with self._lock:
            queued = list(self._queue)
            self._queue.clear()
        return queued


class Led:
    """The bench's arm, driven like a real one by `thirdhand follow`."""

    def __init__(self, bench: Bench, commands: Commands, gripper: Gripper) -> None:
        self._bench = bench
        self._commands = commands
        self._gripper = gripper
        names = ("velocity", "acceleration", "jerk")
        joints = bench.observe().joints
        more = {
            name: tuple(DRIVE_HEADROOM * limit for limit in getattr(bench.limits, name))
            for name in names
        }
        limits = msgspec.structs.replace(bench.limits, **more)
        self._playback = Playback(limits, joints, period_s=bench.period_s)

    def step(self, periods: int = 1) -> tuple[Observation, bool]:
        """Advance the bench by one period, `periods` after the last step. Returns the observation,
        and True if commands arrived. Raises BenchError if they arrive too slowly to be followed.
        """
        commands = self._commands.queued()
        moved = self._playback.step(commands, elapsed_s=periods * self._bench.period_s)
        if reason := self._playback.too_slow:
            raise BenchError(f"the service: {reason}")
        position = tuple(moved.position.tolist())
        velocity = tuple(moved.velocity.tolist())
        return self._bench.step(position, velocity, gripper=self._gripper.newest), bool(commands)


class Gripper:
    """The newest command of the gripper, 0 open to 1 closed; None before the first."""

    def __init__(self) -> None:
        self.newest: float | None = None

    def receive(self, sample: zenoh.Sample) -> None:
        """Store a command. Unreadable ones are ignored."""
        try:
            command = messages.in_order(
                cdr.decode_joints(sample.payload.to_bytes()), (messages.GRIPPER,)
            )[0]
        except messages.WireError:
            return
        if messages.finite(command):
            self.newest = min(max(command[0], 0.0), 1.0)


class Bridge:
    """The bench's channels on a session.

    It receives the joint states of an `observed` arm, or else publishes those of the simulated arm.
    It receives the hands if they are `tracked`, or else publishes them.
    """

    def __init__(
        self,
        session: zenoh.Session,
        live: Live,
        names: tuple[str, ...],
        *,
        observed: ObservedWorld | None = None,
        tracked: TrackedHands | None = None,
    ) -> None:
        self.commands = Commands(names)
        self.gripper = Gripper()
        self._names = names
        self._observed = observed
        self._tracked = tracked
        self.hands_sent = 0  # samples of both hands, published or received
        hands = tuple(f"hands/{side}" for side in SIDES)
        arm = ("joints/state", "gripper/state")
        suffixes = ("objects", *(() if tracked else hands), *(() if observed else arm))
        self._publishers = {suffix: Publisher(session, live.cell, suffix) for suffix in suffixes}
        # Callbacks run on another thread for 20 µs and note the time of arrival of each command.
        self._subscribers = [
            session.declare_subscriber(channels.key(live.cell, suffix), receive)
            for suffix, receive in (
                ("joints/command", self.commands.receive),
                ("gripper/command", self.gripper.receive),
                *([("joints/state", observed.receive)] if observed else ()),
                *([(suffix, self._receive_hand) for suffix in hands] if tracked else ()),
            )
        ]

    def _receive_hand(self, sample: zenoh.Sample) -> None:
        """Store the pose of a tracked hand. The service reports unreadable ones."""
        assert self._tracked is not None
        try:
            pose = cdr.decode_pose(sample.payload.to_bytes())
        except messages.WireError:
            return
        side = str(sample.key_expr).rpartition("/")[2]
        if messages.finite(pose.position):
            self._tracked.receive(side, pose)
            self.hands_sent += side == SIDES[-1]

    def publish_joints(self, seen: Observation) -> None:
        """Publish the arm's joints and gripper, unless the arm is observed."""
        if self._observed:
            return
        state = messages.JointState(time.time_ns(), self._names, seen.joints, seen.joint_velocities)
        self._publishers["joints/state"].put(cdr.encode_joints(state))
        if self.gripper.newest is not None:
            fingers = messages.JointState(state.stamp_ns, (messages.GRIPPER,), (seen.gripper,), ())
            self._publishers["gripper/state"].put(cdr.encode_joints(fingers))

    def publish_hands(self, poses: Sequence[Array], *, hidden: str | None = None) -> None:
        """Publish both hands with one stamp, except a hidden one, unless they are tracked."""
        if self._tracked:
            return
        stamp_ns = time.time_ns()
        for hand, pose in zip(SIDES, poses, strict=True):
            if hand == hidden:
                continue
            values = pose.tolist()
            message = messages.PoseStamped(
                stamp_ns, messages.BASE, tuple(values[:3]), tuple(values[3:])
            )
            self._publishers[f"hands/{hand}"].put(cdr.encode_pose(message))
        self.hands_sent += 1

    def publish_things(self, bench: Bench) -> None:
        """Publish the things on the bench for viewers."""
        self._publishers["objects"].put(
            channels.BY_KEY["objects"].codec.encode(time.time_ns(), bench.things())
        )

    def close(self) -> None:
        """Undeclare the channels."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        for publisher in self._publishers.values():
            publisher.close()


def run(
    bench: Bench,
    session: zenoh.Session,
    live: Live,
    *,
    stop: threading.Event,
    report: Callable[[RunReport], None],
    say: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
) -> None:
    """Run the bench in real time until `stop`, until the end of its duration, or with `live.once`
    until the first report. Raises BenchError.
    """
    observed = bench.world if isinstance(bench.world, ObservedWorld) else None
    tracked = bench.script if isinstance(bench.script, TrackedHands) else None
    bridge = Bridge(session, live, bench.joint_names, observed=observed, tracked=tracked)
    try:
        _Run(bench, bridge, live, tracked, report=report, say=say).play(stop)
    finally:
        bridge.close()


class _Run:
    """The bench in real time: the arm moves to its target, the script runs, the hands move back."""

    def __init__(
        self,
        bench: Bench,
        bridge: Bridge,
        live: Live,
        tracked: TrackedHands | None,
        *,
        report: Callable[[RunReport], None],
        say: Callable[[str], None],
    ) -> None:
        self._bench = bench
        self._bridge = bridge
        self._live = live
        self._tracked = tracked
        self._report = report
        self._say = say
        rate_hz = round(1.0 / bench.period_s)
        self._hands_every = max(1, round(rate_hz / live.hands_hz))
        self._things_every = max(1, round(rate_hz / THINGS_HZ))
        self._led = Led(bench, bridge.commands, bridge.gripper)
        self._deadlines = Deadlines(rate_hz)
        self._key = channels.key(live.cell, "joints/command")

        self._index = -1  # number of the newest period
        # time from which commands arrive and the hands wait at their start
        self._ready_s: float | None = None
        self._is_running = False  # the script runs
        self._commanded_s = 0.0
        self._is_quiet = False  # missing commands were reported
        self._is_asked = False  # the hands were asked for
        self._announced = 0  # events of this run that were reported
        self._longest_pause = 0  # periods
        self._begun_ns = self._begun_index = self._begun_missed = self._begun_hands = 0

    def play(self, stop: threading.Event) -> None:
        """Run until `stop`, or as long as `Live` says. Raises BenchError."""
        self._say(
            f"waiting for {self._key} (the service sends none without an arm, or in a fault: see "
            "thirdhand status)"
        )
        while not stop.is_set():
            index = self._deadlines.wait()[0]
            now_s = index * self._bench.period_s
            if now_s >= self._live.duration_s:
                return
            self._longest_pause = max(self._longest_pause, index - self._index)
            observation, commanded = self._led.step(index - self._index)
            self._index = index
            self._bridge.publish_joints(observation)
            self._note_commands(commanded, now_s)
            self._publish(observation)
            if self._advance(commanded, now_s):
                self._let_stop()
                return
            if self._ready_s == math.inf and self._bench.back:
                self._ready_s = now_s
        if self._tracked and self._is_running:  # the person has ended the task
            self._report(self._reported())
            self._let_stop()

    def _note_commands(self, commanded: bool, now_s: float) -> None:
        """Report that commands end, and that they arrive again."""
        if commanded:
            if self._is_quiet:
                self._say("commands arrive again")
            self._commanded_s = now_s
            self._is_quiet = False
        elif (
            self._ready_s is not None and not self._is_quiet and now_s - self._commanded_s > QUIET_S
        ):
            self._is_quiet = True
            self._say(
                "no commands arrive: thirdhand status shows the cause, and thirdhand reset ends a "
                "fault"
            )

    def _publish(self, seen: Observation) -> None:
        """Publish hands and things, each at its rate."""
        dropout = self._live.dropout
        if self._bench.tick % self._hands_every == 0:
            is_hidden = dropout is not None and self._is_running and dropout.at(seen.time_s)
            hidden = dropout.hand if dropout is not None and is_hidden else None
            self._bridge.publish_hands(self._bench.script.sample(seen.time_s), hidden=hidden)
        if self._bench.tick % self._things_every == 0:
            self._bridge.publish_things(self._bench)

    def _advance(self, commanded: bool, now_s: float) -> bool:
        """Go on with the run; true if it was the only one, and has ended."""
        if self._ready_s is None:
            self._wait_for_commands(commanded, now_s)
        elif not self._is_running:
            self._wait_for_hands(now_s - self._ready_s)
        else:
            for name in TaskEvents.__struct_fields__[self._announced : self._bench.closed]:
                self._say(_line(name, getattr(self._bench.events(), name)))
            self._announced = self._bench.closed
            if self._bench.finished:
                self._report(self._reported())
                if self._live.once:
                    return True
                self._say("the hands move back")
                self._bench.turn_back()
                self._is_running = False
                self._ready_s = math.inf
        return False

    def _wait_for_commands(self, commanded: bool, now_s: float) -> None:
        commands = self._bridge.commands
        if commanded:
            self._ready_s = now_s
            self._say("commands arrive, the arm moves to its target")
        elif now_s > self._live.wait_s:
            if isinstance(self._bench.world, ObservedWorld) and not self._bench.world.heard:
                states = channels.key(self._live.cell, "joints/state")
                raise BenchError(
                    f"no joint states arrive on {states}: start the arm's program, or omit "
                    "--hands-only"
                )
            refused = (
                f" ({commands.rejected} refused: {commands.last_error})"
                if commands.rejected
                else ""
            )
            raise BenchError(
                f"no command on {self._key} within {self._live.wait_s:g} s{refused}. "
                "Is the service running in this cell?"
            )

    def _wait_for_hands(self, waited_s: float) -> None:
        """Begin the script once the hands are ready and the arm has settled."""
        tracked = self._tracked
        if tracked and not self._is_asked and (tracked.foreign or not tracked.ready):
            self._is_asked = True
            self._say(f"waiting for both hands{tracked.refusal}")
        is_ready = self._bench.script.ready
        if not is_ready and waited_s > self._live.wait_s:
            refusal = tracked.refusal if tracked else ""
            raise BenchError(f"no hands arrived within {self._live.wait_s:g} s{refusal}")
        if is_ready and self._bench.settled(waited_s):
            self._bench.begin()
            self._bridge.commands.restart()
            self._is_running = True
            self._announced = self._longest_pause = 0
            self._begun_missed = self._deadlines.missed
            self._begun_hands = self._bridge.hands_sent
            self._begun_index = self._index
            self._begun_ns = time.time_ns()
            self._say("the script begins")

    def _let_stop(self) -> None:
        """Run without hands until the service has stopped the arm: an arm that disappears while it
        moves is a fault.
        """
        for _ in range(round(FINAL_STOP_S / self._bench.period_s)):
            self._deadlines.wait()
            self._bridge.publish_joints(self._led.step()[0])

    def _reported(self) -> RunReport:
        """The report of the run since the script began."""
        commands = self._bridge.commands
        events = self._bench.events()
        latencies = list(commands.latencies_ms)
        percentiles = (
            np.percentile(latencies, (50, 99, 100)).round(3).tolist()
            if latencies
            else (0.0, 0.0, 0.0)
        )
        return RunReport(
            success=events.success,
            events=events,
            latency_ms=requests.Percentiles(*percentiles),
            answered=len(latencies),
            hands=self._bridge.hands_sent - self._begun_hands,
            commands=commands.count,
            rejected=commands.rejected,
            largest_gap_ms=round(commands.largest_gap_ms, 3),
            periods=self._index - self._begun_index,
            skipped=self._deadlines.missed - self._begun_missed,
            longest_pause_ms=round(1000 * self._longest_pause * self._bench.period_s, 1),
            begun_ns=self._begun_ns,
            seed=self._bench.script.seed,
            scene=self._bench.scene,
        )


def _line(name: str, event: TaskEvent) -> str:
    if math.isinf(event.error_mm):
        return f"{name}: the hands were never at its places"
    return (
        f"{name}: {event.error_mm:.1f} mm at {event.time_s:.1f} "
        f"s{'' if event.reached else ', missed'}"
    )
