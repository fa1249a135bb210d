"""A cell's streams for clients: a Tracker publishes hands, a Follower receives joint commands, and
a Watch yields the messages of any channel.
"""

from __future__ import annotations

import contextlib
import functools
import math
import operator
import reprlib
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Self

import zenoh

from thirdhand.client.replies import decoded
from thirdhand.client.session import (
    UnreachableError,
    check_open,
    check_process,
    subscribed,
    tried,
)
from thirdhand.contract import cdr, channels
from thirdhand.contract.messages import (
    BASE,
    JointState,
    PoseStamped,
    Quaternion,
    Vector3,
    WireError,
    finite,
    in_order,
)
from thirdhand.contract.printable import printable
from thirdhand.contract.records import SIDES
from thirdhand.contract.requests import Status

BRAKE_AFTER_S = 0.02  # a follower brakes after this time without a command
# at the lowest accepted rate, a command may be this late before the follower brakes
LATE_COMMAND_S = 0.005
MAX_QUEUED = 256  # received messages, half a second of commands at 500 Hz
CTRL_C_S = 0.5  # a wait is interrupted this often, since on Windows Ctrl-C does not end one
WATCHABLE = tuple(
    channel.key for channel in channels.CHANNELS if channel.direction in ("in", "out")
)
ENCODINGS = {"cdr": zenoh.Encoding.APPLICATION_CDR, "json": zenoh.Encoding.APPLICATION_JSON}
MAX_STAMP_NS = 2**31 * 1_000_000_000  # the seconds of a message have 32 bits with a sign
MAX_FRAME_LETTERS = 64
FRAME = f"a name of up to {MAX_FRAME_LETTERS} printable letters, or an empty one,"
LONGEST_WAIT_S = 1e6  # duration that a program may give, ten days
UNTURNED: Quaternion = (0.0, 0.0, 0.0, 1.0)


def no_room_to_brake(tick_s: float) -> str:
    """A message for commands of a period [s] that a follower cannot follow; empty if it can."""
    if tick_s <= (max_tick_s := BRAKE_AFTER_S - LATE_COMMAND_S):
        return ""
    return (
        f"{1 / tick_s:.0f} Hz is too slow: commands would arrive every {1000 * tick_s:.0f} ms, and "
        f"an arm brakes {1000 * BRAKE_AFTER_S:.0f} ms after its last command; "
        f"{math.ceil(1 / max_tick_s)} Hz or more needed"
    )


def encoded_joints(
    stamp_ns: int, names: Sequence[str], position: Sequence[float], velocity: Sequence[float]
) -> bytes:
    """A message with joints [rad, rad/s]; velocities may be empty. Raises ValueError unless there
    is one number for each joint.
    """
    try:
        state = JointState(stamp_ns, tuple(names), tuple(position), tuple(velocity))
        if len(state.position) != len(state.names) or len(state.velocity) not in (
            0,
            len(state.names),
        ):
            raise TypeError
        return cdr.encode_joints(state)
    except (struct.error, TypeError, OverflowError, AttributeError):
        raise ValueError(
            f"{reprlib.repr(position)} and {reprlib.repr(velocity)} given; positions and "
            f"velocities of {len(names)} joints needed"
        ) from None


class Publisher:
    """A publisher on one channel of a cell; messages that cannot be sent at once are dropped.

    Each message carries its publisher's identity and its number (Zenoh's SourceInfo). Raises
    UnreachableError if the session is closed.
    """

    def __init__(self, session: zenoh.Session, cell: str, suffix: str, **more: Any) -> None:
        check_open(session)
        self._session = session
        self._number = 0
        self.channel = channels.BY_KEY[suffix]
        self.zenoh = session.declare_publisher(
            channels.key(cell, suffix),
            encoding=ENCODINGS[self.channel.codec.encoding],
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
            **more,
        )
        self.key = str(self.zenoh.key_expr)
        self._id = self.zenoh.id

    def put(self, message: bytes) -> None:
        """Publish a message. Raises UnreachableError if another thread closes the session."""
        source = zenoh.SourceInfo(self._id, self._number % channels.MESSAGE_NUMBERS)
        self._number += 1
        try:
            self.zenoh.put(message, source_info=source)
        except (zenoh.ZError, RuntimeError):
            check_open(self._session)
            raise

    @property
    def is_heard(self) -> bool:
        """True if it has a subscriber."""
        return bool(self.zenoh.matching_status.matching)  # type: ignore[attr-defined]

    def close(self) -> None:
        """End the publisher."""
        self.zenoh.undeclare()  # type: ignore[no-untyped-call]


