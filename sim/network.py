"""The bench on the network: hands and joint state out, joint commands in, in real time.

A thin shell around `Bench`.
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

from service.arms.playback import Playback
from service.client import Command
from service.contract import cdr, channels, messages, requests
from service.daemon.clock import Deadlines
from sim.bench import Bench, Observation, TaskEvent, TaskEvents
from sim.observed_world import ObservedWorld
from sim.scene import Scene
from sim.script import Array

THINGS_HZ = 10
FINAL_STOP_S = 0.5  # between the last hands and the end
QUIET_S = 1.0  # without a command, after which that is said
MOST_QUEUED = 256  # commands, while the bench is held up
DRIVE_HEADROOM = 1.25  # of the arm's drives beyond what is commanded: else it could not catch up after that


class BenchError(RuntimeError):
    """The bench cannot do its work; the message says what is missing."""


class RunReport(msgspec.Struct, frozen=True, kw_only=True):
    """One run: the events, and how promptly the commands came."""

    success: bool
    events: TaskEvents
    latency_ms: requests.Percentiles  # hand published to the first command received that answers it
    answered: int  # hand samples among `hands` that a command answered
    hands: int
    commands: int
    rejected: int
    largest_gap_ms: float  # between commands received
    periods: int  # of the bench while the script ran
    skipped: int  # of them the bench itself missed
    longest_pause_ms: float  # of the bench
    begun_ns: int  # the system clock's time at which the script began
    seed: int
    scene: Scene


@dataclass(frozen=True, kw_only=True)
class Dropout:
    """A hand that is not seen for a while [s of the script]."""

    start_s: float
    lasts_s: float
    hand: Literal["left", "right"] = "left"

    def at(self, time_s: float) -> bool:
        """Whether the hand is hidden at a time of the script."""
        return self.start_s <= time_s < self.start_s + self.lasts_s


@dataclass(frozen=True, kw_only=True)
class Live:
    """How the bench appears on the network, and when it ends."""

    cell: str = "thirdhand"
    hands_hz: int = 100
    once: bool = False
    duration_s: float = math.inf
    wait_s: float = 60.0  # for the first command
    dropout: Dropout | None = None


class Commands:
    """The newest joint command, and counts over all that came. Any other thread may take."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._lock = threading.Lock()
        self._newest: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self._queue: deque[Command] = deque(maxlen=MOST_QUEUED)
        self.last_error = ""
        self.restart()

    def restart(self) -> None:
        """Count anew."""
        with self._lock:
            self.count = self.rejected = self._answered_ns = self._last_ns = 0
            self.largest_gap_ms = 0.0
            self.latencies_ms: list[float] = []
            self._since_ns = time.time_ns()

    def receive(self, sample: zenoh.Sample) -> None:
        """Keep one command. Only the first answer to each new hand stamp tells of latency."""
        now_ns, now = time.time_ns(), time.perf_counter_ns()
        try:
            message = cdr.decode_joints(sample.payload.to_bytes())
            command = messages.in_order(message, self._names)
            attachment = cdr.decode_attachment(sample.attachment.to_bytes()) if sample.attachment else None
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
        """The newest command not yet taken: position [rad] and velocity [rad/s]."""
        with self._lock:
            newest, self._newest = self._newest, None
        return newest or (None, None)

    def queued(self) -> list[Command]:
        """All commands not yet taken this way, as they came: what a `Playback` takes."""
        with self._lock:
            queued = list(self._queue)
            self._queue.clear()
        return queued


class Led:
    """The bench's arm, led as `thirdhand follow` leads a real one."""

    def __init__(self, bench: Bench, commands: Commands, gripper: Gripper) -> None:
        self._bench, self._commands, self._gripper = bench, commands, gripper
        names, joints = ("velocity", "acceleration", "jerk"), bench.observe().joints
        more = {name: tuple(DRIVE_HEADROOM * limit for limit in getattr(bench.limits, name)) for name in names}
        limits = msgspec.structs.replace(bench.limits, **more)
        self._playback = Playback(limits, joints, period_s=bench.period_s)

    def step(self, periods: int = 1) -> tuple[Observation, bool]:
        """The bench a period later, of so many that passed, and whether commands came. Raises
        BenchError where they come too slowly to be followed.
        """
        commands = self._commands.queued()
        moved = self._playback.step(commands, elapsed_s=periods * self._bench.period_s)
        if reason := self._playback.too_slow:
            raise BenchError(f"the service: {reason}")
        position, velocity = tuple(moved.position.tolist()), tuple(moved.velocity.tolist())
        return self._bench.step(position, velocity, gripper=self._gripper.newest), bool(commands)


