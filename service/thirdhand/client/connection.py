"""A connection to a cell: its requests as calls, and its streams, for programs of a few lines."""

from __future__ import annotations

import atexit
import itertools
import math
import reprlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import zenoh

from thirdhand.client.calls import Client, via_point
from thirdhand.client.client_settings import client_settings
from thirdhand.client.session import check_open, is_forked
from thirdhand.client.streams import (
    UNTURNED,
    Publisher,
    Watch,
    check_heard,
    checked_frame,
    checked_seconds,
    checked_stamp,
    encoded_joints,
    wait_until_heard,
)
from thirdhand.contract import cdr, markers
from thirdhand.contract.messages import (
    BASE,
    GRIPPER,
    JointState,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    SceneObject,
    Vector3,
    finite,
)
from thirdhand.contract.requests import ANSWER_TIMEOUT_S, REQUEST_NORM_TOLERANCE, Reply

LARGEST_STD = 1e3  # [m, rad]
# The first message on a channel waits this long for a subscriber. If the subscriber disappears, a
# call raises an error only after this time, as a daemon may restart.
LISTENER_TIMEOUT_S = 5.0
FORMS = {  # by the largest count of numbers
    1: "0 (open) to 1 (closed)",
    2: "a deviation [m] and one [rad]",
    3: "x y z [m]",
    4: "x y z w, or red, green, blue and opacity,",
    7: "x y z [m], or x y z and a quaternion x y z w,",
}


def connect(
    endpoint: str | Sequence[str] | None = None,
    *,
    cell: str | None = None,
    certificate: str | Path | None = None,
    zenoh_config: str | Path | None = None,
    timeout_s: float | None = 10.0,
) -> Connection:
    """A connection to a cell; a context manager. It is closed at the latest as the program ends.

    Arguments that are None are taken from the environment, the client's file or the defaults, see
    `client_settings`. Connecting is tried for `timeout_s` [s]; None: until Ctrl-C. Raises
    UnreachableError, and SettingsError for settings that cannot be used.
    """
    endpoints = [endpoint] if isinstance(endpoint, str) else endpoint
    settings = client_settings(
        connect=endpoints, cell=cell, certificate=certificate, zenoh_config=zenoh_config
    )
    connection = Connection(settings.session(timeout_s=timeout_s), settings.cell)
    atexit.register(connection.close)
    return connection