def check_heard(*publishers: Publisher) -> None:
    """Raise UnreachableError if one of these publishers has no subscriber."""
    for publisher in publishers:
        if not publisher.is_heard:
            setting = publisher.channel.condition
            raise UnreachableError(
                f"nobody listens to {publisher.key}: is a daemon or `thirdhand record` running "
                f"in this cell{setting and f', with {setting}'}?"
            )


def wait_until_heard(*publishers: Publisher, timeout_s: float | None) -> None:
    """Wait up to `timeout_s` [s] until each publisher has a subscriber; None: until Ctrl-C. Raises
    UnreachableError.
    """
    tried(lambda: check_heard(*publishers), timeout_s)


def checked_stamp(stamp_ns: Any) -> int:
    """A stamp [ns since 1970] that a message can carry. Raises ValueError."""
    try:
        checked_ns = operator.index(stamp_ns)
    except TypeError:
        checked_ns = -1
    if not 0 <= checked_ns < MAX_STAMP_NS:
        needed = "whole nanoseconds since 1970 needed, like time.time_ns()"
        raise ValueError(f"stamp_ns: {reprlib.repr(stamp_ns)} given; {needed}")
    return checked_ns


def is_frame(frame_id: Any) -> bool:
    """True for the name of a frame."""
    return (
        isinstance(frame_id, str) and len(frame_id) <= MAX_FRAME_LETTERS and frame_id.isprintable()
    )


def checked_seconds(what: str, given: Any) -> float:
    """A duration [s]. Raises ValueError."""
    try:
        seconds = math.nan if isinstance(given, str | bool) else float(given)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not 0.0 <= seconds <= LONGEST_WAIT_S:
        needed = f"seconds needed, 0 to {LONGEST_WAIT_S:g}"
        raise ValueError(f"{what}: {reprlib.repr(given)} given; {needed}")
    return seconds


def checked_frame(frame_id: Any) -> None:
    """Raise ValueError for what is no name of a frame."""
    if not is_frame(frame_id):
        raise ValueError(f"frame_id: {reprlib.repr(frame_id)} given; {FRAME} needed")


class Tracker(AbstractContextManager["Tracker"]):
    """A publisher of a cell's hand poses; a context manager.

    The constructor waits up to `timeout_s` [s] until a daemon or `thirdhand record` subscribes to
    both hands; None: until Ctrl-C. Raises UnreachableError if there is no subscriber.
    """

    def __init__(
        self, session: zenoh.Session, cell: str = "thirdhand", *, timeout_s: float | None = 5.0
    ) -> None:
        self._session = session
        self._publishers = {side: Publisher(session, cell, f"hands/{side}") for side in SIDES}
        try:
            wait_until_heard(*self._publishers.values(), timeout_s=timeout_s)
        except BaseException:
            self.close()
            raise

    def publish(
        self,
        side: str,
        position: Vector3,
        orientation: Quaternion = UNTURNED,
        *,
        stamp_ns: int | None = None,
        frame_id: str = BASE,
    ) -> None:
        """Publish the pose of one hand, `left` or `right`: position [m], quaternion x y z w.

        `stamp_ns` is the time of measurement [ns since 1970]; None: now. Stamps of a hand must
        increase. Raises ValueError for another hand, and for what cannot be encoded; values are not
        checked here, but by the daemon.
        """
        if side not in self._publishers:
            raise ValueError(f"hand {side!r} given; {' or '.join(SIDES)} accepted")
        check_open(self._session)
        checked_frame(frame_id)
        pose = PoseStamped(
            time.time_ns() if stamp_ns is None else checked_stamp(stamp_ns),
            frame_id,
            position,
            orientation,
        )
        try:
            message = cdr.encode_pose(pose)
        except (struct.error, TypeError, OverflowError):
            raise ValueError(
                f"{side} hand: {reprlib.repr(position)} and {reprlib.repr(orientation)} given; a "
                "position x y z [m] and a quaternion x y z w needed"
            ) from None
        self._publishers[side].put(message)

    def heard(self) -> bool:
        """True if both hands have a subscriber."""
        return all(publisher.is_heard for publisher in self._publishers.values())

    def close(self) -> None:
        """End the publishers."""
        for publisher in self._publishers.values():
            publisher.close()

    def __exit__(self, *_: object) -> None:
        self.close()