class Gripper:
    """The newest command of the gripper: 0 open, 1 closed; None: there was none."""

    def __init__(self) -> None:
        self.newest: float | None = None

    def receive(self, sample: zenoh.Sample) -> None:
        """Keep one command; what is none is let pass, as those of the joints tell."""
        try:
            command = messages.in_order(cdr.decode_joints(sample.payload.to_bytes()), (messages.GRIPPER,))[0]
        except messages.WireError:
            return
        if messages.finite(command):
            self.newest = min(max(command[0], 0.0), 1.0)


class Bridge:
    """The bench's channels on a session: closes what it declared.

    Of an arm that is `observed` it hears; without one it tells of its own.
    """

    def __init__(
        self, session: zenoh.Session, live: Live, names: tuple[str, ...], observed: ObservedWorld | None = None
    ) -> None:
        self.commands = Commands(names)
        self.gripper = Gripper()
        self._names, self._observed = names, observed
        self.hands_sent = 0
        told = ("hands/left", "hands/right", "objects", *(() if observed else ("joints/state", "gripper/state")))
        self._publishers = {
            suffix: session.declare_publisher(
                channels.key(live.cell, suffix), congestion_control=zenoh.CongestionControl.DROP
            )
            for suffix in told
        }
        # A callback costs 20 µs on its own thread, stamps each command as it comes, and overwrites
        # the last: the newest wins.
        self._subscribers = [
            session.declare_subscriber(channels.key(live.cell, suffix), receive)
            for suffix, receive in (
                ("joints/command", self.commands.receive),
                ("gripper/command", self.gripper.receive),
                *([("joints/state", observed.receive)] if observed else ()),
            )
        ]

    def publish_joints(self, seen: Observation) -> None:
        """Send the arm's joints and its gripper, unless they are observed."""
        if self._observed:
            return
        state = messages.JointState(time.time_ns(), self._names, seen.joints, seen.joint_velocities)
        self._publishers["joints/state"].put(cdr.encode_joints(state))
        if self.gripper.newest is not None:
            fingers = messages.JointState(state.stamp_ns, (messages.GRIPPER,), (seen.gripper,), ())
            self._publishers["gripper/state"].put(cdr.encode_joints(fingers))

    def publish_hands(self, poses: Sequence[Array], *, hidden: str | None = None) -> None:
        """Send both hands with one stamp, as a tracker's frame; not the one that is hidden."""
        stamp_ns = time.time_ns()
        for hand, pose in zip(("left", "right"), poses, strict=True):
            if hand == hidden:
                continue
            values = pose.tolist()
            message = messages.PoseStamped(stamp_ns, messages.BASE, tuple(values[:3]), tuple(values[3:]))
            self._publishers[f"hands/{hand}"].put(cdr.encode_pose(message))
        self.hands_sent += 1

    def publish_things(self, bench: Bench) -> None:
        """Tell what lies on the bench, for viewers."""
        self._publishers["objects"].put(channels.BY_KEY["objects"].codec.encode(time.time_ns(), bench.things()))

    def close(self) -> None:
        """Take the channels back."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        for publisher in self._publishers.values():
            publisher.undeclare()  # type: ignore[no-untyped-call]


def run(
    bench: Bench,
    session: zenoh.Session,
    live: Live,
    *,
    stop: threading.Event,
    report: Callable[[RunReport], None],
    say: Callable[[str], None] = lambda line: print(line, file=sys.stderr, flush=True),
) -> None:
    """Play the bench in real time until `stop`, the duration's end, or the first report when only
    one is wanted. Raises BenchError.
    """
    observed = bench.world if isinstance(bench.world, ObservedWorld) else None
    bridge = Bridge(session, live, bench.joint_names, observed)
    try:
        _play(bench, bridge, live, stop=stop, report=report, say=say)
    finally:
        bridge.close()


def _play(
    bench: Bench,
    bridge: Bridge,
    live: Live,
    *,
    stop: threading.Event,
    report: Callable[[RunReport], None],
    say: Callable[[str], None],
) -> None:
    commands, key = bridge.commands, channels.key(live.cell, "joints/command")
    rate_hz = round(1.0 / bench.period_s)
    hands_every = max(1, round(rate_hz / live.hands_hz))
    things_every = max(1, round(rate_hz / THINGS_HZ))
    led = Led(bench, commands, bridge.gripper)
    deadlines, before = Deadlines(rate_hz), -1
    ready_s: float | None = None  # since when commands come and the hands wait at their start
    running, spoke_s, quiet = False, 0.0, False
    said = missed_before = sent_before = begun_ns = begun_index = longest = 0
    say(
        f"waiting for {key} (silent while the service holds for want of an arm, or is at fault: thirdhand status tells)"
    )
    while not stop.is_set():
        index = deadlines.wait()[0]
        now_s = index * bench.period_s
        if now_s >= live.duration_s:
            return
        longest = max(longest, index - before)
        (seen, commanded), before = led.step(index - before), index
        bridge.publish_joints(seen)
        if commanded:
            if quiet:
                say("commands come again")
            spoke_s, quiet = now_s, False
        elif ready_s is not None and not quiet and now_s - spoke_s > QUIET_S:
            quiet = True
            say("no commands come any more: thirdhand status tells why, and thirdhand reset ends a fault")
        if bench.tick % hands_every == 0:
            hidden = live.dropout.hand if live.dropout and running and live.dropout.at(seen.time_s) else None
            bridge.publish_hands(bench.script.sample(seen.time_s), hidden=hidden)
        if bench.tick % things_every == 0:
            bridge.publish_things(bench)

        if ready_s is None:
            if commanded:
                ready_s = now_s
                say("commands come, the arm goes to where the hands want it")
            elif now_s > live.wait_s:
                if isinstance(bench.world, ObservedWorld) and not bench.world.heard:
                    states = channels.key(live.cell, "joints/state")
                    raise BenchError(f"no arm tells its joints on {states}: start its program, or omit --hands-only")
                refused = f" ({commands.rejected} refused: {commands.last_error})" if commands.rejected else ""
                raise BenchError(
                    f"no command on {key} within {live.wait_s:g} s{refused}. Is the service running in this cell?"
                )
        elif not running:
            waited = now_s - ready_s
            if bench.settled(waited):
                bench.begin()
                commands.restart()
                running, said, missed_before, sent_before = True, 0, deadlines.missed, bridge.hands_sent
                begun_ns, begun_index, longest = time.time_ns(), index, 0
                say("the script begins")
        else:
            for name in TaskEvents.__struct_fields__[said : bench.closed]:
                say(_line(name, getattr(bench.events(), name)))
            said = bench.closed
            if bench.finished:
                report(
                    _report(
                        bench,
                        commands,
                        hands=bridge.hands_sent - sent_before,
                        periods=index - begun_index,
                        skipped=deadlines.missed - missed_before,
                        longest_pause_ms=1000 * longest * bench.period_s,
                        begun_ns=begun_ns,
                    )
                )
                if live.once:
                    _let_stop(bench, bridge, led, deadlines)
                    return
                say("the hands go back")
                bench.turn_back()
                running, ready_s = False, math.inf
        if ready_s == math.inf and bench.back:
            ready_s = now_s


def _let_stop(bench: Bench, bridge: Bridge, led: Led, deadlines: Deadlines) -> None:
    """Without hands the service stops the arm; one that vanished before that would be a fault."""
    for _ in range(round(FINAL_STOP_S / bench.period_s)):
        deadlines.wait()
        bridge.publish_joints(led.step()[0])


def _report(
    bench: Bench,
    commands: Commands,
    *,
    hands: int,
    periods: int,
    skipped: int,
    longest_pause_ms: float,
    begun_ns: int,
) -> RunReport:
    events = bench.events()
    latencies = list(commands.latencies_ms)
    percentiles = np.percentile(latencies, (50, 99, 100)).round(3).tolist() if latencies else (0.0, 0.0, 0.0)
    return RunReport(
        success=events.success,
        events=events,
        latency_ms=requests.Percentiles(*percentiles),
        answered=len(latencies),
        hands=hands,
        commands=commands.count,
        rejected=commands.rejected,
        largest_gap_ms=round(commands.largest_gap_ms, 3),
        periods=periods,
        skipped=skipped,
        longest_pause_ms=round(longest_pause_ms, 1),
        begun_ns=begun_ns,
        seed=bench.script.seed,
        scene=bench.scene,
    )


def _line(name: str, event: TaskEvent) -> str:
    return f"{name}: {event.error_mm:.1f} mm at {event.time_s:.1f} s{'' if event.reached else ', missed'}"
