"""Where the chunks of a policy that answers late meet: error, lag and jerk of a tool that follows
its wishes, beside queues of the field.

The policy knows the path that is meant, and that what it sees of the arm is late. Each answer
begins as far from the path as it saw the tool then, nears it, and is off it by a distance of its
own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.random import Generator, default_rng
from scipy.interpolate import CubicSpline

from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.contract.records import FARTHEST_WISH_S
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Event, Tick
from thirdhand.core.separation import FARTHEST_REPORTED_M
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.recordings.shipped import recordings
from thirdhand.settings.config import Settings, SkillSettings, robot_description
from thirdhand.skills.no_skill import no_skill
from thirdhand.workbench.takes.demonstration_reader import read_demonstration
from thirdhand_sim.closed_loop import START_NS
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.people.moving_hands import PERIOD_S
from thirdhand_sim.lab.results import (
    ADAPTED,
    OTHER,
    REFERENCE,
    TOOL_COLOUR,
    Array,
    Options,
    Results,
    brief,
    pyplot,
)
from thirdhand_sim.lab.rivals.chunk_queues import QUEUES, Chunk, Queue, QueuedArm

OURS = "wishes"
BEFORE_PATH_S = 5.0  # the path begins after this time, in which the arm moves to its begin
POLICY_RATES_HZ = (15, 30, 50)
CHUNK_STEPS = (8, 50)  # of a chunk, least and most
ANSWERS_S = (0.05, 0.8)  # mean time of an answer
ARM_LAGS_S = (0.03, 0.15)  # of what the policy sees behind the command
APART_M = (0.0, 0.02, 0.07)  # largest distance between two chunks at their seam
EARLY = 0.2  # share of the chunks that end early
COVERED = {True: "chunks overlap", False: "answers come later than chunks end"}
NEARS_S = 0.3  # time constant with which an answer nears the path
STOPPING_MPS = 0.05  # below this speed of the path a tool that rests has not stopped
SEAM_LAGS_S = np.arange(-0.1, 0.5, 0.01)


class Seam(NamedTuple):
    """A policy's habits."""

    rate_hz: int
    steps: int
    answer_s: float
    arm_lag_s: float
    apart_m: float

    @classmethod
    def drawn(cls, rng: Generator, apart_m: float) -> Seam:
        """Habits drawn evenly; the time of an answer on a logarithmic scale."""
        answer_s = np.exp(rng.uniform(*np.log(ANSWERS_S)))
        lag_s = rng.uniform(*ARM_LAGS_S)
        steps = rng.integers(CHUNK_STEPS[0], CHUNK_STEPS[1] + 1)
        return cls(
            int(rng.choice(POLICY_RATES_HZ)), int(steps), float(answer_s), float(lag_s), apart_m
        )


STEADY_POLICY = Seam(30, 30, 0.2, 0.05, 0.0)


class PolicyArm(Protocol):
    """An arm that a policy leads."""

    @property
    def tool(self) -> Array:
        """The tool's position (3,) [m]."""

    def take(self, chunk: Chunk, now_s: float) -> None:
        """Take a chunk that arrives now."""

    def step(self, now_s: float) -> Array:
        """Move for one period. Returns the joints' motion (3, J)."""


class LatePolicy:
    """A policy that answers one observation after the other."""

    def __init__(self, path: Array, habits: Seam, rng: Generator) -> None:
        self._path = path
        self._habits = habits
        self._rng = rng
        self._answer: Chunk | None = None
        self._arrives_s = 0.0
        self._is_first = True

    def answers(self, now_s: float, tool: Array) -> Chunk | None:
        """The answer that arrives now, if one does; `tool` (3,) [m] is what the policy sees."""
        if self._answer is None:
            seen_s = np.array([now_s - self._habits.arm_lag_s])
            self._answer = self._chunk(now_s, tool - meant_at(self._path, seen_s)[0])
            takes_s = self._habits.answer_s * self._rng.uniform(0.7, 1.3)
            self._arrives_s = now_s + takes_s * (2.0 if self._is_first else 1.0)
            self._is_first = False
        if now_s < self._arrives_s:
            return None
        answer = self._answer
        self._answer = None
        return answer

    def _chunk(self, now_s: float, seen_off: Array) -> Chunk:
        rng = self._rng
        habits = self._habits
        steps = habits.steps
        if rng.random() < EARLY:
            steps = max(2, int(0.4 * steps))
        ahead_s = np.arange(steps) / habits.rate_hz
        meant = meant_at(self._path, now_s + ahead_s)
        nearing = np.exp(-ahead_s / NEARS_S)[:, None]
        direction = rng.normal(size=3)
        off = rng.uniform(0.0, habits.apart_m / 2) * direction / np.linalg.norm(direction)
        return Chunk(now_s + ahead_s, meant + nearing * seen_off + (1.0 - nearing) * off)