class _Received(AbstractContextManager[Any]):
    """A queue of the newest messages on one channel. `lost` counts the messages that the network
    dropped, by the numbers that a daemon gives them, and those that a slow loop did not take.
    """

    def __init__(self, session: zenoh.Session, cell: str, suffix: str) -> None:
        # messages that cannot be decoded, and the cause of the last one
        self.rejected = 0
        self.reason = ""
        self.lost = 0
        self._newest = "", 0  # publisher and number of the newest message
        self._session = session
        self._came = threading.Condition()  # guards the queue and the flag
        self._is_closed = False
        self._wake: Callable[[], object] = bool  # wakes a program that waits asynchronously
        self._queue: deque[Any] = deque(maxlen=MAX_QUEUED)
        check_open(session)
        self._subscriber = subscribed(session, channels.key(cell, suffix), self._take)

    def close(self) -> None:
        """End the subscription, if that has not been done."""
        if self._is_closed:
            return
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        with self._came:
            self._is_closed = True
            self._came.notify_all()

    def _decoded(self, sample: zenoh.Sample) -> Any:
        """The value of a message. Raises ValueError."""
        raise NotImplementedError

    def _count_lost(self, sample: zenoh.Sample) -> None:
        """Count what is lost between the newest message and this one, which may displace one."""
        before = self.lost
        lost = int(len(self._queue) == MAX_QUEUED)
        if (info := sample.source_info) is not None:
            last_publisher, last = self._newest
            self._newest = (str(info.source_id), info.source_sn)
            if last_publisher == self._newest[0]:
                lost += (info.source_sn - last - 1) % channels.MESSAGE_NUMBERS
        self.lost += lost
        if self.lost and not before:
            key = printable(str(sample.key_expr))
            print(
                f"messages on {key} are lost: this program or its network is too slow",
                file=sys.stderr,
                flush=True,
            )

    def _take(self, sample: zenoh.Sample) -> None:
        self._count_lost(sample)
        try:
            value = self._decoded(sample)
        except ValueError as error:
            self.rejected = self.rejected + 1
            self.reason = str(error)
            return
        with self._came:
            self._queue.append(value)
            self._came.notify()
        with contextlib.suppress(RuntimeError):  # the program's event loop has ended
            self._wake()

    def __exit__(self, *_: object) -> None:
        self.close()