class Connection(Client, AbstractContextManager["Connection"]):
    """A cell's streams, and all requests of a `Client`, over one Zenoh session; a context manager.

    A pose is three numbers, the position x y z [m], or seven, followed by the quaternion x y z w.
    `stamp_ns` is the time of measurement [ns since 1970]; None: now. Stamps of one channel must
    increase. The first message on a channel waits up to 5 s until somebody listens to it. `close`
    closes the session.

    Each publishing call raises ValueError, before anything is sent, for values of another form or
    not finite; the daemon checks frame, distance and time. It raises UnreachableError if nobody
    listens, and nobody did in the last 5 s.
    """

    def __init__(
        self,
        session: zenoh.Session,
        cell: str = "thirdhand",
        *,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> None:
        super().__init__(session, cell, timeout_s=timeout_s)
        self._publishers: dict[str, Publisher] = {}
        self._heard_s: dict[str, float] = {}  # by channel, when a call last found a subscriber

    @property
    def session(self) -> zenoh.Session:
        """The Zenoh session, for a `Follower` or for keys of your own."""
        return self._session

    def hands(
        self,
        *,
        left: Sequence[float] | None = None,
        right: Sequence[float] | None = None,
        stamp_ns: int | None = None,
        frame_id: str = BASE,
    ) -> None:
        """Publish the poses of the hands that the tracker sees now, in its frame."""
        arguments = {"left": left, "right": right}
        poses = {
            f"hands/{side}": checked_pose(side, pose)
            for side, pose in arguments.items()
            if pose is not None
        }
        if not poses:
            raise ValueError("no hand given; left, right or both needed")
        self._publish(
            {suffix: _encoded(frame_id, *pose) for suffix, pose in poses.items()}, stamp_ns
        )

    def tool(
        self, pose: Sequence[float], *, stamp_ns: int | None = None, frame_id: str = BASE
    ) -> None:
        """Publish the measured pose of the tool, for demonstrations."""
        self._publish({"tool/pose": _encoded(frame_id, *checked_pose("tool", pose))}, stamp_ns)

    def gripper(self, closure: float, *, stamp_ns: int | None = None) -> None:
        """Publish the measured closure of the gripper, 0 (open) to 1 (closed), for
        demonstrations.
        """
        self._publish_closure("gripper/state", closure, stamp_ns)

    def clutch(self, pressed: bool) -> None:
        """Publish that the clutch is pressed, or released. While it is pressed, call this at 10 Hz
        or more.
        """
        self._publish_bool("clutch", pressed)

    def joints(
        self,
        names: Sequence[str],
        position: Sequence[float],
        velocity: Sequence[float] = (),
        *,
        stamp_ns: int | None = None,
    ) -> None:
        """Publish the measured joints [rad, rad/s; m, m/s if prismatic] of an arm that is led or
        that a program of its own moves. An arm that follows this cell uses a `Follower`.
        """
        encoded_joints(0, names, position, velocity)  # raises before anything is sent
        numbers = (*position, *velocity)
        if not finite(numbers) or any(isinstance(number, bool) for number in numbers):
            raise ValueError(
                f"joints: {list(position)} and {list(velocity)} given; finite numbers needed"
            )
        self._publish(
            {"joints/state": lambda ns: encoded_joints(ns, names, position, velocity)}, stamp_ns
        )

    def guided(self, led: bool) -> None:
        """Publish that somebody leads the arm by hand, or no longer does. While it is led, call
        this with each joint state.
        """
        self._publish_bool("joints/guided", led)

    def wish_gripper(self, closure: float, *, stamp_ns: int | None = None) -> None:
        """Publish how far a person wants the gripper closed, 0 (open) to 1 (closed)."""
        self._publish_closure("gripper/wish", closure, stamp_ns)

    def wish(
        self,
        pose: Sequence[float],
        *,
        stamp_ns: int | None = None,
        std: tuple[float, float] | None = None,
        frame_id: str = BASE,
    ) -> None:
        """Publish where a policy wants the tool, x y z [m] and a quaternion x y z w, at the time
        `stamp_ns`; None: now. `std` is the
        deviation of each axis [m] and of each small rotation [rad]; None: not known.
        """
        self._publish({"tool/wish": _wish(pose, std, frame_id)}, stamp_ns)

    def wish_chunk(
        self,
        poses: Iterable[Sequence[float]],
        *,
        step_s: float,
        stamp_ns: int | None = None,
        std: tuple[float, float] | None = None,
        frame_id: str = BASE,
    ) -> None:
        """Publish a policy's answer: the poses of the tool from the time `stamp_ns` on, `step_s`
        [s] apart; None: from now on. For a policy that answers late, that is the time of its
        observation. It takes the place of an earlier chunk as long as it lasts; what that one has
        for later stays.
        """
        chunk = [_wish(pose, std, frame_id) for pose in _listed("poses", poses, "a list")]
        if not chunk:
            raise ValueError("poses: none given; at least one needed")
        step_ns = 1e9 * checked_seconds("step_s", step_s)
        if not step_ns:
            raise ValueError(f"step_s: {step_s!r} given; a duration above 0 s needed")
        if stamp_ns:
            checked_stamp(checked_stamp(stamp_ns) + round((len(chunk) - 1) * step_ns))
        else:
            check_open(self._session)
            self._heard("tool/wish")
            stamp_ns = time.time_ns()
        for i, encode in enumerate(chunk):
            self._publish({"tool/wish": encode}, stamp_ns + round(i * step_ns))

    def objects(self, objects: Iterable[SceneObject], *, stamp_ns: int | None = None) -> None:
        """Publish all objects on the bench, for viewers and recordings."""
        scene = _listed("objects", objects, "SceneObjects")
        for scene_object in scene:
            _check_object(scene_object)
        # raises the error that the daemon would report of all together
        markers.decode_objects(markers.encode_objects(0, scene))
        self._publish({"objects": lambda ns: markers.encode_objects(ns, scene)}, stamp_ns)

    def watch(self, suffix: str, *, timeout_s: float | None = None) -> Watch:
        """An iterator over the messages of a channel: `tool/target`, `joints/command`, `status`.

        It yields None after `timeout_s` [s] without a message; if `timeout_s` is None, it waits. To
        the daemon, a program that watches `joints/command` is the arm's driver.
        """
        return Watch(self._session, self._cell, suffix, timeout_s=timeout_s)

    def teach(
        self,
        name: str,
        *,
        left: Sequence[float],
        right: Sequence[float],
        tool: Sequence[float],
        **more: Any,
    ) -> Reply:
        """Teach one via-point: the tool's position [m] that belongs to these positions of the
        hands. `more` are further fields of `ViaPoint`. Returns once it is in force.
        """
        fields = {
            "name": name,
            "left": _numbers("left", left, 3),
            "right": _numbers("right", right, 3),
            "tool": _numbers("tool", tool, 3),
            **more,
        }
        return self.add([via_point(fields)])

    def close(self) -> None:
        """Close the session, with all that was opened on it."""
        atexit.unregister(self.close)
        if not is_forked():
            self._session.close()  # type: ignore[no-untyped-call]

    def __exit__(self, *_: object) -> None:
        self.close()

    def _publish_bool(self, suffix: str, value: bool) -> None:
        if not isinstance(value, bool):
            raise ValueError(
                f"{suffix.removeprefix('joints/')}: {value!r} given; True or False needed"
            )
        self._publish({suffix: lambda _: cdr.encode_bool(value)}, None)

    def _publish_closure(self, suffix: str, closure: float, stamp_ns: int | None) -> None:
        (value,) = _numbers("closure", [closure], 1)
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"closure: {closure} given; {FORMS[1]} needed")
        self._publish(
            {suffix: lambda ns: cdr.encode_joints(JointState(ns, (GRIPPER,), (value,), ()))},
            stamp_ns,
        )

    def _publish(self, messages: dict[str, Callable[[int], bytes]], stamp_ns: int | None) -> None:
        """Publish messages that are encoded for a stamp [ns]; None: the time when all of them are
        heard. With a time before that wait, later samples would seem to arrive too early.
        """
        if stamp_ns is not None:
            stamp_ns = checked_stamp(stamp_ns)
        check_open(self._session)
        publishers = [self._heard(suffix) for suffix in messages]
        stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
        for publisher, encode in zip(publishers, messages.values(), strict=True):
            publisher.put(encode(stamp_ns))

    def _heard(self, suffix: str) -> Publisher:
        """The publisher on a channel, once somebody listens. Raises UnreachableError."""
        if (cached := self._publishers.get(suffix)) is not None:
            if cached.is_heard:
                self._heard_s[suffix] = time.monotonic()
            elif time.monotonic() - self._heard_s[suffix] > LISTENER_TIMEOUT_S:
                check_heard(cached)
            return cached
        publisher = Publisher(self._session, self._cell, suffix)
        try:
            wait_until_heard(publisher, timeout_s=LISTENER_TIMEOUT_S)
        except BaseException:
            publisher.close()
            raise
        self._heard_s[suffix] = time.monotonic()
        return self._publishers.setdefault(suffix, publisher)


