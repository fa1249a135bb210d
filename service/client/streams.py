"""A cell's streams for clients: a Tracker publishes hands, a Follower receives joint commands."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import zenoh

from service.client.session import UnreachableError, tried
from service.contract import cdr, channels
from service.contract.messages import BASE, JointState, PoseStamped, Quaternion, Vector3, WireError, finite, in_order
from service.contract.records import SIDES

BRAKE_AFTER_S = 0.02  # a follower brakes after this time without a command
LATE_COMMAND_S = 0.005  # at the lowest accepted rate, a command may be this late before the follower brakes
MAX_COMMANDS = 256  # a follower queues this many, half a second of them at 500 Hz
ENCODINGS = {"cdr": zenoh.Encoding.APPLICATION_CDR, "json": zenoh.Encoding.APPLICATION_JSON}
UNTURNED: Quaternion = (0.0, 0.0, 0.0, 1.0)


def no_room_to_brake(tick_s: float) -> str:
    """A message for commands of a period [s] that a follower cannot follow; empty if it can."""
    if tick_s <= (max_tick_s := BRAKE_AFTER_S - LATE_COMMAND_S):
        return ""
    return (
        f"{1 / tick_s:.0f} Hz is too slow: commands would arrive every {1000 * tick_s:.0f} ms, and an arm brakes "
        f"{1000 * BRAKE_AFTER_S:.0f} ms after its last command; {math.ceil(1 / max_tick_s)} Hz or more needed"
    )


def publisher(session: zenoh.Session, cell: str, suffix: str, **more: Any) -> zenoh.Publisher:
    """A publisher on one channel of a cell; messages that cannot be sent at once are dropped."""
    return session.declare_publisher(
        channels.key(cell, suffix),
        encoding=ENCODINGS[channels.BY_KEY[suffix].codec.encoding],
        congestion_control=zenoh.CongestionControl.DROP,
        **more,
    )


class Tracker(AbstractContextManager["Tracker"]):
    """A publisher of a cell's hand poses; a context.

    The constructor waits up to `timeout_s` [s] until a daemon or `thirdhand record` subscribes to
    both hands; None: until Ctrl-C. Raises UnreachableError if there is no subscriber.
    """

    def __init__(self, session: zenoh.Session, cell: str = "thirdhand", *, timeout_s: float | None = 5.0) -> None:
        self._cell = cell
        self._publishers = {side: publisher(session, cell, f"hands/{side}", express=True) for side in SIDES}
        try:
            tried(self._check_heard, timeout_s)
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
        increase. Raises ValueError for another hand.
        """
        if side not in self._publishers:
            raise ValueError(f"hand {side!r} given; {' or '.join(SIDES)} accepted")
        pose = PoseStamped(time.time_ns() if stamp_ns is None else stamp_ns, frame_id, position, orientation)
        self._publishers[side].put(cdr.encode_pose(pose))

    def heard(self) -> bool:
        """True if both hands have a subscriber."""
        return all(
            publisher.matching_status.matching  # type: ignore[attr-defined]
            for publisher in self._publishers.values()
        )

    def _check_heard(self) -> None:
        if not self.heard():
            raise UnreachableError(
                f"nobody listens to {channels.key(self._cell, 'hands/left')}: is a daemon or `thirdhand record` "
                "running in this cell?"
            )

    def close(self) -> None:
        """End the publishers."""
        for one in self._publishers.values():
            one.undeclare()  # type: ignore[no-untyped-call]

    def __exit__(self, *_: object) -> None:
        self.close()


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


class Follower(AbstractContextManager["Follower"]):
    """A receiver of a cell's joint commands and publisher of its joint states; a context.

    `names` are the arm's joints, in the order of all values here. Commands for other joints are
    ignored: `rejected` counts them, and `reason` is the cause of the last one.
    """

    def __init__(self, session: zenoh.Session, names: Sequence[str], cell: str = "thirdhand") -> None:
        self.rejected, self.reason = 0, ""
        self._names = tuple(names)
        self._came = threading.Condition()
        self._queue: deque[Command] = deque(maxlen=MAX_COMMANDS)
        self._state = publisher(session, cell, "joints/state", express=True)
        self._subscriber = session.declare_subscriber(channels.key(cell, "joints/command"), self._take)

    def command(self, timeout_s: float = BRAKE_AFTER_S) -> Command | None:
        """The newest command that was not returned before; None after `timeout_s` [s] without a
        command, whereupon the arm must brake.
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

    def tell(self, position: Sequence[float], velocity: Sequence[float], *, stamp_ns: int | None = None) -> None:
        """Publish the measured joints [rad, rad/s], stamped `stamp_ns` [ns]; None: now."""
        now_ns = time.time_ns() if stamp_ns is None else stamp_ns
        self._state.put(cdr.encode_joints(JointState(now_ns, self._names, tuple(position), tuple(velocity))))

    def close(self) -> None:
        """End the subscription and the publisher."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._state.undeclare()  # type: ignore[no-untyped-call]

    def _take(self, sample: zenoh.Sample) -> None:
        try:
            message = cdr.decode_joints(sample.payload.to_bytes())
            position, velocity = in_order(message, self._names)
            if not finite(position + velocity):
                raise WireError("a joint that is not finite")
            attached = (-1, 0, 0) if sample.attachment is None else cdr.decode_attachment(sample.attachment.to_bytes())
        except WireError as error:
            self.rejected, self.reason = self.rejected + 1, str(error)
            return
        with self._came:
            self._queue.append(Command(message.stamp_ns, position, velocity, *attached))
            self._came.notify()

    def __exit__(self, *_: object) -> None:
        self.close()
