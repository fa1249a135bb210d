"""Capture of a demonstration: messages of a cell's hands, tool and gripper are received over Zenoh
until a person ends the capture or everything is at rest. They are written as received.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
import numpy as np
import zenoh

from thirdhand.client import Overheard
from thirdhand.contract import cdr, channels, ros2
from thirdhand.contract.channels import TAKE_KEYS
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.joint_states import JointStates, measured
from thirdhand.contract.messages import BASE, PoseStamped, WireError, finite
from thirdhand.contract.other_types import Refusal
from thirdhand.contract.requests import Hands, ViaPoint, encode_json
from thirdhand.core.frame import Vector
from thirdhand.core.intake.arm_samples import in_turn
from thirdhand.core.intake.stage import UNIT_M
from thirdhand.core.tuning import TUNING
from thirdhand.daemon.cell_streams import SolePublisher, identity
from thirdhand.recordings.mcap_file import machine, whole_file
from thirdhand.settings.config import Settings, robot_description
from thirdhand.workbench.takes.demonstration_reader import (
    far_away,
    from_tracker,
    is_by_tracker,
    unknown_frame,
)
from thirdhand.workbench.takes.dwells import REST_M
from thirdhand.workbench.takes.pose_streams import (
    BEGIN_TOPIC,
    GRIPPER_STATE,
    JOINT_STATES,
    VIA_POINTS_TOPIC,
)
from thirdhand.workbench.takes.tool_poses import tool_poses
from thirdhand.workbench.takes.track import Track

HAND_KEYS = ("hands/left", "hands/right")
TOOL_KEY = TAKE_KEYS["tool"]
CAPTURED_KEYS = (*HAND_KEYS, TOOL_KEY, JOINT_STATES, GRIPPER_STATE)
# these expressions find streams of other cells, and misspelt keys
OTHER_CELLS = ("**/hands/*", "**/tool/pose")
MAX_OTHER_KEYS = 8  # an error message lists at most this many of them
REST_RAD = 0.02  # a joint at rest moves less than this
MIN_COVERED_SHARE = 0.7  # samples must cover this share of a rest
MOVED_RATIO = 5.0  # a rest ends a capture only after a motion of 5 times the motion at rest
RETAINED_REST_S = 0.3  # this time of the rest before and after the motion is retained
CAPTURE_SILENCE_S = 2.0  # a capture ends after this time without a message
CAPTURE_POLL_S = 0.02
PROGRESS_S = 0.1  # interval of progress reports
Until = Literal["key", "rest"]


class CaptureError(ExplainedError, RuntimeError):
    """A demonstration could not be captured; the message has the cause."""


class Sample(NamedTuple):
    """A received message: its arrival [ns], its bytes, and the position of hand or tool [m] or of
    joints [rad], from which rest is detected.
    """

    arrived_ns: int
    payload: bytes
    at: Vector


class CapturedMessage(NamedTuple):
    """A message as received: its arrival [ns], bytes, publisher and Zenoh encoding."""

    arrived_ns: int
    payload: bytes
    publisher: str
    encoding: str


class Capture:
    """The samples of one demonstration: the hands that lead the tool, the tool, the joints and the
    gripper. The subscriptions last until `close`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        cell: str,
        settings: Settings,
        conducts: Hands = "both",
        person: str = "",
    ) -> None:
        self.cell = cell
        self.settings = settings
        self.conducts = conducts
        self.person = person
        self.begun_ns: int | None = None  # when a request began the demonstration
        self._urdf = robot_description(settings)
        self.hands = HAND_KEYS if conducts == "both" else (TAKE_KEYS[conducts],)
        self.samples: dict[str, list[Sample]] = {
            key: [] for key in CAPTURED_KEYS if key not in HAND_KEYS or key in self.hands
        }
        self.malformed = Counter[str]()
        self._first_refusals: dict[str, Refusal] = {}
        self.of_others: dict[
            str, int
        ] = {}  # messages of a hand's second publisher, which are left out
        self._sole = {key: SolePublisher() for key in self.hands}
        self._waiting: dict[str, list[CapturedMessage]] = {key: [] for key in self.samples}
        self._heard_s = time.monotonic()
        self._moved = False
        self._states = JointStates(settings.joints.names, settings.arm.silent_ms / 1000)
        heard = [(channels.key(cell, key), self._listener(key)) for key in self.samples]
        if (domain := settings.network.ros2_domain) is not None:
            topics = ros2.heard(cell, settings.ros2, self.samples)
            heard += [
                (ros2.key(domain, topic), self._listener(topic.channel, topic.frame))
                for topic in topics
            ]
        self._subscribers = [session.declare_subscriber(key, listener) for key, listener in heard]

    def _listener(self, key: str, frame: str = "") -> Callable[[zenoh.Sample], None]:
        """A function that queues the messages of a channel; with a `frame`, the poses of that
        child frame.
        """
        waiting = self._waiting[key]
        name = cdr.bytes_of_frame(frame)

        def take(sample: zenoh.Sample) -> None:
            arrived_ns = time.time_ns()
            payload = sample.payload.to_bytes()
            received = CapturedMessage(arrived_ns, payload, identity(sample), str(sample.encoding))
            if not frame:
                waiting.append(received)
            elif name in payload:
                try:
                    poses = cdr.decode_transforms(payload, (frame,))
                    waiting.extend(
                        received._replace(payload=cdr.encode_pose(pose)) for _, pose in poses
                    )
                except WireError as error:
                    self._refuse(key, received, error, channels.TRANSFORMS.type)

        return take

    def _refuse(self, key: str, received: CapturedMessage, error: WireError, needed: str) -> None:
        refusal = Refusal(str(error), needed, received.payload, received.encoding)
        self._first_refusals.setdefault(key, refusal)
        self.malformed[key] += 1

    @property
    def unreadable(self) -> list[str]:
        """The messages of each key that are not readable, in words: their number, and the first."""
        return [
            f"{count} messages on {key} are not readable: {self._first_refusals[key]}"
            for key, count in self.malformed.items()
        ]

    def close(self) -> None:
        """End the subscriptions and decode the last messages."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self.collect()

    def collect(self) -> None:
        """Decode the messages since the last call; unreadable ones are counted."""
        for key, waiting in self._waiting.items():
            while waiting:
                received = waiting.pop(0)
                arrived_ns = received.arrived_ns
                self._heard_s = time.monotonic()
                try:
                    sample = (self._state if key == JOINT_STATES else self._sample)(
                        key, arrived_ns, received.payload
                    )
                except WireError as error:
                    self._refuse(key, received, error, channels.BY_KEY[key].codec.type)
                    continue
                sole = self._sole.get(key)
                if sole is not None and sole.is_other(received.publisher, arrived_ns / 1e9):
                    self.of_others[key] = self.of_others.get(key, 0) + 1
                elif sample is not None:
                    self.samples[key].append(sample)

    def _state(self, key: str, arrived_ns: int, payload: bytes) -> Sample | None:
        """The state of all joints that a message completes; None if it completes none."""
        message = cdr.decode_joints(payload)
        state = self._states.take(message, arrived_ns / 1e9) or self._states.incomplete(
            message, arrived_ns / 1e9
        )
        if state is None:
            return None
        received = payload if state is message else cdr.encode_joints(state)
        joints = np.array(measured(state, self.settings.joints.names)[0])
        if before := self.samples[key]:
            joints = in_turn(self.settings.joints, joints, before[-1].at)
        return Sample(arrived_ns, received, joints)

    def _sample(self, key: str, arrived_ns: int, payload: bytes) -> Sample:
        """The sample of a hand, the tool or the gripper."""
        message = channels.BY_KEY[key].codec.decode(payload)
        if isinstance(message, PoseStamped):
            if not finite(message.position + message.orientation):
                raise WireError("a pose that is not finite")
            hands = self.settings.hands_in(message.frame_id)
            is_scaled = is_by_tracker(key, message.frame_id, hands)
            position_m = UNIT_M[hands.unit if is_scaled else "m"] * np.array(message.position)
            return Sample(arrived_ns, payload, position_m)
        return Sample(arrived_ns, payload, np.array(message.position[:1]))

    @property
    def missing(self) -> list[str]:
        """The required streams that have not been received yet."""
        tool = (
            []
            if self.samples[TOOL_KEY] or self.samples[JOINT_STATES]
            else [f"{TOOL_KEY} or {JOINT_STATES}"]
        )
        return [key for key in self.hands if not self.samples[key]] + tool

    def check(self) -> None:
        """Raise CaptureError if a hand or the tool is too far away, or its frame is unknown."""
        for key in (*self.hands, TOOL_KEY):
            for sample in self.samples[key][-1:]:
                pose = channels.POSE.decode(sample.payload)
                hands = self.settings.hands_in(pose.frame_id)
                position = np.array(pose.position)
                if problem := unknown_frame(key, pose.frame_id, hands):
                    raise CaptureError(f"{problem}. Nothing was recorded")
                if is_by_tracker(key, pose.frame_id, hands):
                    position = from_tracker(position, hands)
                if np.linalg.norm(position) > TUNING.intake.max_hand_distance_m:
                    why = far_away(key, pose.frame_id, pose.position, self.settings)
                    raise CaptureError(f"{key} is {why}. Nothing was recorded")

    @property
    def streams(self) -> dict[str, list[Sample]]:
        """The streams of both hands, and of the tool if it is tracked, else of the arm's joints."""
        return {
            key: self.samples[key]
            for key in (*self.hands, TOOL_KEY if self.samples[TOOL_KEY] else JOINT_STATES)
        }

    @property
    def silent_s(self) -> float:
        """Time since the last message [s]."""
        return time.monotonic() - self._heard_s

    def begin(self) -> None:
        """Begin the demonstration: delete all but the newest sample of each stream."""
        for samples in self.samples.values():
            del samples[:-1]

    def is_over(self, rest_s: float) -> bool:
        """True once everything has been at rest for `rest_s` [s] after a motion."""
        now_ns = time.time_ns()
        began_ns = min(samples[0].arrived_ns for samples in self.streams.values())
        if now_ns - began_ns < 1e9 * rest_s:
            return False
        for key, samples in self.streams.items():
            lately = [
                *itertools.takewhile(
                    lambda one: now_ns - one.arrived_ns <= 1e9 * rest_s, reversed(samples)
                )
            ][::-1]
            still = [sample.at for sample in lately]
            self._moved = self._moved or (
                bool(still) and _motion(key, np.array([samples[0].at, still[-1]])) > MOVED_RATIO
            )
            covered_s = (lately[-1].arrived_ns - lately[0].arrived_ns) / 1e9 if lately else 0.0
            if covered_s < MIN_COVERED_SHARE * rest_s or _motion(key, np.array(still)) > 1:
                return False
        return self._moved

    def keep_motion(self) -> tuple[float, float]:
        """Delete the rest before and after the motion, and return the deleted times [s].
        RETAINED_REST_S of each is retained.
        """
        times_ns = [sample.arrived_ns for samples in self.streams.values() for sample in samples]
        start_ns, end_ns = self.span_of_motion()
        if self.begun_ns is not None:
            start_ns = min(times_ns)
        for key, samples in self.samples.items():
            self.samples[key] = [
                sample for sample in samples if start_ns <= sample.arrived_ns <= end_ns
            ]
        return max(0.0, (start_ns - min(times_ns)) / 1e9), max(0.0, (max(times_ns) - end_ns) / 1e9)

    def span_of_motion(self) -> tuple[int, int]:
        """Begin and end of the motion [ns], with RETAINED_REST_S of rest before and after."""
        begins = []
        ends = []
        for key, samples in self.streams.items():
            positions = np.array([sample.at for sample in samples])
            margin = REST_RAD if key == JOINT_STATES else REST_M
            away = [np.abs(positions - positions[end]).max(axis=1) > margin for end in (0, -1)]
            if away[0].any():
                begins.append(samples[int(np.argmax(away[0]))].arrived_ns)
                ends.append(samples[len(positions) - 1 - int(np.argmax(away[1][::-1]))].arrived_ns)
        if not begins:
            return 0, time.time_ns()
        return min(begins) - int(1e9 * RETAINED_REST_S), max(ends) + int(1e9 * RETAINED_REST_S)

    def write(self, path: Path, via_points: Sequence[ViaPoint] = ()) -> None:
        """Write the whole demonstration or nothing: the received messages and the task's
        via-points, with settings and URDF attached.

        Without a tracked tool its poses are computed from the joints. Raises CaptureError, OSError.
        """
        if lacking := self.missing:
            raise CaptureError(
                f"no messages on {', '.join(lacking)} arrived in time: no demonstration was written"
            )
        messages = [
            (sample.arrived_ns, key, sample.payload)
            for key, samples in self.samples.items()
            for sample in samples
        ]
        if not self.samples[TOOL_KEY]:
            tool = self.tool_by(self.samples[JOINT_STATES])
            rows = zip(
                tool.logged_ns.tolist(), tool.stamps_ns.tolist(), tool.poses.tolist(), strict=True
            )
            for arrived_ns, stamp_ns, pose_row in rows:
                pose = PoseStamped(stamp_ns, BASE, tuple(pose_row[:3]), tuple(pose_row[3:]))
                messages.append((arrived_ns, TOOL_KEY, channels.POSE.encode(pose)))
        texts = {}
        if via_points:
            texts[VIA_POINTS_TOPIC] = min(messages)[0], encode_json(tuple(via_points)).decode()
        if self.begun_ns is not None:
            texts[BEGIN_TOPIC] = self.begun_ns, "{}"
        messages += [(at_ns, key, cdr.encode_string(text)) for key, (at_ns, text) in texts.items()]
        with whole_file(path, joints=len(self.settings.joints.names)) as file:
            now_ns = time.time_ns()
            about = {"cell": self.cell, "hands": self.conducts, "person": self.person, **machine()}
            file.writer.add_metadata("thirdhand", about)
            file.attach("settings.json", msgspec.json.encode(self.settings), now_ns)
            file.attach("arm.urdf", self._urdf.encode(), now_ns)
            for i, (arrived_ns, key, payload) in enumerate(sorted(messages)):
                codec = channels.STRING if key in texts else channels.BY_KEY[key].codec
                file.put(channels.key(self.cell, key), codec.type, payload, arrived_ns, i)

    def tool_by(self, states: Sequence[Sample]) -> Track:
        """The tool's track in frame `base`, from states of the arm's joints by its URDF."""
        logged = np.array([state.arrived_ns for state in states], np.int64)
        stamps = np.array(
            [channels.JOINTS.decode(state.payload).stamp_ns for state in states], np.int64
        )
        stamps = np.where(stamps == 0, logged, stamps)
        joints = np.array([state.at for state in states])
        poses, rows = tool_poses(self.settings, self._urdf, stamps, joints)
        return Track("tool", "", stamps[rows], logged[rows], poses, BASE)

    def not_received(self, missing: Sequence[str], more: str = "") -> str:
        """A message on streams that do not arrive, and what to check."""
        unreadable = "".join(f"; {remark}" for remark in self.unreadable)
        return (
            f"not received: {', '.join(missing)}{unreadable}{more}. Are tracker and arm running, "
            f"connected to the same endpoint, and in cell {self.cell}?"
        )