def _listed(what: str, given: Iterable[Any], needed: str) -> tuple[Any, ...]:
    """The members of what was given. Raises ValueError."""
    try:
        return tuple(given)
    except TypeError:
        raise ValueError(f"{what}: {reprlib.repr(given)} given; {needed} needed") from None


def _check_object(scene_object: Any) -> None:
    """Raise ValueError for what cannot be encoded as an object."""
    if not isinstance(scene_object, SceneObject):
        raise ValueError(f"object {scene_object!r} given; a SceneObject needed")
    what = f"object {reprlib.repr(scene_object.name)}"
    if not isinstance(scene_object.name, str):
        raise ValueError(f"{what} given; a text as its name needed")
    if scene_object.shape not in tuple(markers.NUMBERS):
        accepted = ", ".join(markers.NUMBERS)
        raise ValueError(f"{what}: shape {scene_object.shape!r} given; one of {accepted} accepted")
    checked_frame(scene_object.frame_id)
    _numbers(f"{what}: position", scene_object.position, 3)
    _numbers(f"{what}: orientation", scene_object.orientation, 4)
    _numbers(f"{what}: size", scene_object.size, 3)
    _numbers(f"{what}: colour", scene_object.colour, 4)
    markers.checked(scene_object)


def _encoded(frame_id: str, position: Vector3, orientation: Quaternion) -> Callable[[int], bytes]:
    """The encoding of a pose for a stamp [ns]. Raises ValueError for an invalid frame."""
    checked_frame(frame_id)
    return lambda stamp_ns: cdr.encode_pose(PoseStamped(stamp_ns, frame_id, position, orientation))