def meant_at(path: Array, times_s: Array) -> Array:
    """Positions (M, 3) of a path (N, 3) [m] with one point a tick."""
    ticks = np.clip(times_s / PERIOD_S, 0, len(path) - 1)
    return np.stack([np.interp(ticks, np.arange(len(path)), axis) for axis in path.T], axis=1)


class OurArm:
    """The service's core, which keeps no distance from people and things, as the rivals."""

    def __init__(self, settings: Settings, tuning: Tuning = TUNING) -> None:
        self._controller = Controller(
            settings, no_skill(), urdf=robot_description(settings), tuning=tuning
        )
        self._index = -1
        self._events: list[Event] = []
        self._frame = self._controller.step(Tick(0, (), START_NS))
        self.orientation = self._frame["tool_orientation"].copy()
        self._turned = tuple(self.orientation.tolist())
        self._index = 0

    @property
    def tool(self) -> Array:
        return np.array(self._frame["tool"])

    def take(self, chunk: Chunk, now_s: float) -> None:
        for due_s, position in zip(chunk.due_s, chunk.positions.tolist(), strict=True):
            if due_s - now_s < FARTHEST_WISH_S:
                stamp_ns = START_NS + round(1e9 * due_s)
                wish = PoseStamped(stamp_ns, BASE, tuple(position), self._turned)
                self._events.append(Event("tool/wish", b"", wish))

    def step(self, now_s: float) -> Array:
        self._index += 1
        tick = Tick(self._index, tuple(self._events), START_NS + round(1e9 * now_s))
        self._events = []
        self._frame = frame = self._controller.step(tick)
        return np.stack(
            [frame[name] for name in ("joints", "joint_velocities", "joint_accelerations")]
        )


class PolicyRun(NamedTuple):
    """The tool's path (N, 3) [m] of a run, its joints' motion (N, 3, J), and times of answers."""

    tool: Array
    joints: Array
    answers_s: list[float]


def led(arm: PolicyArm, path: Array, habits: Seam, seed: tuple[int, ...]) -> PolicyRun:
    """The motion of an arm that a policy leads along a path."""
    policy = LatePolicy(path, habits, default_rng(seed))
    lag = round(habits.arm_lag_s / PERIOD_S)
    tools = [arm.tool]
    joints = []
    answers_s = []
    for k in range(1, len(path)):
        now_s = k * PERIOD_S
        chunk = policy.answers(now_s, tools[max(k - 1 - lag, 0)])
        if chunk is not None:
            arm.take(chunk, now_s)
            answers_s.append(now_s)
        joints.append(arm.step(now_s))
        tools.append(arm.tool)
    return PolicyRun(np.array(tools[1:]), np.array(joints), answers_s)


