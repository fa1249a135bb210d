"""Settings of one cell: a TOML file, validated completely before anything starts.

Each number has its unit in its name or in its comment. All defaults are safe.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from thirdhand.contract import ros2
from thirdhand.contract.channels import CellName
from thirdhand.contract.explain import InvalidError, in_words, validated
from thirdhand.contract.messages import BASE
from thirdhand.settings.arm_description import LIMITS, check, completed, description
from thirdhand.settings.file_content import (
    SettingsError,
    UnreadableError,
    UnusableError,
    text_in,
    toml_in,
)
from thirdhand.settings.network import Network, Ros2
from thirdhand.settings.urdf import Urdf, UrdfError

WAM = Path(__file__).parents[1] / "arms" / "wam.urdf"
RATES_HZ = (50, 1000)  # lowest and highest accepted rate
MAX_CELL_BYTES = 200  # a recording's name, of cell and time, may have 255 bytes
# an arm with its own URDF must reach at least this share of a configured `[reach]`
REACHED_SHARE = 0.8
# required share of a `[reach]` that follows from the kinematics, cut by min_z and min_x
LEAST_REACHED_SHARE = 0.05
Positive = Annotated[float, msgspec.Meta(gt=0)]
Point = tuple[float, float, float]
Pose = tuple[float, float, float, float, float, float, float]  # x y z [m], quaternion x y z w
PerJoint = tuple[float, ...]

# Relative paths in these settings start from the folder of the configuration.
FROM_FOLDER = (
    ("arm", "urdf"),
    ("arm", "packages"),
    ("files", "skill"),
    ("network", "certificate"),
    ("network", "zenoh_config"),
)
# Relative paths in these settings start from the current folder.
FROM_HERE = (("files", "state"), ("files", "record"))
# [1/s] acceleration limit / speed limit: the defaults' 10 m/s² / 0.8 m/s
MAX_ACCELERATION_PER_SPEED = 12.5
MAX_JERK_PER_SPEED = 500.0  # [1/s²] jerk limit / speed limit: the defaults' 400 m/s³ / 0.8 m/s
# accepted sizes of numbers other than 0; powers of others overflow, or become 0
SMALLEST_NUMBER = 1e-9
LARGEST_NUMBER = 1e9
FARTHEST_FRAME_M = 100.0  # largest distance of a tracker from the arm, or of tool from plate
LEAST_OUTER_M = 0.01  # an arm that moves its tool by less is none
# tolerance of a prismatic joint for 1 rad of others: on a lever of 0.5 m the tool moves as far
PRISMATIC_M = 0.5


class Following(NamedTuple):
    """Values that `[tool] follow` sets together."""

    stop_room: float  # share of the hand's braking distance that the setpoint uses for its own stop
    jerk_share: float  # share of `max_jerk` that the setpoint uses


FOLLOWING = {
    "closely": Following(stop_room=2.0, jerk_share=1.0),
    "default": Following(stop_room=1.0, jerk_share=1.0),
    "calmly": Following(stop_room=0.5, jerk_share=0.5),
}


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of the file; an unknown name in it is an error."""


class HandSettings(Section, frozen=True):
    """The tracker's frame and unit, and the times for which a hand may be silent."""

    # name of the tracker's frame; `base` is accepted too
    frame: Annotated[str, msgspec.Meta(max_length=64)] = "base"
    unit: Literal["m", "cm", "mm"] = "m"  # unit of the tracker's positions
    # of left-handed axes (Unity), z is reversed first
    axes: Literal["right-handed", "left-handed"] = "right-handed"
    # pose of the tracker's frame, after unit and axes
    base_from_tracker: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    # the arm holds after this time without a sample
    stale_ms: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0
    # delays raise `stale_ms` up to this; 0: never
    stale_max_ms: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 0.0
    # one hand may be out of sight for this time
    unseen_ms: Annotated[float, msgspec.Meta(ge=0, le=1000)] = 500.0
    # "key": the arm follows only while `clutch` says that it is pressed
    clutch: Literal["none", "key"] = "none"
    # a clutch is released after this silence
    clutch_stale_ms: Annotated[float, msgspec.Meta(ge=20, le=1000)] = 300.0
    # "key": `gripper/wish` decides the gripper where the skill does not
    gripper: Literal["none", "key"] = "none"

    @property
    def longest_stale_ms(self) -> float:
        """Longest time without a sample [ms] after which a hand is stale, with any delays."""
        return max(self.stale_ms, self.stale_max_ms)


