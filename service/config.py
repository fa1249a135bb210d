"""Settings of one cell: a TOML file, validated whole before anything starts. Units stand in the names, defaults are safe."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from service.explain import explained

ENDPOINT = "tcp/127.0.0.1:7447"  # where a daemon listens and its clients look for it, unless told otherwise
Positive = Annotated[float, msgspec.Meta(gt=0)]
Cell = Annotated[
    str,
    msgspec.Meta(pattern=r"\A[^/*$?#\s\0]+(/[^/*$?#\s\0]+)*\Z", extra={"accepted": "words joined by single slashes, without spaces and * $ ? #,"}),
]
Pose7 = tuple[float, float, float, float, float, float, float]  # x y z [m], quaternion x y z w
Joints7 = tuple[float, float, float, float, float, float, float]


class ExplainedError(Exception):
    """An error whose message tells people what failed, what was given and what is accepted: commands print it and exit 1."""


class SettingsError(ExplainedError, ValueError):
    """A configuration that cannot be used: names the field, what was given and what is accepted."""


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of the file; an unknown name in it is an error."""


class Hands(Section, frozen=True):
    """How a tracker's poses become hand positions in frame `base`."""

    unit: Literal["m", "cm", "mm"] = "m"
    base_from_tracker: Pose7 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # applied after the unit
    noise_std_m: Positive = 0.0005  # of one sample, each axis
    jerk_density: Positive = 0.03  # [m²/s⁵] of the constant-acceleration Kalman filter
    stale_ms: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0


class Tool(Section, frozen=True):
    """The tool: where it sits on the tool plate, and how fast it may move."""

    plate_from_tool: Pose7 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    max_speed: Annotated[float, msgspec.Meta(gt=0, le=0.8)] = 0.8  # [m/s] as a norm
    max_acceleration: Annotated[float, msgspec.Meta(gt=0, le=4)] = 4.0  # [m/s²] each axis
    max_jerk: Annotated[float, msgspec.Meta(gt=0, le=200)] = 200.0  # [m/s³] each axis
    fault_speed: Annotated[float, msgspec.Meta(gt=0, le=1.5)] = 1.0  # [m/s] measured
    bandwidth: Positive = 20.0  # [rad/s] of the critically damped tracker


class Arm(Section, frozen=True):
    """The arm: where its joint states come from, its posture when none come, and when following it is a fault."""

    source: Literal["state", "assumed"] = "state"
    posture: Joints7 = (0.1761, 0.8604, -0.5, 2.5414, -0.4273, -1.0823, 0.0)  # [rad] the null space's and the assumed one
    fault_error_rad: Positive = 0.1
    silent_ms: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0


class JointLimits(Section, frozen=True):
    """The limits that no command ever leaves [rad, rad/s, rad/s², rad/s³]; all can be lowered."""

    lower: Joints7 = (-2.6, -1.985, -2.8, -0.9, -4.55, -1.5707, -2.7)
    upper: Joints7 = (2.6, 1.985, 2.8, 3.1, 1.24, 1.5707, 2.7)
    velocity: Joints7 = (1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5)
    acceleration: Joints7 = (6.0, 9.0, 15.0, 20.0, 20.0, 20.0, 20.0)
    jerk: Joints7 = (300.0, 450.0, 500.0, 500.0, 500.0, 500.0, 500.0)


class Reach(Section, frozen=True):
    """Where targets may lie: a shell around the shoulder, in front of the base plate and above the table [m]."""

    inner: Positive = 0.35
    outer: Annotated[float, msgspec.Meta(gt=0, le=0.9)] = 0.88
    min_x: Annotated[float, msgspec.Meta(ge=-1, le=1)] = 0.15
    min_z: Annotated[float, msgspec.Meta(ge=-1, le=1)] = 0.02


class Network(Section, frozen=True):
    """Zenoh endpoints. Nothing is announced by multicast; peers are named."""

    listen: tuple[str, ...] = (ENDPOINT,)
    connect: tuple[str, ...] = ()


