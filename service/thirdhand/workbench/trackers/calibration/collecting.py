"""Hands and tool for a calibration, of a running cell or of a recording, in common time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.contract import channels
from thirdhand.contract.channels import TAKE_KEYS
from thirdhand.contract.messages import BASE
from thirdhand.contract.records import SIDES
from thirdhand.core.frame import Vector
from thirdhand.settings.config import HandSettings, Settings, robot_description
from thirdhand.workbench.takes.demonstration_reader import in_metres, is_by_tracker
from thirdhand.workbench.takes.hands_and_tool import by_ending
from thirdhand.workbench.takes.pose_streams import JOINT_STATES, PoseRecording, with_types
from thirdhand.workbench.takes.track import Track
from thirdhand.workbench.trackers.calibration.solver import (
    LEAD_APART,
    TURN_WRIST,
    Calibration,
    CalibrationError,
    Coverage,
    HeldTool,
    coverage,
    solve_held,
)
from thirdhand.workbench.trackers.capture import Capture, Sample

CLOCK_TOLERANCE_S = 0.5  # stamps that differ more from the time of arrival are of another clock
MAX_GAP_S = 0.25  # in a longer gap between the arm's states, the tool's pose is unknown
SHOWN_SAMPLES = 120  # the expected accuracy is computed from this number of samples
SHOW_EVERY_S = 2.0
LEAST_LED_S = 15.0  # the tool is led at least this long
LED_S = 40.0  # after this time the accepted accuracy ends it, before only half of that error
# least motion and rotation of the led tool in each direction
LEAST_LED_M = 0.10
LEAST_TURNED_RAD = math.radians(40)
LED_POLL_S = 0.05
STREAM_ENDS_S = 1.0  # a stream that is silent for longer has ended
LARGEST_POSITION = 1e9  # in any unit; squares of larger numbers overflow
# positions are left out beyond this multiple of the median distance from their median
FAR_RATIO = 100.0
# least median distance [tracker's unit]: a hand that mostly rested may still move by 5 m
MIN_MEDIAN_OFF = 0.05
TOUCH_S = 0.5  # a touch is the median over this time
MAX_TOUCH_M = 0.015  # during a touch, the hand moves at most this far
LEAST_TOUCH_SAMPLES = 5


class LedTracks(NamedTuple):
    """The tracks of the hands that arrived, by side, in the tracker's unit, and of the tool; and
    remarks on omitted samples.
    """

    hands: Mapping[str, Track]
    tool: Track
    remarks: Sequence[str] = ()


class SolvedHand(NamedTuple):
    """A calibration, its hand and frame, the samples that it was computed from, and remarks."""

    calibration: Calibration
    side: str
    frame: str
    held: HeldTool
    remarks: Sequence[str]


def from_recording(path: Path, settings: Settings | None) -> tuple[LedTracks, Settings]:
    """Hands and tool in a recording or demonstration with joint states, and the settings: the given
    ones, or else those in the file. Raises RecordingError, CalibrationError.
    """
    recorded = PoseRecording(path)
    settings = settings or recorded.settings or Settings()
    joints = recorded.joint_topic(settings)
    if not joints:
        raise CalibrationError(
            f"{path} has no {JOINT_STATES} of the joints {', '.join(settings.joints.names)}: give "
            f"the arm by --config, or record them; its topics: {with_types(recorded.topics)}"
        )
    hands: dict[str, Track] = {}
    for side in SIDES:
        if source := by_ending(recorded, side):
            hands[side] = recorded.track(TAKE_KEYS[side], source, settings)
    if not hands:
        raise CalibrationError(
            f"{path} has no hands: a topic ending in hands/left or hands/right with "
            f"{channels.POSE.type} needed; its topics: {with_types(recorded.topics)}"
        )
    tool = recorded.tool_by_joints(joints, settings, recorded.urdf or robot_description(settings))
    return LedTracks(hands, tool, recorded.unused), settings


class LiveLed(Capture):
    """Hands and joints of a running cell, subscribed until closed."""

    def unheard(self, side: str | None, *, needs_joints: bool = True) -> list[str]:
        """The required streams from which nothing arrived; without a side, one hand is enough."""
        keys = [TAKE_KEYS[hand] for hand in SIDES if side in (None, hand)]
        hands = [] if any(self.samples[key] for key in keys) else [" or ".join(keys)]
        return hands + ([JOINT_STATES] if needs_joints and not self.samples[JOINT_STATES] else [])

    @property
    def arriving(self) -> list[str]:
        """The sides of the hands that arrive."""
        return [side for side in SIDES if self.samples[TAKE_KEYS[side]]]

    @property
    def ended(self) -> list[str]:
        """The streams that arrived, but not in the last STREAM_ENDS_S."""
        since_ns = time.time_ns() - round(1e9 * STREAM_ENDS_S)
        return [
            key
            for key, samples in self.samples.items()
            if samples and samples[-1].arrived_ns < since_ns
        ]

    def led(self, *, most_states: int | None = None, since_s: float | None = None) -> LedTracks:
        """The hands and the tool of the last `since_s` [s], None: all; the tool with at most
        `most_states` poses.

        Of a hand whose frame changed, only the samples in the newest frame are used.
        """
        hands: dict[str, Track] = {}
        remarks = []
        for side in self.arriving:
            samples = _lately(self.samples[TAKE_KEYS[side]], since_s)
            poses = [channels.POSE.decode(sample.payload) for sample in samples]
            frame = poses[-1].frame_id if poses else ""
            indices = [i for i, pose in enumerate(poses) if pose.frame_id == frame]
            if len(indices) < len(poses):
                remarks.append(
                    f"{TAKE_KEYS[side]} changed its frame to {frame!r}: "
                    f"the {len(poses) - len(indices)} samples before are not used"
                )
            if indices:
                stamps = np.array([poses[i].stamp_ns for i in indices], np.int64)
                logged = np.array([samples[i].arrived_ns for i in indices], np.int64)
                rows = np.array([(*poses[i].position, *poses[i].orientation) for i in indices])
                hands[side] = Track(TAKE_KEYS[side], "", stamps, logged, rows, frame)
        return LedTracks(hands, self._tool(most_states, since_s), remarks)

    def _tool(self, most: int | None, since_s: float | None) -> Track:
        states = _lately(self.samples[JOINT_STATES], since_s)
        if not states:
            nothing = np.zeros(0, np.int64)
            return Track("tool", "", nothing, nothing, np.zeros((0, 7)), BASE)
        return self.tool_by(states[:: math.ceil(len(states) / most) if most else 1])

    def touch(self, side: str) -> Vector:
        """The position (3,) [m] of a hand that rests, in the tracker's frame. Raises
        CalibrationError.
        """
        samples = _lately(self.samples[TAKE_KEYS[side]], TOUCH_S)
        if len(samples) < LEAST_TOUCH_SAMPLES:
            raise CalibrationError(
                f"{len(samples)} samples of {TAKE_KEYS[side]} in {TOUCH_S:g} s: is the hand seen?"
            )
        poses = [channels.POSE.decode(sample.payload) for sample in samples]
        positions_m = in_metres(
            np.array([pose.position for pose in poses]), self.settings.hands_in(poses[-1].frame_id)
        )
        moved_m = float(
            np.ptp(
                np.sort(positions_m, axis=0)[
                    len(positions_m) // 10 : len(positions_m) - len(positions_m) // 10
                ],
                axis=0,
            ).max()
        )
        if moved_m > MAX_TOUCH_M:
            raise CalibrationError(
                f"the hand moved by {1e3 * moved_m:.0f} mm: hold it still and press Enter again"
            )
        return np.asarray(np.median(positions_m, axis=0))


def _lately(samples: Sequence[Sample], since_s: float | None) -> Sequence[Sample]:
    """The samples of the last `since_s` [s]; None: all."""
    if since_s is None:
        return samples
    since_ns = time.time_ns() - int(1e9 * since_s)
    return [sample for sample in samples if sample.arrived_ns >= since_ns]


def tracker_of(hand: Track, settings: Settings) -> str:
    """The tracker among `[trackers]` whose frame the hand is in; empty: the tracker of `[hands]`,
    whose frame may be a new one. Raises CalibrationError if that could be either.
    """
    if settings.trackers and hand.frame not in settings.tracker_frames:
        raise CalibrationError(
            f"{hand.name} is in frame {hand.frame!r}, which has no table in the settings: add "
            f"[trackers.{hand.frame}], or, if it is that of [hands] (now "
            f"{settings.hands.frame!r}), set [hands] frame = {hand.frame!r}"
        )
    return hand.frame if hand.frame in settings.trackers else ""


def held_tool(hand: Track, tool: Track, hands: HandSettings) -> tuple[HeldTool, list[str]]:
    """Hand and tool in common time, in metres, and remarks. Raises CalibrationError.

    Stamps are used unless they are of another clock; then the times of arrival are used.
    """
    if not is_by_tracker(hand.name, hand.frame, hands):
        raise CalibrationError(
            f"{hand.name} is in frame {BASE!r}, and [hands] frame is {hands.frame!r}: its "
            "publisher maps it already, and base_from_tracker has no effect. Let it publish in the "
            "tracker's own frame"
        )
    remarks: list[str] = []
    (hand_ns, hand_is_foreign), (tool_ns, tool_is_foreign) = map(_clock, (hand, tool))
    if hand_is_foreign or tool_is_foreign:
        hand_ns = hand.logged_ns
        tool_ns = tool.logged_ns
        whose = hand.name if hand_is_foreign else JOINT_STATES
        remarks.append(f"the stamps of {whose} are of another clock: times of arrival are used")
    finite = _plausible(hand.poses[:, :3])
    if not finite.all():
        remarks.append(
            f"{(~finite).sum()} of {len(finite)} positions of {hand.name} are not finite, or far "
            "from all others, and not used"
        )
    tool_ns, tool_rows = np.unique(tool_ns, return_index=True)
    sound = np.isfinite(tool.poses[tool_rows]).all(axis=1)
    tool_ns = tool_ns[sound]
    tool_rows = tool_rows[sound]
    hand_ns, hand_rows = np.unique(hand_ns[finite], return_index=True)
    positions = in_metres(hand.poses[finite][hand_rows, :3], hands)
    if len(tool_ns) < 2:
        raise CalibrationError(
            f"no {JOINT_STATES} arrived while the tool was led: is the arm's driver running?"
        )
    after = np.clip(np.searchsorted(tool_ns, hand_ns), 1, len(tool_ns) - 1)
    near = (
        (hand_ns >= tool_ns[0])
        & (hand_ns <= tool_ns[-1])
        & (np.diff(tool_ns)[after - 1] < 1e9 * MAX_GAP_S)
    )
    origin = tool_ns[0]
    held = HeldTool(
        (hand_ns[near] - origin) / 1e9,
        positions[near],
        (tool_ns - origin) / 1e9,
        tool.poses[tool_rows, :3],
        tool.poses[tool_rows, 3:],
    )
    return held, remarks


def _plausible(positions: Vector) -> NDArray[np.bool_]:
    """True for each position (N, 3) that is finite and within FAR_RATIO times the median distance
    from their median: one position beyond would outweigh all others in the fit.
    """
    sound = np.asarray((np.abs(positions) < LARGEST_POSITION).all(axis=1))
    if sound.any():
        distances = np.linalg.norm(
            np.where(sound[:, None], positions, 0.0) - np.median(positions[sound], axis=0), axis=1
        )
        sound &= distances <= FAR_RATIO * max(float(np.median(distances[sound])), MIN_MEDIAN_OFF)
    return sound


def _clock(track: Track) -> tuple[NDArray[np.int64], bool]:
    """Stamps [ns], and true if they are of another clock than the times of arrival."""
    if not len(track.stamps_ns):
        return track.stamps_ns, False
    return track.stamps_ns, bool(
        abs(np.median(track.logged_ns - track.stamps_ns)) > 1e9 * CLOCK_TOLERANCE_S
    )


def the_hand(hands: Collection[str], side: str | None) -> str:
    """The hand that is calibrated: that of a side, or else the only one that arrives. Raises
    CalibrationError if both arrive, as no side is assumed.
    """
    if side is None and len(hands) > 1:
        raise CalibrationError(
            "both hands arrive: give the one that is at the tool, by --hand left or --hand right"
        )
    if not hands:
        raise CalibrationError("no hand arrives: is the tracker running?")
    if side is not None and side not in hands:
        raise CalibrationError(
            f"{TAKE_KEYS[side]} is needed, and nothing arrives there; {', '.join(hands)} arrives"
        )
    return side or next(iter(hands))


def solved(
    led: LedTracks, settings: Settings, corners: Vector, side: str | None, **more: int
) -> SolvedHand:
    """The calibration by the hand of a side, or by the only one that arrives. It is that of this
    hand's tracker; the other hand may have another one.

    Raises CalibrationError, which names the other hand if that one moves with the tool.
    """
    side = the_hand(led.hands, side)
    try:
        return _solved(led, settings, corners, side, **more)
    except CalibrationError as error:
        for other in led.hands.keys() - {side}:
            try:
                solution = _solved(led, settings, corners, other, **more)
            except CalibrationError:
                continue
            raise CalibrationError(
                f"{error}. {TAKE_KEYS[other]} moves with the tool, with a residual of "
                f"{1e3 * solution.calibration.rms_m:.0f} mm: if the {other} hand holds it, give "
                f"--hand {other}; else the tracker exchanges left and right"
            ) from None
        raise


def _solved(
    led: LedTracks, settings: Settings, corners: Vector, side: str, **more: int
) -> SolvedHand:
    track = led.hands[side]
    held, remarks = held_tool(track, led.tool, settings.hands_in(tracker_of(track, settings)))
    calibration = solve_held(held, corners, section=settings.tracker_section(track.frame), **more)
    return SolvedHand(calibration, side, track.frame, held, [*led.remarks, *remarks])


class LedProgress(NamedTuple):
    """The coverage of the led tool so far, the expected accuracy [m] if known, and what to do."""

    coverage: Coverage
    std_m: float | None
    advice: str

    def text(self) -> str:
        """The progress in one line."""
        moved = " x ".join(f"{100 * size:.0f}" for size in self.coverage.extent_m)
        turned = ", ".join(f"{math.degrees(angle):.0f}°" for angle in self.coverage.turned_rad[:2])
        accuracy = "unknown" if self.std_m is None else f"{1e3 * self.std_m:.1f} mm"
        return f"led over {moved} cm, turned {turned}; accuracy {accuracy}: {self.advice}"


def progress(
    led: LedTracks, settings: Settings, corners: Vector, side: str | None
) -> LedProgress | None:
    """The progress of a calibration; None before the arm was heard."""
    if len(led.tool.poses) < 4:
        return None
    cover = coverage(led.tool.poses[:, :3], led.tool.poses[:, 3:])
    std_m = None
    advice = ""
    try:
        calibration = solved(led, settings, corners, side, max_samples=SHOWN_SAMPLES).calibration
        std_m = calibration.std_m
        advice = calibration.remedy
    except CalibrationError as error:
        advice = str(error) if len(led.tool.poses) > SHOWN_SAMPLES else ""
    if cover.extent_m[2] < LEAST_LED_M:
        x, y, z = cover.narrow
        advice = f"{LEAD_APART.partition(',')[0]} along ({x:.1f}, {y:.1f}, {z:.1f})"
    elif cover.turned_rad[1] < LEAST_TURNED_RAD:
        advice = TURN_WRIST
    return LedProgress(cover, std_m, advice or "continue")


def lead(
    live: LiveLed,
    settings: Settings,
    corners: Vector,
    side: str | None,
    *,
    accept_m: float,
    longest_s: float,
    is_ended: Callable[[], bool],
    show: Callable[[str], None],
    warn: Callable[[str], None],
) -> str:
    """Collect while the tool is led; return the reason for the end. `show` receives the progress,
    `warn` a message when a stream ends or continues.

    It ends once the accuracy is half of `accept_m`, after LED_S once it is accepted, when
    `is_ended`, or after `longest_s`.
    """
    begun_s = shown_s = time.monotonic()
    ended: list[str] = []
    while (now_s := time.monotonic()) - begun_s < longest_s:
        time.sleep(LED_POLL_S)
        live.collect()
        if is_ended():
            return "ended by the operator"
        before = ended
        ended = live.ended
        if ended != before:
            warn(
                f"{' and '.join(ended)} no longer arrives" if ended else "all streams arrive again"
            )
        if now_s - shown_s < SHOW_EVERY_S:
            continue
        status = progress(live.led(most_states=4 * SHOWN_SAMPLES), settings, corners, side)
        shown_s = time.monotonic()
        if status is None:
            continue
        lasts_s = now_s - begun_s
        show(f"{lasts_s:4.0f} s  {status.text()}")
        wide = (
            status.coverage.extent_m[2] >= LEAST_LED_M
            and status.coverage.turned_rad[1] >= LEAST_TURNED_RAD
        )
        goal_m = accept_m if lasts_s > LED_S else 0.5 * accept_m
        if status.std_m is not None and wide and lasts_s > LEAST_LED_S and status.std_m < goal_m:
            return f"ended: the expected accuracy is {1e3 * status.std_m:.1f} mm"
    return f"ended after {longest_s:g} s"


def distances_m(held: HeldTool, calibration: Calibration) -> Vector:
    """Distances (N,) [m] of the mapped hand from its position by the tool's pose."""
    at_s = np.clip(held.hand_s - calibration.delay_s, held.tool_s[0], held.tool_s[-1])
    rows = np.clip(np.searchsorted(held.tool_s, at_s), 0, len(held.tool_s) - 1)
    tool = np.stack([np.interp(at_s, held.tool_s, axis) for axis in held.tool.T], axis=1)
    expected = tool + Rotation.from_quat(held.turn[rows]).apply(calibration.hand_in_tool)
    return np.asarray(np.linalg.norm(calibration.mapped(held.hand) - expected, axis=1))