def _wish(
    pose: Sequence[float], std: tuple[float, float] | None, frame_id: str
) -> Callable[[int], bytes]:
    """The encoding of a wish for a stamp [ns]. Raises ValueError."""
    position, orientation = checked_pose("wish", _numbers("wish", pose, 7))
    if std is None:
        return _encoded(frame_id, position, orientation)
    checked_frame(frame_id)
    std_m, std_rad = _numbers("std", std, 2)
    if not (0.0 < std_m <= LARGEST_STD and 0.0 < std_rad <= LARGEST_STD):
        raise ValueError(f"std: {std} given; deviations above 0, up to {LARGEST_STD:g}, needed")
    variances = 3 * [std_m**2] + 3 * [std_rad**2]
    covariance = tuple(variances[i] * (i == j) for i in range(6) for j in range(6))
    return lambda ns: cdr.encode_pose_with_covariance(
        PoseWithCovarianceStamped(ns, frame_id, position, orientation, covariance)
    )


def checked_pose(what: str, pose: Sequence[float]) -> tuple[Vector3, Quaternion]:
    """Position [m] and orientation of a pose of three or seven numbers. Raises ValueError."""
    numbers = _numbers(what, pose, 3, 7)
    position = (numbers[0], numbers[1], numbers[2])
    turned = numbers[3:]
    if not turned:
        return position, UNTURNED
    if abs((norm := math.hypot(*turned)) - 1.0) > REQUEST_NORM_TOLERANCE:
        raise ValueError(
            f"{what}: quaternion {list(turned)} has norm {norm:.4g}; 1 needed (x y z w)"
        )
    return position, (turned[0], turned[1], turned[2], turned[3])


def _numbers(what: str, given: Sequence[float], *counts: int) -> tuple[float, ...]:
    """The finite numbers in a sequence of one of these lengths. Raises ValueError."""
    try:
        # their members are in no order, or no numbers
        if isinstance(given, str | bytes | bytearray | Mapping | Set):
            raise TypeError
        values = tuple(itertools.islice(given, counts[-1] + 1))
        if any(isinstance(value, str | bytes | bool) for value in values):
            raise TypeError
        numbers = tuple(map(float, values))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{what}: {reprlib.repr(given)} given; {FORMS[counts[-1]]} needed"
        ) from None
    if len(numbers) not in counts:
        most = f"more than {counts[-1]}" if len(numbers) > counts[-1] else len(numbers)
        count = len(given) if hasattr(given, "__len__") else most
        raise ValueError(f"{what}: {count} numbers given; {FORMS[counts[-1]]} needed")
    if not finite(numbers):
        raise ValueError(f"{what}: {list(numbers)} given; finite numbers needed")
    return numbers