class TrackerSettings(Section, frozen=True):
    """One more tracker beside that of `[hands]`. NAME is the frame of its poses: hands in that
    frame, and the tool in demonstrations, are mapped by this table. `[hands]` maps its own `frame`.
    """

    unit: Literal["m", "cm", "mm"] = "m"  # unit of the tracker's positions
    # of left-handed axes (Unity), z is reversed first
    axes: Literal["right-handed", "left-handed"] = "right-handed"
    # pose of the tracker's frame, after the unit
    base_from_tracker: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class ToolSettings(Section, frozen=True):
    """The tool: its pose on the tool plate, and its limits of motion."""

    # pose of the tool in the frame of the plate
    plate_from_tool: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    # [m/s] largest speed of the setpoint
    max_speed: Annotated[float, msgspec.Meta(gt=0, le=0.8)] = 0.8
    # [m/s] until the tool reaches its target; 0: off
    engage_speed: Annotated[float, msgspec.Meta(ge=0, le=0.8)] = 0.15
    # [m/s²] largest; at most 12.5 * max_speed
    max_acceleration: Annotated[float, msgspec.Meta(gt=0, le=20)] = 10.0
    # [m/s³] largest; at most 500 * max_speed
    max_jerk: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 400.0
    # [m/s] a faster tool, as measured, is a fault
    fault_speed: Annotated[float, msgspec.Meta(gt=0, le=1.5)] = 1.0
    # follow the direction of the tool's +z, or all axes
    orientation: Literal["direction", "full"] = "direction"
    # [rad/s] largest rate of turning the tool
    max_turn_speed: Annotated[float, msgspec.Meta(gt=0, le=2)] = 1.0
    max_turn_acceleration: Annotated[float, msgspec.Meta(gt=0, le=20)] = 4.0  # [rad/s²]
    radius: Positive = 0.02  # [m] radius of the tool, if the tool point is away from the plate
    # less lag, or less overshoot and jerk: docs/tune.md
    follow: Literal["closely", "default", "calmly"] = "default"

    @property
    def engaging_speed(self) -> float:
        """Speed limit of the setpoint [m/s] after a start or a hold until it is at its target for
        the first time: `engage_speed`, but at most `max_speed`, which also holds for an
        `engage_speed` of 0.
        """
        return min(self.engage_speed or self.max_speed, self.max_speed)

    @property
    def acceleration(self) -> float:
        """Acceleration limit of the setpoint [m/s²], as a norm: `max_acceleration`, but at most
        `max_speed` within 80 ms.

        A tool with a low speed limit and a high acceleration limit exceeds its speed limit in a
        stop: while its joints end their accelerations, the speed grows by a² / (2 jerk).
        """
        return min(self.max_acceleration, MAX_ACCELERATION_PER_SPEED * self.max_speed)

    @property
    def jerk(self) -> float:
        """Jerk limit of the setpoint [m/s³], as a norm: `max_jerk`, but at most 500 `max_speed`,
        which reaches that acceleration within 25 ms; of this, the share that `follow` uses.
        """
        return FOLLOWING[self.follow].jerk_share * min(
            self.max_jerk, MAX_JERK_PER_SPEED * self.max_speed
        )

    @property
    def room(self) -> float:
        """Share of the hand's braking distance that the setpoint uses for its own stop."""
        return FOLLOWING[self.follow].stop_room

    @property
    def stop_acceleration(self) -> float:
        """Acceleration limit of each axis in a stop [m/s²]; the norm then holds `acceleration`."""
        return 0.4 * self.acceleration

    @property
    def stop_jerk(self) -> float:
        """Jerk limit of each axis in a stop [m/s³]; the norm then holds `jerk`."""
        return self.jerk / math.sqrt(3.0)


class ArmSettings(Section, frozen=True):
    """The arm: its description, the source of its joint states, its preferred posture, and the
    limits beyond which following is a fault.
    """

    urdf: str = ""  # URDF file; empty: the shipped Barrett WAM
    # folders of ROS packages for package:// in the URDF, like /opt/ros/jazzy/share
    packages: tuple[str, ...] = ()
    plate: str = "tool_plate"  # the link that carries the tool
    # wait for `joints/state`, or begin at `posture` without an arm
    source: Literal["state", "assumed"] = "state"
    # "held": after every start the arm holds until `thirdhand resume`
    start: Literal["follow", "held"] = "follow"
    # [rad] preferred; start if assumed
    posture: PerJoint = (0.1761, 0.8604, -0.5, 2.5414, -0.4273, -1.0823, 0.0)
    link_radius: Positive = 0.07  # [m] radius of links without a collision shape
    # largest difference between measured and commanded joint position
    fault_error_rad: Positive = 0.1
    # a moving arm is at fault after this silence
    silent_ms: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0