def _motion(key: str, at: Vector) -> float:
    """Largest motion of positions or joints (N, K), as a multiple of the motion at rest."""
    return float(np.ptp(at, axis=0).max()) / (REST_RAD if key == JOINT_STATES else REST_M)


def capture(
    session: zenoh.Session,
    cell: str,
    settings: Settings,
    *,
    until: Until,
    rest_s: float,
    conducts: Hands = "both",
    person: str = "",
    is_ended: Callable[[], bool],
    wait_s: float,
    longest_s: float,
    is_begun: Callable[[], bool] | None = None,
    progress: Callable[[str], None] = lambda line: None,
    say: Callable[[str], None] = lambda line: None,
) -> Capture:
    """Capture a demonstration, from the first messages of hands and tool until `is_ended`, until
    everything rests for `rest_s` [s] after a motion, or until CAPTURE_SILENCE_S without a message.
    If `is_begun` is given, it begins once that is true, as at a request.

    Raises CaptureError if hands and tool are not received within `wait_s` [s].
    """
    captured = Capture(session, cell, settings, conducts, person)
    others = Overheard(session, *OTHER_CELLS)
    end = _End(until, rest_s, longest_s)
    try:
        say(f"waiting for {', '.join(captured.missing)} of cell {cell}")
        _await_streams(captured, others, is_ended, wait_s)
        others.close()
        captured.check()
        if is_begun is not None:
            say("hands and tool arrive: Enter begins the take, and another one or Ctrl-C ends it")
            while not is_begun():
                time.sleep(CAPTURE_POLL_S)
                captured.collect()
                if captured.silent_s > CAPTURE_SILENCE_S:
                    raise CaptureError(
                        f"no message arrived for {CAPTURE_SILENCE_S:g} s, before the take began. "
                        "Nothing was recorded"
                    )
            captured.begun_ns = time.time_ns()
        captured.begin()
        say(f"recording{f'; it ends once {end.at_rest} after a motion' if until == 'rest' else ''}")
        if reason := _collect(captured, is_ended, end, progress):
            say(reason)
    except KeyboardInterrupt:
        if captured.missing or (is_begun is not None and captured.begun_ns is None):
            raise
    finally:
        others.close()
        captured.close()
    if until == "rest":
        before_s, behind_s = captured.keep_motion()
        if before_s or behind_s:
            say(f"rest left out: {before_s:.1f} s before the motion, {behind_s:.1f} s after it")
    return captured