def figures(run: PolicyRun, path: Array, settings: Settings) -> dict[str, float]:
    """What is judged of a run, from the path's begin on."""
    begin = round((BEFORE_PATH_S - 0.5) / PERIOD_S)
    tool = run.tool[begin:]
    meant = path[1:][begin:]
    velocity = np.diff(tool, axis=0) / PERIOD_S
    wanted = np.diff(meant, axis=0) / PERIOD_S
    speed = np.linalg.norm(wanted, axis=1)
    along = (velocity * wanted).sum(axis=1) / np.maximum(speed, 1e-9)
    moving = speed > STOPPING_MPS
    errors = np.linalg.norm(tool - meant, axis=1)
    limits = settings.joints
    acceleration = run.joints[begin:, 2] / limits.acceleration
    jerk = np.diff(run.joints[begin:, 2], axis=0) / PERIOD_S / limits.jerk
    third = np.diff(tool, n=3, axis=0) / PERIOD_S**3
    return {
        "error_mm": 1e3 * float(np.sqrt(np.mean(errors**2))),
        "lag_ms": 1e3 * _lag_s(tool, meant),
        "joint_acceleration": float(np.abs(acceleration).max()),
        "joint_jerk": float(np.abs(jerk).max()),
        "tool_acceleration": float(np.linalg.norm(np.diff(velocity, axis=0), axis=1).max())
        / PERIOD_S,
        "tool_jerk_rms": float(np.sqrt((third**2).sum(axis=1).mean())),
        "back_mm": 1e3 * PERIOD_S * float(np.maximum(-along[moving], 0.0).sum()),
        "stopped": float((np.abs(along[moving]) < 0.1 * speed[moving]).mean()),
    }


def _lag_s(tool: Array, meant: Array) -> float:
    """The lag with which the tool is nearest to the path."""
    ticks = np.arange(len(meant))
    squares = []
    for lag_s in SEAM_LAGS_S:
        shifted = meant_at(meant, (ticks * PERIOD_S) - lag_s)
        squares.append(float(((tool - shifted) ** 2).sum()))
    return float(SEAM_LAGS_S[int(np.argmin(squares))])


def tool_paths(folder: Path, share: float) -> dict[str, Array]:
    """The tools' paths (N, 3) [m] of a share of the takes in a folder, one point a tick, after a
    rest.
    """
    files = sorted(folder.glob("demonstration-*.mcap"))
    paths = {}
    for file in files[: math.ceil(share * len(files))]:
        take = read_demonstration(file)
        times_s = (take.stamps_ns - take.stamps_ns[0]) / 1e9
        even_s = np.arange(0.0, times_s[-1], PERIOD_S)
        path = CubicSpline(times_s, take.tool[:, :3])(even_s)
        rest = np.tile(path[0], (round(BEFORE_PATH_S / PERIOD_S), 1))
        paths[file.stem] = np.vstack([rest, path])
    return paths


def cell() -> Settings:
    """The shipped cell, without an arm, people and things; wishes lead."""
    settings = Settings()
    return msgspec.structs.replace(
        settings,
        arm=msgspec.structs.replace(settings.arm, source="assumed"),
        skill=SkillSettings(source="tool/wish"),
        people=msgspec.structs.replace(settings.people, clearance=-FARTHEST_REPORTED_M),
        obstacles=msgspec.structs.replace(settings.obstacles, clearance=-FARTHEST_REPORTED_M),
    )


def run(results: Results, options: Options) -> dict[str, Any]:
    """The figures of all followers on the paths of evaluation, each rival with the number that is
    best on the paths of tuning.
    """
    settings = cell()
    seeds = EXPERIMENTS["seams"].seeds
    orientation = OurArm(settings).orientation
    arms: dict[str, Callable[[], PolicyArm]] = {OURS: lambda: OurArm(settings)}
    tried: dict[str, dict[float, float]] = {}
    paths = tool_paths(recordings(), options.share)
    draws = seeds.tuning["policies"].share(options.share)
    for name, (queue, numbers) in QUEUES.items():
        behind = {
            number: partial(_queued, queue, number, settings, orientation) for number in numbers
        }
        tried[name] = {
            number: _mean(_all_runs(made, paths, draws, settings), "error_mm")
            for number, made in behind.items()
        }
        arms[name] = behind[min(numbers, key=tried[name].__getitem__)]
        results.say(f"{name}: {brief(tried[name])}")

    paths = tool_paths(recordings() / "people", options.share)
    draws = seeds.evaluation["policies"].moved(options.seed_offset).share(options.share)
    judged: dict[str, Any] = {}
    for name, made in arms.items():
        by_run = _all_runs(made, paths, draws, settings)
        judged[name] = {key: _mean(by_run, key) for key in by_run[0] if key != "covered"}
        for covered in (True, False):
            part = [row for row in by_run if row["covered"] == covered]
            if part:  # of a quick look, there may be none
                judged[name]["error_mm, " + COVERED[covered]] = _mean(part, "error_mm")
        results.say(f"{name}: {brief(judged[name])}")
    _draw(results, arms, next(iter(paths.values())), settings)
    changed = {
        f"{name}, x{factor:g}": _mean(
            _all_runs(partial(_with, settings, name, factor), paths, draws[:1], settings),
            "error_mm",
        )
        for name in TUNING.wish._fields
        for factor in (0.5, 1.0, 2.0)
    }
    results.say(brief(changed))
    return {
        "followers": judged,
        "tuning": tried,
        "sensitivity": changed,
        "runs": len(paths) * len(draws),
    }