class JointSettings(Section, frozen=True):
    """The arm's joints in chain order, and the limits that no command ever leaves [rad, rad/s,
    rad/s², rad/s³], for prismatic (sliding) joints [m, m/s, m/s², m/s³].

    A continuous joint has the limits ±6000 rad unless narrower ones are given. It is commanded in
    the turn in which `joints/state` reports it when the arm becomes ready, and onward from there;
    states that wrap at ±pi and states that count turns are both accepted. Tolerances in rad that
    the service applies to every joint are half as many metres for a prismatic one.
    """

    names: tuple[str, ...] = (  # as `joints/state` and `joints/command` name them
        "wam/base_yaw_joint",
        "wam/shoulder_pitch_joint",
        "wam/shoulder_yaw_joint",
        "wam/elbow_pitch_joint",
        "wam/wrist_yaw_joint",
        "wam/wrist_pitch_joint",
        "wam/palm_yaw_joint",
    )
    # from the URDF; empty: all revolute
    kinds: tuple[Literal["revolute", "continuous", "prismatic"], ...] = ()
    lower: PerJoint = (-2.6, -1.985, -2.8, -0.9, -4.55, -1.5707, -2.7)  # [rad]
    upper: PerJoint = (2.6, 1.985, 2.8, 3.1, 1.24, 1.5707, 2.7)  # [rad]
    velocity: PerJoint = (1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5)  # [rad/s]
    acceleration: PerJoint = (6.0, 9.0, 15.0, 20.0, 20.0, 20.0, 20.0)  # [rad/s²]
    jerk: PerJoint = (300.0, 450.0, 500.0, 500.0, 500.0, 500.0, 500.0)  # [rad/s³]

    @property
    def every_kind(self) -> tuple[str, ...]:
        """The kind of each joint."""
        return self.kinds or ("revolute",) * len(self.names)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each joint's position."""
        return tuple("m" if kind == "prismatic" else "rad" for kind in self.every_kind)

    @property
    def per_rad(self) -> tuple[float, ...]:
        """Tolerance of each joint, in its own unit, for a tolerance of 1 rad."""
        return tuple(PRISMATIC_M if kind == "prismatic" else 1.0 for kind in self.every_kind)


class Reach(Section, frozen=True):
    """The workspace of targets: a spherical shell around the shoulder, in front of the base plate
    and above the table [m].
    """

    centre: Point = (0.0, 0.0, 0.346)  # [m] centre of the shell, where the arm's first axes meet
    inner: Positive = 0.35  # [m] inner radius of the shell
    outer: Annotated[float, msgspec.Meta(gt=0, le=3)] = 0.88  # [m] outer radius of the shell
    # [m] least x, in front of the base plate
    min_x: Annotated[float, msgspec.Meta(ge=-1, le=1)] = 0.15
    min_z: Annotated[float, msgspec.Meta(ge=-1, le=1)] = 0.02  # [m] least z, above the table


class People(Section, frozen=True):
    """Limits of speed and distance toward people, modelled on ISO 10218-2; none is safety-rated.

    A hand is a capsule from its tracked point toward the elbow. A part of the arm may approach a
    hand at the speed from which it can stop `clearance` + `position_uncertainty` away from the
    hand, while the hand continues at its present speed and the stop begins `hands.stale_ms` +
    `reaction_ms` late: a hand may move unseen for `hands.stale_ms`, or for `hands.stale_max_ms` if
    that is longer. A hand out of sight for longer is assumed to accelerate toward the arm at 5 m/s²
    up to 1.6 m/s.
    """

    radius: Positive = 0.04  # [m] radius of hand and forearm
    # [m] length from the tracked point toward the elbow
    length: Annotated[float, msgspec.Meta(ge=0)] = 0.24
    toward_elbow: Point = (1.0, 0.0, 0.0)  # direction in frame `base`; the user sits at +x
    # [m] least distance to a hand's capsule
    clearance: Annotated[float, msgspec.Meta(ge=0)] = 0.024
    # [m] of hand and arm; 3 deviations of 2 mm
    position_uncertainty: Annotated[float, msgspec.Meta(ge=0)] = 0.006
    # [m/s²] assumed deceleration; the shipped arm's slowest joint brakes its stretched tool at 5
    brake: Positive = 3.0
    # interval of samples + one tick + ramp of the braking
    reaction_ms: Annotated[float, msgspec.Meta(ge=0)] = 30.0
    # [m/s] largest speed toward a receiving hand
    contact_speed: Annotated[float, msgspec.Meta(ge=0, le=0.25)] = 0.25

    @property
    def distance(self) -> float:
        """The distance from a hand's capsule [m] at which a stop ends."""
        return self.clearance + self.position_uncertainty