class Watch(_Received, Iterator[Any]):
    """An iterator over the messages of one channel, in the order of arrival, also for `async for`;
    a context manager.

    Poses have `stamp_ns`, `frame_id`, `position` [m] and `orientation`, and `tool/target` also its
    `covariance` (36 numbers); joints have `names`, `position` and `velocity`; `objects` is a tuple
    of SceneObject, `clutch` a bool, `gripper/wish` a closure from 0 to 1, and `status` a Status.

    It waits for the next message, and yields None after each `timeout_s` [s] without one; None: it
    waits on. It ends once it, or its connection, is closed. A slow loop gets the newest 256
    messages. `lost` counts the others and those that the network dropped; the first loss is also
    reported on standard error. Messages that cannot be decoded are skipped: `rejected` counts them,
    and `reason` is the cause of the last one. Raises ValueError for a channel that carries no
    messages.
    """

    def __init__(
        self, session: zenoh.Session, cell: str, suffix: str, *, timeout_s: float | None = None
    ) -> None:
        if suffix not in WATCHABLE:
            raise ValueError(f"channel {suffix!r} given; one of {', '.join(WATCHABLE)} accepted")
        decode = channels.BY_KEY[suffix].codec.decode
        self._decode = functools.partial(decoded, kind=Status) if suffix == "status" else decode
        self._timeout_s = math.inf
        if timeout_s not in (None, math.inf):
            self._timeout_s = checked_seconds("timeout_s", timeout_s)
        super().__init__(session, cell, suffix)

    def __next__(self) -> Any:
        check_process()
        end_s = time.monotonic() + self._timeout_s
        with self._came:
            while not self._queue:
                if self._is_closed or self._session.is_closed():
                    raise StopIteration
                if (left_s := end_s - time.monotonic()) <= 0:
                    return None
                self._came.wait(min(left_s, CTRL_C_S))
            return self._queue.popleft()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Any:
        import asyncio  # its import is slow, and most programs do without

        loop = asyncio.get_running_loop()
        came = asyncio.Event()
        self._wake = functools.partial(loop.call_soon_threadsafe, came.set)
        end_s = time.monotonic() + self._timeout_s
        while True:
            came.clear()
            with self._came:
                if self._queue:
                    return self._queue.popleft()
            if self._is_closed or self._session.is_closed():
                raise StopAsyncIteration
            if (left_s := end_s - time.monotonic()) <= 0:
                return None
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(came.wait(), min(left_s, CTRL_C_S))

    def _decoded(self, sample: zenoh.Sample) -> Any:
        return self._decode(sample.payload.to_bytes())


class Command(NamedTuple):
    """A joint command: position [rad] and velocity [rad/s] of the follower's joints.

    `tick` is the tick that decided it, `published_ns` the time of sending, and `hand_stamp_ns` the
    stamp of the newest hand sample that it answers. They are -1, 0 and 0 if the sender did not
    attach them.
    """

    stamp_ns: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    tick: int
    published_ns: int
    hand_stamp_ns: int


class Follower(_Received):
    """A receiver of a cell's joint commands and publisher of its joint states; a context manager.

    `names` are the arm's joints, in the order of all values here. Commands for other joints are
    ignored: `rejected` counts them, and `reason` is the cause of the last one; `lost` counts those
    that did not arrive.
    """

    def __init__(
        self, session: zenoh.Session, names: Sequence[str], cell: str = "thirdhand"
    ) -> None:
        self._names = tuple(names)
        self._state, self._guided = (
            Publisher(session, cell, f"joints/{name}") for name in ("state", "guided")
        )
        super().__init__(session, cell, "joints/command")

    def command(self, timeout_s: float = BRAKE_AFTER_S) -> Command | None:
        """The newest command that was not returned before; None after `timeout_s` [s] without a
        command: the arm must then brake.
        """
        with self._came:
            self._came.wait_for(lambda: self._queue, timeout_s)
        commands = self.commands()
        return commands[-1] if commands else None

    def commands(self) -> list[Command]:
        """All commands that were not returned before, in the order of arrival, for `Playback`."""
        with self._came:
            commands = list(self._queue)
            self._queue.clear()
        return commands

    def tell(
        self, position: Sequence[float], velocity: Sequence[float], *, stamp_ns: int | None = None
    ) -> None:
        """Publish the measured joints [rad, rad/s], stamped `stamp_ns` [ns]; None: now. Velocities
        may be empty. Raises ValueError unless there is one number for each joint.
        """
        check_open(self._session)
        now_ns = time.time_ns() if stamp_ns is None else checked_stamp(stamp_ns)
        self._state.put(encoded_joints(now_ns, self._names, position, velocity))

    def guided(self, led: bool) -> None:
        """Publish whether the arm is led by hand; while it is, with each state."""
        self._guided.put(cdr.encode_bool(led))

    def close(self) -> None:
        """End the subscription and the publishers."""
        super().close()
        self._state.close()
        self._guided.close()

    def _decoded(self, sample: zenoh.Sample) -> Command:
        message = cdr.decode_joints(sample.payload.to_bytes())
        position, velocity = in_order(message, self._names)
        if not finite(position + velocity):
            raise WireError("a joint that is not finite")
        attached = (
            (-1, 0, 0)
            if sample.attachment is None
            else cdr.decode_attachment(sample.attachment.to_bytes())
        )
        return Command(message.stamp_ns, position, velocity, *attached)