def _with(settings: Settings, name: str, factor: float) -> OurArm:
    """Our arm with one tuned number multiplied by a factor."""
    wish = TUNING.wish._replace(**{name: factor * getattr(TUNING.wish, name)})
    return OurArm(settings, TUNING._replace(wish=wish))


def _queued(
    queue: Callable[[float], Queue], number: float, settings: Settings, orientation: Array
) -> QueuedArm:
    return QueuedArm(queue(number), settings, orientation)


def _all_runs(
    made: Callable[[], PolicyArm], paths: Mapping[str, Array], draws: range, settings: Settings
) -> list[dict[str, float]]:
    """The figures of each path with each policy."""
    rows = []
    for number, path in enumerate(paths.values()):
        for draw in draws:
            habits = Seam.drawn(default_rng((draw, number)), APART_M[draw % len(APART_M)])
            row = figures(led(made(), path, habits, (draw, number, 1)), path, settings)
            covers_s = (habits.steps - 1) / habits.rate_hz
            rows.append(row | {"covered": covers_s > 2.6 * habits.answer_s})
    return rows


def _mean(rows: list[dict[str, float]], key: str) -> float:
    """The mean of a figure; of limits and accelerations the largest."""
    values = [row[key] for row in rows]
    return float(max(values) if "acceleration" in key or "joint" in key else np.mean(values))


def _draw(
    results: Results, arms: Mapping[str, Callable[[], PolicyArm]], path: Array, settings: Settings
) -> None:
    """One coordinate of a tool that each follower leads, with the same policy."""
    plt = pyplot()
    shown = {OURS: TOOL_COLOUR, "temporal ensemble": OTHER, "replaced": ADAPTED}
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(9, 5), sharex=True)
    habits = Seam(30, 24, 0.35, 0.1, 0.07)
    begin = round((BEFORE_PATH_S + 1.0) / PERIOD_S)
    end = begin + round(4.0 / PERIOD_S)
    times_s = np.arange(begin, end) * PERIOD_S - BEFORE_PATH_S
    axis = int(np.ptp(path[begin:end], axis=0).argmax())
    for name, colour in shown.items():
        made = led(arms[name](), path, habits, (7,))
        upper.plot(times_s, 1e3 * made.tool[begin:end, axis], color=colour, lw=1.2, label=name)
        speed = np.gradient(made.tool[:, axis], PERIOD_S)
        lower.plot(times_s, speed[begin:end], color=colour, lw=1.0)
    upper.plot(times_s, 1e3 * path[begin:end, axis], "--", color=REFERENCE, label="meant")
    for answer_s in made.answers_s:
        if times_s[0] < answer_s - BEFORE_PATH_S < times_s[-1]:
            lower.axvline(answer_s - BEFORE_PATH_S, color=REFERENCE, lw=0.4)
    upper.set_ylabel(f"{'xyz'[axis]} of the tool [mm]")
    lower.set(ylabel="its speed [m/s]", xlabel="time [s]; lines: a chunk arrives")
    upper.legend(frameon=False, ncols=4)
    results.figure(figure)