class Files(Section, frozen=True):
    """Where skills are read, and taught places, recordings and viewer files are written."""

    skills: str = ""  # a folder; empty: the shipped recordings
    state: str = "~/.local/state/thirdhand"
    record: str = ""  # a folder; empty: nothing is recorded
    rerun: bool = True  # with each recording an .rrd file


class Settings(Section, frozen=True):
    """All settings of one cell."""

    cell: Cell = "thirdhand"
    rate_hz: Annotated[int, msgspec.Meta(ge=50, le=1000)] = 500
    hands: Hands = msgspec.field(default_factory=Hands)
    tool: Tool = msgspec.field(default_factory=Tool)
    arm: Arm = msgspec.field(default_factory=Arm)
    joints: JointLimits = msgspec.field(default_factory=JointLimits)
    reach: Reach = msgspec.field(default_factory=Reach)
    network: Network = msgspec.field(default_factory=Network)
    files: Files = msgspec.field(default_factory=Files)

    def __post_init__(self) -> None:
        for path, value in _numbers(msgspec.to_builtins(self), "$"):
            if not math.isfinite(value):
                raise ValueError(f"{path}: {value} given; a finite number needed")
        if {".", ".."} & set(self.cell.split("/")):
            raise ValueError(f"$.cell: {self.cell!r} given; no . or .. between the slashes accepted")
        for path, pose in (("$.hands.base_from_tracker", self.hands.base_from_tracker), ("$.tool.plate_from_tool", self.tool.plate_from_tool)):
            norm = math.hypot(*pose[3:])
            if abs(norm - 1.0) > 1e-3:
                raise ValueError(f"{path}: quaternion {list(pose[3:])} has norm {norm:.4f}; norm 1 needed (x y z w)")
        if self.tool.fault_speed < self.tool.max_speed:
            raise ValueError(f"$.tool.fault_speed: {self.tool.fault_speed} given; at least $.tool.max_speed = {self.tool.max_speed} needed")
        if self.reach.inner >= self.reach.outer:
            raise ValueError(f"$.reach.inner: {self.reach.inner} given; less than $.reach.outer = {self.reach.outer} needed")
        widest = JointLimits.__struct_defaults__
        for field, bounds in zip(JointLimits.__struct_fields__, widest, strict=True):
            for i, (given, bound) in enumerate(zip(getattr(self.joints, field), bounds, strict=True)):
                if field == "lower" and given < bound:
                    raise ValueError(f"$.joints.lower[{i}]: {given} given; {bound} or more accepted")
                if field == "upper" and given > bound:
                    raise ValueError(f"$.joints.upper[{i}]: {given} given; {bound} or less accepted")
                if field not in ("lower", "upper") and not 0 < given <= bound:
                    raise ValueError(f"$.joints.{field}[{i}]: {given} given; above 0, up to {bound} accepted")
        for i, (low, high, at) in enumerate(zip(self.joints.lower, self.joints.upper, self.arm.posture, strict=True)):
            if not low < high:
                raise ValueError(f"$.joints.lower[{i}]: {low} given; less than $.joints.upper[{i}] = {high} needed")
            if not low <= at <= high:
                raise ValueError(f"$.arm.posture[{i}]: {at} given; {low} to {high} accepted")

    @property
    def period_s(self) -> float:
        """Duration of one tick [s]."""
        return 1.0 / self.rate_hz


def _numbers(value: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _numbers(inner, f"{path}.{name}")
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _numbers(inner, f"{path}[{i}]")
    elif isinstance(value, float):
        yield path, value


def converted(given: Any, *, origin: str) -> Settings:
    """Settings from what a TOML file holds; `origin` names it in errors. Raises SettingsError."""
    try:
        return msgspec.convert(given, Settings)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{origin}: {explained(error, given, Settings)}") from None


def parse(text: str, *, origin: str) -> Settings:
    """Settings from TOML text; `origin` names it in errors. Raises SettingsError."""
    try:
        given = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{origin}: {error}") from None
    return converted(given, origin=origin)


def load(path: Path) -> Settings:
    """Settings from a TOML file. Raises SettingsError."""
    try:
        return parse(path.read_text(encoding="utf-8"), origin=str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"cannot read configuration {path}: {error}") from None