class Box(Section, frozen=True):
    """An obstacle: a box parallel to the axes of frame `base` [m]."""

    centre: Point
    half_size: tuple[Positive, Positive, Positive]


class Obstacles(Section, frozen=True):
    """Obstacles other than people: the table, the arm itself, and boxes."""

    boxes: tuple[Box, ...] = ()  # [m] boxes parallel to the axes of frame `base`
    # [m] least distance; from the arm itself at most 0.01
    clearance: Annotated[float, msgspec.Meta(ge=0)] = 0.01
    brake: Positive = 2.0  # [m/s²] assumed deceleration toward obstacles
    reaction_ms: Annotated[float, msgspec.Meta(ge=0)] = 20.0  # ramp of the braking


class TableTop(Section, frozen=True):
    """The table top [m]. The arm avoids it and everything below; pictures and the simulation draw
    it.
    """

    centre: Point = (0.80, 0.0, 0.0)  # [m]
    half_size: tuple[Positive, Positive] = (0.45, 0.60)  # [m] along x and y


class SkillSettings(Section, frozen=True):
    """What the tool follows, and the timing with which a skill is followed."""

    # the tool is this far ahead of the teacher's timing
    lead_s: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    # "tool/wish": the poses that a policy wishes there, instead of a learned skill
    source: Literal["hands", "tool/wish"] = "hands"
    # the skill leads too: both are weighed by their covariances
    blend: bool = False
    # the arm holds after this time without a wish that is due
    silent_ms: Annotated[float, msgspec.Meta(gt=0, le=5000)] = 1000.0

    @property
    def has_wishes(self) -> bool:
        """True if a policy leads."""
        return self.source == "tool/wish"


class Files(Section, frozen=True):
    """The skill, folders of via-points and recordings, and the limits of recordings."""

    # the skill's file, beside which are the others that clients ask for; empty: the shipped one
    skill: str = ""
    # a folder for via-points over a restart; empty: thirdhand in $XDG_STATE_HOME or ~/.local/state
    state: str = ""
    record: str = ""  # a folder; empty: nothing is recorded
    # at this size a recording ends and the next begins, without a gap
    segment_mb: Annotated[float, msgspec.Meta(ge=0.01)] = 200.0
    segment_minutes: Positive = 10.0  # age at which the next recording begins, without a gap
    # largest size of this cell's .mcap files; 0: no limit
    keep_mb: Annotated[float, msgspec.Meta(ge=0)] = 50_000.0
    # .mcap files older than this are deleted; 0: no limit
    keep_hours: Annotated[float, msgspec.Meta(ge=0)] = 0.0


class RecordingSettings(Section, frozen=True):
    """The content of recordings."""

    # whole keys of foreign images: CompressedImage in CDR, JPEG or PNG
    also: tuple[CellName, ...] = ()
    # whole frames a second; others as checksums; 0: every frame
    frames_hz: Annotated[float, msgspec.Meta(ge=0)] = 25.0


class LoopSettings(Section, frozen=True):
    """The loop's use of the processor."""

    # rehearse each tick before its deadline, which shortens it and takes 5 % of a core
    prepare: bool = True
    # no processor sleeps while the service runs: more power, shorter latency
    awake: bool = False