class _End(NamedTuple):
    """The conditions that end a capture, unless the operator does."""

    until: Until
    rest_s: float
    longest_s: float

    @property
    def at_rest(self) -> str:
        """The condition of rest in words."""
        return (
            f"hands and tool stay within {1000 * REST_M:g} mm (joints {REST_RAD:g} rad) for "
            f"{self.rest_s:g} s"
        )

    def reason(self, captured: Capture, lasts_s: float) -> str:
        """The reason why a capture ends after this time [s]; empty while it does not."""
        if self.until == "rest" and captured.is_over(self.rest_s):
            return f"ended by rest: {self.at_rest}"
        if lasts_s > self.longest_s:
            return f"ended after {self.longest_s:g} s"
        if captured.silent_s > CAPTURE_SILENCE_S:
            return f"ended: no message arrived for {CAPTURE_SILENCE_S:g} s"
        return ""


def _await_streams(
    captured: Capture, others: Overheard, is_ended: Callable[[], bool], wait_s: float
) -> None:
    """Wait for the first messages of hands and tool. Raises CaptureError after `wait_s` [s], with
    what arrived from other cells.
    """
    begun_s = time.monotonic()
    while captured.missing:
        if time.monotonic() - begun_s > wait_s or is_ended():
            meant = {channels.key(captured.cell, key) for key in CAPTURED_KEYS}
            elsewhere = [key for key in others.keys if key not in meant][:MAX_OTHER_KEYS]
            instead = f"; received instead: {', '.join(elsewhere)}" if elsewhere else ""
            raise CaptureError(captured.not_received(captured.missing, instead))
        time.sleep(CAPTURE_POLL_S)
        captured.collect()


def _collect(
    captured: Capture,
    is_ended: Callable[[], bool],
    end: _End,
    progress: Callable[[str], None],
) -> str:
    """Collect messages until the end; its reason, or an empty text if the operator ends it."""
    begun_s = time.monotonic()
    shown_s = 0.0
    while not is_ended():
        time.sleep(CAPTURE_POLL_S)
        captured.collect()
        lasts_s = time.monotonic() - begun_s
        if lasts_s - shown_s > PROGRESS_S:
            shown_s = lasts_s
            counts = ", ".join(f"{key} {len(samples)}" for key, samples in captured.streams.items())
            progress(f"{lasts_s:5.1f} s   {counts}")
        if reason := end.reason(captured, lasts_s):
            return reason
    return ""