class Settings(Section, frozen=True):
    """All settings of one cell."""

    cell: CellName = "thirdhand"  # prefix of all keys on Zenoh
    # ticks of the loop in a second
    rate_hz: Annotated[int, msgspec.Meta(ge=RATES_HZ[0], le=RATES_HZ[1])] = 500
    loop: LoopSettings = msgspec.field(default_factory=LoopSettings)
    hands: HandSettings = msgspec.field(default_factory=HandSettings)
    trackers: dict[str, TrackerSettings] = {}
    tool: ToolSettings = msgspec.field(default_factory=ToolSettings)
    arm: ArmSettings = msgspec.field(default_factory=ArmSettings)
    joints: JointSettings = msgspec.field(default_factory=JointSettings)
    reach: Reach = msgspec.field(default_factory=Reach)
    table: TableTop = msgspec.field(default_factory=TableTop)
    people: People = msgspec.field(default_factory=People)
    obstacles: Obstacles = msgspec.field(default_factory=Obstacles)
    network: Network = msgspec.field(default_factory=Network)
    ros2: Ros2 = msgspec.field(default_factory=Ros2)
    files: Files = msgspec.field(default_factory=Files)
    recording: RecordingSettings = msgspec.field(default_factory=RecordingSettings)
    skill: SkillSettings = msgspec.field(default_factory=SkillSettings)

    def __post_init__(self) -> None:
        if problems := list(self._problems()):
            raise ValueError("\n".join(problems))

    def _problems(self) -> Iterator[str]:
        """Contradictions between values that are valid on their own."""
        unusable = list(self._unusable_numbers())
        yield from unusable
        if {".", ".."} & set(self.cell.split("/")):
            yield f"$.cell: {self.cell!r} given; no . or .. between the slashes accepted"
        if (size := len(self.cell.encode())) > MAX_CELL_BYTES:
            yield (
                f"$.cell: a name of {size} bytes given; at most {MAX_CELL_BYTES} accepted, as "
                "files have this name"
            )
        if unusable:
            return
        yield from self._problems_of_ros2()
        yield from self._problems_of_trackers()
        yield from self._problems_of_poses()
        if not math.hypot(*self.people.toward_elbow) > 1e-6:
            direction = list(self.people.toward_elbow)
            yield f"$.people.toward_elbow: {direction} given; a direction needed"
        yield from self._problems_of_speeds()
        if self.reach.inner >= self.reach.outer:
            yield (
                f"$.reach.inner: {self.reach.inner} given; less than $.reach.outer = "
                f"{self.reach.outer} needed"
            )
        yield from self._problems_of_joints()

    def _unusable_numbers(self) -> Iterator[str]:
        """Numbers that are not finite, too large or too small."""
        for path, value in _numbers(msgspec.to_builtins(self), "$"):
            if value != 0.0 and not SMALLEST_NUMBER <= abs(value) <= LARGEST_NUMBER:
                yield (
                    f"{path}: {value:g} given; a finite number, 0 or of a size from "
                    f"{SMALLEST_NUMBER:g} to {LARGEST_NUMBER:g}, accepted"
                )

    def _problems_of_ros2(self) -> Iterator[str]:
        domain = self.network.ros2_domain
        if domain is not None and not ros2.is_name(self.cell):
            yield (
                f"$.cell: {self.cell!r} given; with $.network.ros2_domain names of letters, digits "
                "and single _, none of them with a digit first, joined by slashes needed"
            )
        named = dict.fromkeys(topic.name for topic in ros2.of_settings(self.ros2))
        if named and domain is None:
            yield (
                f"$.network.ros2_domain: none given; for {', '.join(named)} one from 0 to "
                f"{ros2.LAST_DOMAIN} needed"
            )
        if self.ros2.joints and sorted(self.ros2.joints) != sorted(self.joints.names):
            yield (
                f"$.ros2.joints: {list(self.ros2.joints)} given; those of $.joints.names needed, "
                "in any order"
            )

    def _problems_of_trackers(self) -> Iterator[str]:
        for name in self.trackers:
            if not re.fullmatch(r"[\w./-]{1,64}", name):
                yield (
                    f"$.trackers: the frame {name!r} given; 1 to 64 letters, digits and _ . / - "
                    "accepted"
                )
            elif name in (BASE, self.hands.frame):
                yield (
                    f"$.trackers.{name}: the frame {name!r} given; another one than {BASE!r} and "
                    "$.hands.frame needed"
                )

    def _problems_of_poses(self) -> Iterator[str]:
        """Problems of the poses of trackers and tool."""
        poses = {
            "$.hands.base_from_tracker": self.hands.base_from_tracker,
            **{
                f"$.trackers.{name}.base_from_tracker": tracker.base_from_tracker
                for name, tracker in self.trackers.items()
            },
            "$.tool.plate_from_tool": self.tool.plate_from_tool,
        }
        for path, pose in poses.items():
            norm = math.hypot(*pose[3:])
            if max(map(abs, pose[:3])) > FARTHEST_FRAME_M:
                yield (
                    f"{path}: {list(pose[:3])} given; {FARTHEST_FRAME_M:g} m or less on each axis "
                    "accepted"
                )
            if abs(norm - 1.0) > 1e-3:
                yield (
                    f"{path}: quaternion {list(pose[3:])} has norm {norm:.4f}; norm 1 needed (x y "
                    "z w)"
                )

    def _problems_of_speeds(self) -> Iterator[str]:
        """Speeds of the tool that contradict its largest speed."""
        tool = self.tool
        if tool.fault_speed < tool.max_speed:
            yield (
                f"$.tool.fault_speed: {tool.fault_speed} given; "
                f"at least $.tool.max_speed = {tool.max_speed} needed"
            )
        if tool.engage_speed > max(tool.max_speed, ToolSettings().engage_speed):
            yield (
                f"$.tool.engage_speed: {tool.engage_speed} given; "
                f"at most $.tool.max_speed = {tool.max_speed} accepted"
            )

    def _problems_of_joints(self) -> Iterator[str]:
        count = len(self.joints.names)
        if not count or len(set(self.joints.names)) < count:
            yield (
                f"$.joints.names: {list(self.joints.names)} given; different names, 1 at least, "
                "needed"
            )
            return
        uneven = list(self._uneven_fields())
        yield from uneven
        if not uneven:
            yield from self._too_wide_limits()
            yield from self._problems_of_ranges()

    def _uneven_fields(self) -> Iterator[str]:
        """Fields that do not have one value for each joint."""
        count = len(self.joints.names)
        fields: dict[str, tuple[object, ...]] = {
            f"$.joints.{name}": getattr(self.joints, name) for name in LIMITS
        }
        fields |= {"$.arm.posture": self.arm.posture, "$.joints.kinds": self.joints.every_kind}
        for path, values in fields.items():
            if len(values) != count:
                quantity = "kinds" if path == "$.joints.kinds" else "numbers"
                needed = f"{count} needed, one for each of $.joints.names"
                yield f"{path}: {len(values)} {quantity}, {needed}"

    def _too_wide_limits(self) -> Iterator[str]:
        """Limits of the joints beyond the widest ones."""
        widest = self._widest()
        for name in LIMITS:
            limits = getattr(self.joints, name)
            for i, (limit, bound) in enumerate(zip(limits, widest[name], strict=True)):
                path = f"$.joints.{name}[{i}]"
                if name == "lower" and limit < bound:
                    yield f"{path}: {limit} given; {bound} or more accepted"
                if name == "upper" and limit > bound:
                    yield f"{path}: {limit} given; {bound} or less accepted"
                if name not in ("lower", "upper") and not 0 < limit <= bound:
                    yield f"{path}: {limit} given; above 0, up to {bound} accepted"

    def _problems_of_ranges(self) -> Iterator[str]:
        """Empty ranges of joints, and postures outside."""
        for i, (low, high, position) in enumerate(
            zip(self.joints.lower, self.joints.upper, self.arm.posture, strict=True)
        ):
            if not low < high:
                yield (
                    f"$.joints.lower[{i}]: {low} given; less than $.joints.upper[{i}] = {high} "
                    "needed"
                )
            elif not low <= position <= high:
                yield f"$.arm.posture[{i}]: {position} given; {low} to {high} accepted"

    def _widest(self) -> dict[str, PerJoint]:
        """Bounds of the limits: the defaults for the shipped arm, infinity for others."""
        if not self.arm.urdf:
            return dict(
                zip(JointSettings.__struct_fields__, JointSettings.__struct_defaults__, strict=True)
            )
        n = len(self.joints.names)
        return {name: (-math.inf if name == "lower" else math.inf,) * n for name in LIMITS}

    @property
    def tracker_frames(self) -> tuple[str, ...]:
        """Names of the frames that a hand's pose may have; the empty name stands for the frame of
        `[hands]`.
        """
        hand_frames = () if self.hands.frame in ("", BASE) else (self.hands.frame,)
        return (BASE, *hand_frames, "", *self.trackers)

    def tracker_section(self, frame: str) -> str:
        """The table that maps poses in a frame."""
        return f"[trackers.{frame}]" if frame in self.trackers else "[hands]"

    def hands_in(self, frame: str) -> HandSettings:
        """`[hands]` for poses in a frame: with the frame, unit and pose of its tracker, if it has
        settings of its own.
        """
        if (tracker := self.trackers.get(frame)) is None:
            return self.hands
        of_tracker = {
            "unit": tracker.unit,
            "axes": tracker.axes,
            "base_from_tracker": tracker.base_from_tracker,
        }
        return msgspec.structs.replace(self.hands, frame=frame, **of_tracker)

    @property
    def period_s(self) -> float:
        """Duration of one tick [s]."""
        return 1.0 / self.rate_hz

    def ticks_in(self, duration_s: float) -> int:
        """Number of ticks that last at least this time [s]. The quotient is rounded to 6 decimals
        first, so that the period's rounding does not add a tick.
        """
        return math.ceil(round(duration_s / self.period_s, 6))

    @property
    def frame_every(self) -> int:
        """Ticks from one whole frame of a recording to the next."""
        return (
            max(1, round(self.rate_hz / self.recording.frames_hz))
            if self.recording.frames_hz
            else 1
        )


def without_secrets(settings: Settings) -> Settings:
    """The settings without the parameters of endpoints, which may hold keys."""
    network = settings.network
    listen, connect = (
        tuple(endpoint.partition("#")[0] for endpoint in endpoints)
        for endpoints in (network.listen, network.connect)
    )
    return msgspec.structs.replace(
        settings, network=msgspec.structs.replace(network, listen=listen, connect=connect)
    )


def urdf_path(settings: Settings) -> Path:
    """The path of the arm's URDF."""
    return Path(settings.arm.urdf).expanduser() if settings.arm.urdf else WAM


def robot_description(settings: Settings) -> str:
    """The arm's URDF, with a capsule around each collision mesh. Raises SettingsError."""
    return description(urdf_path(settings), settings.arm.packages)


def _numbers(value: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _numbers(inner, f"{path}.{name}")
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _numbers(inner, f"{path}[{i}]")
    elif isinstance(value, float):
        yield path, value


def _make_paths_absolute(given: Any, folder: Path | None) -> None:
    """Make every path absolute, so that its meaning no longer depends on a folder. Raises
    SettingsError.
    """
    sections = given if isinstance(given, dict) else {}
    for section, name in (*FROM_FOLDER, *FROM_HERE):
        table = sections.get(section)
        if not isinstance(table, dict):
            continue
        value = table.get(name)
        base = folder if folder is not None and (section, name) in FROM_FOLDER else Path()
        if isinstance(value, str):
            table[name] = _absolute(value, base, f"[{section}] {name}")
        elif isinstance(value, list | tuple):
            table[name] = [
                _absolute(entry, base, f"[{section}] {name}, entry {i + 1}")
                if isinstance(entry, str)
                else entry
                for i, entry in enumerate(value)
            ]


def _absolute(value: str, base: Path, where: str) -> str:
    """An absolute path; a relative `value` starts from `base`, an empty one remains empty. Raises
    SettingsError.
    """
    if "\0" in value:
        raise SettingsError(f"{where}: {value!r} given; a path holds no zero bytes")
    try:
        return str((base / Path(value).expanduser()).absolute()) if value else ""
    except RuntimeError:
        raise SettingsError(
            f"{where}: {value!r} given; no user of this name has a folder here"
        ) from None


def converted(given: Any, *, origin: str, folder: Path | None = None) -> Settings:
    """Settings from the content of a TOML file; `origin` names it in errors. Raises SettingsError.

    Relative paths of URDF, packages, skill, certificate and Zenoh configuration start from
    `folder`, those of other files from the current folder; all become absolute here. For an arm
    with its own URDF, settings that are not given are taken from the URDF; no limit may be wider
    than the URDF's.
    """
    try:
        _make_paths_absolute(given, folder)
        arm, reach = (
            given.get(name) if isinstance(given, dict) else None for name in ("arm", "reach")
        )
        if isinstance(arm, dict) and isinstance(arm.get("urdf"), str) and arm["urdf"]:
            urdf_text = description(
                urdf_path(Settings(arm=ArmSettings(urdf=arm["urdf"]))), cover=False
            )
            given = completed(given, Urdf(urdf_text, origin=arm["urdf"]))
        settings = validated(given, Settings)
        urdf = Urdf(robot_description(settings), origin=settings.arm.urdf or WAM.name)
        check(settings.joints, urdf, settings.arm.plate)
        if settings.arm.urdf:
            settings = _with_reach(settings, urdf, set(reach) if isinstance(reach, dict) else set())
    except (UrdfError, SettingsError, InvalidError) as error:
        kind = UnreadableError if isinstance(error, UnreadableError) else SettingsError
        raise kind(f"{origin}: {error}") from None
    return settings


def _with_reach(settings: Settings, urdf: Urdf, given: set[str]) -> Settings:
    """The settings with a reach from the arm's kinematics, except for the `given` fields of it.

    Raises SettingsError if the arm reaches too small a share of it.
    """
    # its import is slow, and few arms need it
    from thirdhand.settings.reachable import Shell, workspace_of

    workspace = workspace_of(
        urdf.chain(settings.arm.plate),
        settings.joints.lower,
        settings.joints.upper,
        settings.tool.plate_from_tool,
    )
    reach = settings.reach
    shell = workspace.shell(reach.min_x, reach.min_z)
    if shell.outer < LEAST_OUTER_M:
        raise SettingsError(
            f"[arm] plate: its joints move the tool by {1000 * shell.outer:.0f} mm; an arm that "
            "moves it, or a pose of the tool away from the last axis ([tool] plate_from_tool), "
            "needed"
        )

    outer = reach.outer if "outer" in given else min(shell.outer, reach.outer)
    inner = reach.inner if "inner" in given else min(shell.inner, shell.inner / shell.outer * outer)
    centre = reach.centre if "centre" in given else shell.centre
    reach = msgspec.structs.replace(reach, centre=centre, inner=inner, outer=outer)
    share = workspace.share(Shell(reach.centre, reach.inner, reach.outer), reach.min_x, reach.min_z)
    needed = REACHED_SHARE if given & {"centre", "inner", "outer"} else LEAST_REACHED_SHARE
    if share < needed:
        raise SettingsError(
            f"[reach]: the arm reaches {100 * share:.0f} % of it; at least {100 * needed:.0f} % "
            f"needed. By its kinematics the tool is {shell.inner:g} to {shell.outer:g} m from "
            f"{list(shell.centre)}; min_x = {reach.min_x:g} and min_z = {reach.min_z:g} given"
        )
    return msgspec.structs.replace(settings, reach=reach)


def _of_cell(given: dict[str, Any], cell: str, origin: str) -> dict[str, Any]:
    """The content of a file for one of its cells: all tables outside `[cells]`, with the values of
    `[cells.NAME]` in place of theirs. Raises SettingsError.
    """
    cells = given.pop("cells", {})
    if not isinstance(cells, dict) or not all(isinstance(table, dict) for table in cells.values()):
        raise SettingsError(
            f"{origin}: [cells]: tables by the cells' names needed, like [cells.bench1.tool]"
        )
    if not cells and not cell:
        return given
    if cell not in cells:
        problem = f"cell {cell!r} given" if cell else "no cell given"
        accepted = f"FILE.toml:NAME with one of {', '.join(cells)} needed"
        if not cells:
            accepted = "the file has no tables [cells.NAME]; FILE.toml alone needed"
        raise SettingsError(f"{origin}: {problem}; {accepted}")
    return _merged(given | {"cell": cell}, cells[cell])


def _merged(given: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    pairs = {name: (given.get(name), value) for name, value in changes.items()}
    return given | {
        name: _merged(before, value)
        if isinstance(before, dict) and isinstance(value, dict)
        else value
        for name, (before, value) in pairs.items()
    }


def parse(text: str, *, origin: str, folder: Path | None = None, cell: str = "") -> Settings:
    """Settings from TOML text, of one of its cells if it has `[cells]`; see `converted`. Raises
    SettingsError.
    """
    try:
        content = toml_in(text)
    except ValueError as error:  # also of a number with too many digits
        raise SettingsError(f"{origin}: {error}") from None
    content = _of_cell(content, cell, origin)
    return converted(content, origin=origin, folder=folder)


def load(path: Path, cell: str = "") -> Settings:
    """Settings from a TOML file, of one of its cells. Raises SettingsError, UnreadableError."""
    try:
        text = text_in(path, accepts_pipes=True)
    except (OSError, UnusableError) as error:
        raise UnreadableError(
            f"cannot read configuration {path}: {in_words(error, named=False)}"
        ) from None
    return parse(text, origin=str(path), folder=path.parent, cell=cell)
