"""Change of what the other experiments measure when a tuned number of the core is halved or
doubled, compared with the noise of each figure: its standard deviation over other seeds.

The numbers are module constants that Numba compiles into the code, and compiling takes a minute. So
this module, run as a program, loads the service with each use of a number replaced by a read from
memory (`ReadsNumbers`). It is compiled once. Each value is then measured in a fork of that process,
which writes the value to this memory first. Each read leaves a mark, so a number is measured only
in the sessions that read it; a number that none reads is not exercised.
"""

from __future__ import annotations

from service.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import ast
import copy
import functools
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import numba
import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sim.experiments.results import ExperimentError

if TYPE_CHECKING:  # the rest of the service is imported after `begin`
    from service.learning.skill_file import StoredSkill
    from service.settings.config import Settings
    from sim.experiments.catalogue import Stream
    from sim.experiments.people.left_out import LeftOut
    from sim.experiments.people.moving_hands import Moving
    from sim.experiments.rehearsal import Rehearsed
    from sim.experiments.results import Array, Options, Results

Figures: TypeAlias = dict[str, dict[str, float]]
"""By session, the figures by name."""
Session: TypeAlias = Callable[[int], dict[str, float]]
"""From the number of a seed, below EACH, to figures by name."""

ROOT = Path(__file__).parents[2]
PROBABILITIES = ("MODE_PRIOR",)  # numbers that sum to 1
LARGEST_CHANGED = {
    "PLANNED_LIMIT_SHARES": 1.0,
    "LEAST_STAGE_PROBABILITY": 1 / 64,
}  # numbers that the code needs below a limit
STAGES = ("intake", "skill", "setpoint", "arm", "separation", "limiter", "decision")  # in the order of measurement
FACTORS = (0.5, 2.0)
EVENTS = ("handover", "grasp", "carry")
MADE, UNTOLD_KIND, TURNED_KIND = (
    "three",
    "one_hand",
    "heading",
)  # kinds of made tasks: for `partners`, `untold`, `turned`
SOFT_JERK = 5.0  # [m/s³] of a tool that is moved softly
AT_REST_S = 0.3  # at the end of a stop
BOX = ((0.52, -0.2, 0.36), (0.08, 0.04, 0.3))  # centre and half size [m] of a box on the way to the handover
MOTION_S, CALM_S = 4.0, 2.5  # length of the sequences
SLOW_MPS, APART_M = 0.005, 0.04  # speed of a slow hand; distance between the positions of two sources
UNSEEN_S, TWO_S = (2.0, 0.3), (3.0, 1.0)  # middle and length of the time without one hand, and with two sources
BURSTS, BURST, BURST_M = 4, (1, 5), (0.05, 0.4)  # bursts of outliers: how many, of how many samples, how far away
EXCHANGED_S = (3.0, 0.3)  # middle and length of the time in which the tracker takes each hand for the other one
RATE_HZ, RESTING_HANDS_S = 250, 8.0  # of the sessions with resting hands
CLOSED_M = 0.06  # half size of a box around a target, which the tool then does not reach
DETOUR_RAD = 0.15  # a way out goes so far aside at each joint
INSIDE_M = 0.005  # distance of a box and the arm, inside of the clearance
LOST_S = {"briefly": (2.0, 0.75), "for long": (2.0, 1.5)}  # middle and length of the time without one hand
TIMETABLE_S, SHOWN_HZ, SHOWN = 3.0, 100, 6  # a tool's way after a hand has begun; rate and number of demonstrations
TIMED_REST_S, TIMED_HANDS_S = (0.5, 1.0), (1.5, 4.0)  # hands rest at first, and then move for so long
IMPLAUSIBLE_S, IMPLAUSIBLE_EACH = 8.0, 7  # length of the session, and one of how many samples is implausible
TREMBLE_RAD, TREMBLE_S = 0.05, 2.0  # an arm trembles by this at first; until when, ever less
JOINTS_OFF_RAD, JOINTS_RADPS = (0.05, 0.6), (20.0, 300.0)  # of implausible joint states
FAR_M, SECOND_M, SCATTER_M = (1.5, 12.0), (0.008, 0.03), (0.0, 0.01)  # hands far away; a second source, and its scatter
FAST_CLOCK = 0.04  # largest drift of the tracker's clock
PULLED_M, PULLED_AT_M = 0.05, (0.0, 0.05, 0.1, 0.2)  # size of a via-point's effect; how far from it that is measured
LIMIT_S = 300  # a value that takes longer has no figures
ROOM = 1024  # float64 values for which there is memory

EACH = 4  # seeds of a session: the first one is measured at all values, the others give the noise

values = np.zeros(ROOM)
marks = np.zeros(ROOM, np.uint8)
_VALUES_AT, _MARKS_AT = values.ctypes.data, marks.ctypes.data


@intrinsic  # type: ignore[untyped-decorator]
def _pointer(_: Any, address: Any) -> Any:
    """An address as a pointer."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(address), generate


@numba.njit  # type: ignore[untyped-decorator]
def number(at: int) -> float:
    """Value of the number at an index; leaves a mark."""
    numba.carray(_pointer(_MARKS_AT), ROOM, np.uint8)[at] = 1
    return float(numba.carray(_pointer(_VALUES_AT), ROOM, np.float64)[at])


@numba.njit  # type: ignore[untyped-decorator]
def count(at: int) -> int:
    """The same for a whole number."""
    return int(number(at))


@numba.njit  # type: ignore[untyped-decorator]
def row(at: int, size: int) -> Any:
    """The same for several numbers in a row."""
    numba.carray(_pointer(_MARKS_AT), ROOM, np.uint8)[at] = 1
    return numba.carray(_pointer(_VALUES_AT), ROOM, np.float64)[at : at + size]


class Number(NamedTuple):
    """A tuned number, or several in a row, and the place of the first value in memory."""

    stage: str
    name: str
    value: Any
    at: int

    @property
    def key(self) -> str:
        """Name of the number in the result."""
        return f"{self.stage}.{self.name}"

    @property
    def size(self) -> int:
        """How many values it has."""
        return int(np.size(self.value))

    def read(self) -> ast.expr:
        """Expression that reads it from memory."""
        kind = "row" if np.ndim(self.value) else "count" if isinstance(self.value, int) else "number"
        more = f", {self.size}" if np.ndim(self.value) else ""
        return ast.parse(f"_memory.{kind}({self.at}{more})", mode="eval").body

    def changed(self, factor: float) -> Any:
        """The number times a factor. A count is a whole number that differs by at least 1, a share
        is at most 1, and probabilities become more or less equal.
        """
        if self.name in PROBABILITIES:
            powers = np.asarray(self.value) ** factor
            return powers / powers.sum()
        if not isinstance(self.value, int):
            most = LARGEST_CHANGED.get(
                self.name, 1.0 if self.name.endswith("_SHARE") and np.max(self.value) < 1.0 else math.inf
            )
            return np.minimum(np.asarray(self.value) * factor, most)
        return max(self.value + 1, round(self.value * factor)) if factor > 1 else min(self.value - 1, self.value // 2)

    def is_of(self, row: Mapping[str, Any]) -> bool:
        """True if a row of the result, which has five digits, was measured with these values."""
        pairs = [(row["value"], self.value)]
        pairs += [(row["changed"][f"{factor:g}"]["to"], self.changed(factor)) for factor in FACTORS]
        return all(np.allclose(one, other, rtol=1e-4, atol=0.0) for one, other in pairs)


class Tuning(NamedTuple):
    """The tuned numbers of the core by key, and for each name the expression that reads it: a name
    defined by other names is a formula, and no tuned number.
    """

    numbers: dict[str, Number]
    reads: dict[str, ast.expr]


def tuning() -> Tuning:
    """All names of the stages' `tuning.py`."""
    found, modules = Tuning({}, {}), {}
    at = 0
    for stage in STAGES:
        module = importlib.import_module(f"service.core.{stage}.tuning")
        modules[stage] = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        for name, formula in _assigned(modules[stage]):
            if not _named(formula):
                one = Number(stage, name, getattr(module, name), at)
                found.numbers[one.key], found.reads[one.key], at = one, one.read(), at + one.size
    for stage, tree in modules.items():
        replace = _Reads(f"{stage}/tuning.py", found.reads, stage, inside=True)
        for node in tree.body:
            replace.visit(node) if isinstance(node, ast.ImportFrom) else None
        sizes = {name: value for name, value in vars(sys.modules[f"service.core.{stage}"]).items() if name.isupper()}
        replace.named |= {name: ast.Constant(value) for name, value in sizes.items() if isinstance(value, int)}
        for name, formula in _assigned(tree):
            if _named(formula):
                found.reads[f"{stage}.{name}"] = replace.named[name] = replace.visit(formula)
    return found


def numbers() -> dict[str, Number]:
    """The tuned numbers of the core, by key."""
    return tuning().numbers


def _assigned(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            yield node.targets[0].id, node.value


def _named(formula: ast.expr) -> bool:
    """True if a value names other numbers."""
    return any(isinstance(node, ast.Name) and node.id.isupper() for node in ast.walk(formula))


class _Reads(ast.NodeTransformer):
    """Replace the numbers that a module imports by reads from memory."""

    def __init__(self, path: str, reads: Mapping[str, ast.expr], stage: str = "", *, inside: bool = False) -> None:
        """`stage` is that of a `tuning.py`, whose own names are replaced too."""
        self._path, self._reads, self._inside = path, reads, inside
        self.named = {key.split(".")[1]: read for key, read in reads.items() if key.split(".")[0] == stage}

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        module = (node.module or "").split(".")
        if module[:2] == ["service", "core"] and module[-1] == "tuning":
            for one in node.names:
                self.named[one.asname or one.name] = self._reads[f"{module[2]}.{one.name}"]
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        before, self._inside = self._inside, True
        node.body = [self.visit(part) for part in node.body]
        self._inside = before
        self.visit(node.args)
        return node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        if node.id not in self.named or not isinstance(node.ctx, ast.Load):
            return node
        if not self._inside:
            raise ImportError(f"{self._path}:{node.lineno}: {node.id} is read outside of a function")
        return ast.copy_location(copy.deepcopy(self.named[node.id]), node)


def reading(path: str, source: bytes, reads: Mapping[str, ast.expr]) -> ast.Module:
    """A module that reads its numbers from memory. Raises ImportError if it reads one when it is
    imported.
    """
    return cast(ast.Module, ast.fix_missing_locations(_Reads(path, reads).visit(ast.parse(source))))


class _Loader(SourceFileLoader):
    """Loader of a module of the service that reads its numbers from memory."""

    reads: Mapping[str, ast.expr] = {}

    def get_code(self, fullname: str) -> Any:
        path = self.get_filename(fullname)
        return compile(reading(path, self.get_data(path), self.reads), path, "exec")

    def exec_module(self, module: ModuleType) -> None:
        vars(module).update(_memory=sys.modules[__name__], math=math, np=np)  # what the formulas name
        super().exec_module(module)


class ReadsNumbers(MetaPathFinder):
    """Finder that has each module of the service, but the tuning itself, read its numbers from
    memory.
    """

    def __init__(self, reads: Mapping[str, ast.expr]) -> None:
        _Loader.reads = reads

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        """Specification of a module of the service; None for any other."""
        if not fullname.startswith("service.") or fullname.endswith(".tuning"):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.origin and spec.origin.endswith(".py"):
            spec.loader = _Loader(fullname, spec.origin)
        return spec


def begin() -> dict[str, Number]:
    """Write all numbers to memory, and have the service read them from there. Returns them."""
    known, reads = tuning()
    loaded = [name for name in sys.modules if name.startswith("service.core.") and name.count(".") > 2]
    if early := [name for name in loaded if not name.endswith(".tuning")]:
        raise ImportError(f"imported before its numbers could be replaced: {', '.join(early)}")
    for one in known.values():
        values[one.at : one.at + one.size] = one.value
    import kmp.compiled

    kmp.compiled.compiled = numba.njit  # Numba's caches on disk have the numbers in the code
    sys.meta_path.insert(0, ReadsNumbers(reads))
    return known


def forget() -> None:
    """Empty all caches of the service and the simulation, which may depend on a number."""
    for name, module in list(sys.modules.items()):
        if name.startswith(("service.", "sim.")):
            for one in list(vars(module).values()):
                if callable(clear := getattr(one, "cache_clear", None)):
                    clear()


def sessions() -> dict[str, Session]:
    """Short sessions by name: from the number of a seed, below EACH, to figures by name."""
    import msgspec
    from scipy.signal import butter, sosfiltfilt
    from scipy.spatial.transform import Rotation

    from service.contract.records import SIDES, Cause, Flag, Mode
    from service.contract.requests import TOLERANCE_M, ViaPoint
    from service.core.codes import TRUSTED
    from service.core.controller import Controller
    from service.core.frame import Event, Tick, order
    from service.core.separation.stage import Separation
    from service.core.skill.skill import Skill
    from service.files.recording import Recording
    from service.files.replay import ticks
    from service.files.shipped import recordings, shipped_skill
    from service.learning.demonstration import Demonstration
    from service.learning.learn import learn
    from service.learning.skill_file import decoded
    from service.learning.via_points import adapted
    from service.settings.config import Box, Obstacles, Settings, robot_description
    from sim.closed_loop import START_NS, hand_event, joints_event
    from sim.experiments import motion, phase, reached, separation
    from sim.experiments.catalogue import EXPERIMENTS
    from sim.experiments.open_loop import targets
    from sim.experiments.partners import summary
    from sim.experiments.people import moving_hands
    from sim.experiments.people.left_out import judged, left_out, predicted
    from sim.experiments.rehearsal import NOISE_M, TREMOR_M, rehearse
    from sim.experiments.rivals.followers import ours
    from sim.made_tasks import takes
    from sim.scene import Scene
    from sim.script import HandScript
    from sim.teach import demonstrate

    streams = EXPERIMENTS["sensitivity"].seeds.tuning
    period_s, names = moving_hands.PERIOD_S, ("error_rms_mm", "lag_ms", "acceleration_ratio", "jerk_ratio", "limited")

    def follow(hands: list[Moving], keep: tuple[str, ...], settings: Settings) -> dict[str, float]:
        """Figures of sequences with the core alone, by a skill that depends on the hands alone."""
        skill = decoded((recordings() / motion.AS_PAPER).read_bytes(), origin=motion.AS_PAPER)
        out: dict[str, list[float]] = {}
        for one in hands:
            seen = ours(skill, settings)(one)
            found = motion.figures("ours", one, targets(skill, one.truth), seen)
            for name in keep:
                out.setdefault(f"{one.group}: {name}", []).append(getattr(found, name))
            if "overshoot_mm" in keep:
                last = np.diff(seen.tool[-round(AT_REST_S / period_s) :], axis=0) / period_s
                out.setdefault(f"{one.group}: at_rest_mm_s", []).append(1000 * float(np.sqrt(np.mean(last**2))))
        return {name: float(np.mean(values)) for name, values in out.items()}

    def middle() -> Array:
        skill = decoded((recordings() / motion.AS_PAPER).read_bytes(), origin=motion.AS_PAPER)
        return np.asarray(skill.hands.mean(axis=0))

    def person(seed: int) -> list[Moving]:
        hands = moving_hands.modelled(middle(), numbers=[streams["people"].numbers[seed]], seconds=MOTION_S)
        return [one for one in hands if one.group in motion.FLOOR_GROUPS]

    def disturbed(seed: int) -> dict[str, float]:
        """Late samples and a hand out of sight; a second source for a while; outliers, then hands
        that are exchanged.
        """
        hands, random = person(seed)[0], np.random.default_rng([streams["disturbed"].seed, seed])
        late = random.uniform(0.0, moving_hands.MOST_LATE_S, (len(hands.stamps), 2))
        late[np.abs(hands.stamps - UNSEEN_S[0]) < UNSEEN_S[1] / 2, seed % 2] = np.inf
        samples, twice = hands.samples.copy(), np.flatnonzero(np.abs(hands.stamps - TWO_S[0]) < TWO_S[1] / 2)
        samples[twice[::2], :3] += APART_M
        wrong = hands.samples.copy()
        for at in random.integers(0, len(wrong) - BURST[1], BURSTS):
            away, hand = random.standard_normal(3), 3 * int(random.integers(2))
            away *= random.uniform(*BURST_M) / np.linalg.norm(away)
            wrong[at : at + random.integers(*BURST), hand : hand + 3] += away
        exchanged = np.abs(hands.stamps - EXCHANGED_S[0]) < EXCHANGED_S[1] / 2
        wrong[exchanged] = np.roll(wrong[exchanged], 3, axis=1)
        groups = {
            "late and unseen": replaced(hands, late=late),
            "two sources": replaced(hands, samples=samples),
            "mistakes": replaced(hands, samples=wrong),
        }
        return follow([replaced(one, group=name) for name, one in groups.items()], names, Settings())

    def replaced(hands: Moving, **changed: Any) -> Moving:
        return type(hands)(**{**vars(hands), **changed})

    def stops(seed: int) -> dict[str, float]:
        numbers = streams["stops"].numbers[seed : seed + 1]
        seen = moving_hands.stops(middle(), numbers=numbers)
        seen += moving_hands.stops(middle(), numbers=numbers, rate_hz=30, noise=0.002, group="stops, 30 Hz, 2 mm")
        return follow(seen, ("overshoot_mm", "settled_ms"), Settings())

    def soft(seed: int) -> dict[str, float]:
        """Stops of a tool that is moved softly."""
        seen = moving_hands.stops(middle(), numbers=streams["stops"].numbers[seed : seed + 1])
        tool = msgspec.structs.replace(Settings().tool, max_jerk=SOFT_JERK)
        return follow(seen, ("overshoot_mm", "error_rms_mm"), msgspec.structs.replace(Settings(), tool=tool))

    def calm(seed: int) -> dict[str, float]:
        """Hands that tremble at rest, then a hand that moves slowly."""
        random, times = np.random.default_rng([streams["calm"].seed, seed]), np.arange(0.0, CALM_S, period_s)
        rates = random.uniform(8.0, 12.0, 6)
        truth = middle() + 0.001 * np.sin(2.0 * np.pi * rates * times[:, None])
        slow = middle() + SLOW_MPS * np.maximum(times - 0.5, 0.0)[:, None] * np.array([0.3, 0.9, 0.3, 0.0, 0.0, 0.0])
        out: dict[str, float] = {}
        skill = decoded((recordings() / motion.AS_PAPER).read_bytes(), origin=motion.AS_PAPER)
        for name, hands in (("tremor", truth), ("slow", slow)):
            samples = hands[::5] + NOISE_M * random.standard_normal((len(hands[::5]), 6))
            tool = ours(skill, Settings())(moving_hands.Moving(name, name, hands, times[::5], samples)).tool[500:]
            fast = sosfiltfilt(butter(4, 4.0, "highpass", fs=1.0 / period_s, output="sos"), tool, axis=0)
            out[f"{name}: above_4_hz_mm"] = 1000 * float(np.sqrt(np.mean(np.sum(fast**2, axis=1))))
        speed = np.diff(tool, axis=0) @ (tool[-1] - tool[0]) / np.linalg.norm(tool[-1] - tool[0]) / period_s
        return out | {"slow: speed_std_mm_s": 1000 * float(speed.std())}

    def pauses(seed: int) -> dict[str, float]:
        script = HandScript(
            Scene(),
            seed=streams["hands"].numbers[seed],
            pauses=(phase.STOP, phase.BACK),
            tremor_rms=TREMOR_M,
            noise_std=NOISE_M,
        )
        one = rehearse(script, reached.ours(Scene()), rate_hz=separation.RATE_HZ, keep=True)
        stopped = one.tool[slice(*np.searchsorted(one.time_s, phase.STOPPED_S))]
        resting = stopped[len(stopped) // 2 :] - stopped[len(stopped) // 2 :].mean(axis=0)
        return {
            **{f"{name}_error_mm": value for name, value in zip(EVENTS, one.errors_mm, strict=True)},
            "goes_on_mm": float(1000 * np.linalg.norm(stopped[-1] - stopped[0])),
            "tremor_in_pause_mm": float(1000 * np.sqrt(np.mean(np.sum(resting**2, axis=1)))),
            "held_s": one.held_s,
            "turn_off_deg": turned_off(one),
        }

    def turned_off(one: Rehearsed) -> float:
        """Angle between the tool's axis and the one that is asked for, root mean square."""
        asked = Rotation.from_quat(one.frames["orientation"]).apply((0.0, 0.0, 1.0))
        return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(np.sum(asked * one.axis, axis=1), -1, 1)) ** 2))))

    def beside_a_box(seed: int) -> dict[str, float]:
        """The nominal scene with a box on the way to the handover."""
        script = HandScript(Scene(), seed=streams["hands"].numbers[seed], tremor_rms=TREMOR_M, noise_std=NOISE_M)
        things = Obstacles(boxes=(Box(*BOX),))
        settings = msgspec.structs.replace(Settings(), obstacles=things)
        one = rehearse(script, reached.ours(Scene()), rate_hz=separation.RATE_HZ, settings=settings, keep=True)
        behind = np.linalg.norm(one.frames["setpoint"] - one.tool, axis=1)
        return {
            **{f"{name}_error_mm": value for name, value in zip(EVENTS, one.errors_mm, strict=True)},
            "held_s": one.held_s,
            "behind_mm": float(1000 * behind.max()),
            "turn_off_deg": turned_off(one),
        }

    def scene(kind: str) -> Session:
        def run_one(seed: int) -> dict[str, float]:
            one = separation.run_one((kind, streams["scenes"].numbers[seed]))
            return {
                "success": float(one.success),
                **{f"{name}_error_mm": value for name, value in zip(EVENTS, one.errors_mm, strict=True)},
                "done_s": one.times_s[-1],
                "nearest_mm": one.capsules_mm,
                "pushed_mm": one.pushed_mm,
                "excess_mm_s": 1000 * max(one.excess_after_reaction, one.excess_hurried),
                "limited_s": one.limited_s,
            }

        return run_one

    def taught_by_two(kind: str, stream: Stream, seed: int, *, named: bool) -> tuple[StoredSkill, list[LeftOut]]:
        """The skill of two people's takes, and a take of a third one, with or without named
        via-points.
        """
        who = stream.numbers[3 * seed : 3 * seed + 3]
        taken = [takes(kind, people=who[:2], each=2, seed=stream.seed)]
        taken += [takes(kind, people=who[2:], each=1, seed=stream.seed)]
        learned, asked = ([take.demonstration for take in part] for part in taken)
        if not named:
            learned = [one._replace(places=()) for one in learned]
        return learn(learned), [left_out("", "", one) for one in asked]

    def partners(seed: int) -> dict[str, float]:
        skill, seen = taught_by_two(MADE, streams["made"], seed, named=True)
        there = [adapted(skill, one.demonstration.places, tolerance=TOLERANCE_M) for one in seen]
        found = summary([judged(one, predicted(at, one)) for one, at in zip(seen, there, strict=True)])
        return {name: float(found[name] or 0.0) for name in ("rms_mm", "shifted_rms_mm", "worst_mm", "held", "unsure")}

    def untold(kind: str, stream: Stream) -> Session:
        """A skill of both hands, with their memory or orientation, for a task without named
        via-points.
        """

        def run_one(seed: int) -> dict[str, float]:
            skill, seen = taught_by_two(kind, stream, seed, named=False)
            found = summary([judged(one, predicted(skill, one)) for one in seen])
            return {name: float(found[name] or 0.0) for name in ("rms_mm", "shifted_rms_mm", "worst_mm", "unsure")}

        return run_one

    def lost(seed: int) -> dict[str, float]:
        """One hand out of sight for a time after which the tool engages anew or goes on."""
        hands, out = person(seed)[0], []
        for name, (middle_s, lasts_s) in LOST_S.items():
            late = np.zeros((len(hands.stamps), 2))
            late[np.abs(hands.stamps - middle_s) < lasts_s / 2, seed % 2] = np.inf
            out.append(replaced(hands, group=name, late=late))
        return follow(out, names, Settings())

    def timed(seed: int) -> dict[str, float]:
        """A skill with a clock, for a tool that moves by a timetable once a hand has begun."""
        random, skill = np.random.default_rng([streams["timed"].seed, seed]), shipped_skill()
        start, times = skill.hands[0], np.arange(0.0, TIMED_REST_S[1] + TIMED_HANDS_S[1], 1 / SHOWN_HZ)
        way, aside = np.array([0.0, 0.2, 0.1, 0.0, -0.1, 0.1]), np.array([0.1, 0.3, -0.1])

        def gone(since_s: Array, lasts_s: float) -> Array:
            share = np.clip(since_s / lasts_s, 0.0, 1.0)[:, None]
            return np.asarray(share**3 * (10 - 15 * share + 6 * share**2))

        def shown() -> Demonstration:
            since_s = times - random.uniform(*TIMED_REST_S)
            hands = start + random.normal(0.0, 0.01, 6) + gone(since_s, random.uniform(*TIMED_HANDS_S)) * way
            hands += NOISE_M * random.standard_normal(hands.shape)
            tool = skill.mean(start[None]) + gone(since_s, TIMETABLE_S) * aside
            turn = np.tile(skill.orientation, (len(tool), 1))
            left, right, tool = (np.hstack([x, turn]) for x in (hands[:, :3], hands[:, 3:], tool))
            return Demonstration(START_NS + np.round(1e9 * times).astype(np.int64), left, right, tool)

        learned = learn([shown() for _ in range(SHOWN)])
        asked = [left_out("", "", shown())]
        found = summary([judged(one, predicted(learned, one)) for one in asked])
        return {name: float(found[name] or 0.0) for name in ("rms_mm", "worst_mm")} | {
            "has_clock": float(learned.model.clock_rows is not None)
        }

    def gripper(seed: int) -> dict[str, float]:
        """The nominal scene with a skill that opens and closes the gripper."""
        stream = streams["shown"]
        shown = [demonstrate(Scene(), seed=1000 * stream.seed + n, gripper=True) for n in stream.numbers]
        skill = reached.taught(learn(shown), Scene().via_points())
        script = HandScript(Scene(), seed=streams["hands"].numbers[seed], tremor_rms=TREMOR_M, noise_std=NOISE_M)
        one = rehearse(script, lambda bench: skill, rate_hz=RATE_HZ, keep=True)
        switched = np.flatnonzero(np.diff(one.frames["gripper"].astype(np.int64)))
        return {
            "switches": float(len(switched)),
            "switched_s": float(one.time_s[switched].sum()),
            "grasp_error_mm": one.errors_mm[1],
        }

    def pulled(seed: int) -> dict[str, float]:
        """Effect of one more via-point on the target, for hands at several distances from it."""
        random, scene = np.random.default_rng([streams["resting"].seed, seed]), Scene()
        skill = reached.taught(shipped_skill(), scene.via_points())
        hands = skill.hands[seed % len(skill.hands)] + random.uniform(-0.1, 0.1, 6)
        aside = random.standard_normal(6)
        at = hands + np.outer(PULLED_AT_M, aside / np.linalg.norm(aside))
        left, right, tool = (tuple(x.tolist()) for x in (hands[:3], hands[3:], skill.mean(at)[0] + (0, 0, PULLED_M)))
        more = reached.taught(shipped_skill(), [*scene.via_points(), ViaPoint("more", left, right, tool)])
        moved_mm = 1000 * np.linalg.norm(more.mean(at) - skill.mean(at), axis=1)
        return {f"moved_at_{100 * m:g}_cm_mm": float(moved) for m, moved in zip(PULLED_AT_M, moved_mm, strict=True)}

    def resting(seed: int, *, source: str = "assumed") -> tuple[Settings, Skill, Array, np.random.Generator]:
        """A cell, a taught skill, both hands (6,) at a via-point. The arm moves as commanded unless
        it has another `source`.
        """
        arm = msgspec.structs.replace(Settings().arm, source=source)
        settings = msgspec.structs.replace(Settings(), rate_hz=RATE_HZ, arm=arm)
        skill = reached.taught(shipped_skill(), Scene().via_points())
        random = np.random.default_rng([streams["resting"].seed, seed])
        hands = np.array(skill.via_points[2 - seed % 3].left + skill.via_points[2 - seed % 3].right)
        return settings, skill, hands + random.uniform(-0.01, 0.01, 6), random

    def at_hands(controller: Controller, hands: Array, k: int, *events: Event) -> Any:
        """The frame of tick k, in which samples of resting hands (6,) arrive."""
        stamp_ns = START_NS + round(k * 1e9 / RATE_HZ)
        seen = [
            hand_event(side, tuple(x.tolist()), stamp_ns) for side, x in zip(SIDES, hands.reshape(2, 3), strict=True)
        ]
        return controller.step(Tick(k, (*(seen if k % 3 == 1 else ()), *events)))

    def implausible(seed: int) -> dict[str, float]:
        """An arm that trembles less and less, joint states and hands that cannot be, a second
        source, and a tracker whose clock is too fast.
        """
        settings, skill, middle_of, _ = resting(seed, source="state")
        random = np.random.default_rng([streams["implausible"].seed, seed])
        controller = Controller(settings, skill, urdf=robot_description(settings))
        joints, names, trusted = np.array(settings.arm.posture), settings.joints.names, 0
        frames: list[Any] = []
        drift, ready = random.uniform(0.0, FAST_CLOCK), 0
        for k in range(1, round(IMPLAUSIBLE_S * RATE_HZ)):
            now_s = k / RATE_HZ
            stamp_ns, is_odd = START_NS + round(1e9 * now_s), random.integers(IMPLAUSIBLE_EACH) == 0
            at = joints + max(0.0, 1.0 - now_s / TREMBLE_S) * TREMBLE_RAD * random.uniform(-1.0, 1.0, len(joints))
            rates = np.zeros(len(joints))
            if is_odd and TREMBLE_S < now_s < IMPLAUSIBLE_S / 2:
                which = random.integers(len(joints))
                at[which] += random.choice((-1.0, 1.0)) * random.uniform(*JOINTS_OFF_RAD)
                rates[which] = random.uniform(*JOINTS_RADPS) * (random.random() < 0.5)
            inbox = [joints_event(names, tuple(at.tolist()), tuple(rates.tolist()), stamp_ns)]
            if k % 3 == 1:
                hands = middle_of + 0.05 * np.sin(2.0 * now_s)
                if is_odd:
                    hands[:3] *= random.uniform(*FAR_M) / np.linalg.norm(hands[:3])
                elif k % 2 and now_s > IMPLAUSIBLE_S / 2:
                    hands[5] += SECOND_M[0] + (SECOND_M[1] - SECOND_M[0]) * (now_s / IMPLAUSIBLE_S * 8.0 % 1.0)
                    hands[3:] += random.uniform(*SCATTER_M) * random.standard_normal(3)
                late_ns = round(1e9 * (drift * now_s + random.exponential(0.003)))
                inbox += [
                    hand_event(side, tuple(x.tolist()), stamp_ns - late_ns)
                    for side, x in zip(SIDES, hands.reshape(2, 3), strict=True)
                ]
            if frames and frames[-1]["mode"] == Mode.FAULT:
                inbox.append(order("reset", ""))
            frame = controller.step(Tick(k, tuple(inbox)))
            frames.append(frame)
            if frame["mode"] == Mode.FOLLOW:
                ready, joints = ready or k, frame["joints"]
            trusted += int((controller.state["clock"] == TRUSTED).sum())
        found = np.array(frames)
        return {
            "out_of_range": float(found["rejected"][-1][Cause.OUT_OF_RANGE]),
            "jumped": float(found["rejected"][-1][Cause.JUMPED]),
            "ready_s": ready / RATE_HZ,
            "following": float(np.mean(found["mode"] == Mode.FOLLOW)),
            "trusted": trusted / 2 / len(found),
            "tool_mm": 1000 * float(np.linalg.norm(np.diff(found["tool"], axis=0), axis=1).sum()),
        }

    def blocked(seed: int) -> dict[str, float]:
        """Resting hands, with the target inside of a box: the tool comes no nearer, and is then led
        along a way out.
        """
        settings, skill, hands, random = resting(seed)
        box = Box(tuple(skill.mean(hands[None])[0].tolist()), (CLOSED_M, CLOSED_M, CLOSED_M))
        settings = msgspec.structs.replace(settings, obstacles=Obstacles(boxes=(box,)))
        controller = Controller(settings, skill, urdf=robot_description(settings))
        aside, frames = random.uniform(-DETOUR_RAD, DETOUR_RAD, len(settings.joints.names)), []
        events: tuple[Event, ...] = ()
        began = ended = 0
        for k in range(1, round(RESTING_HANDS_S * RATE_HZ)):
            frames.append(at_hands(controller, hands, k, *events))
            state, events = controller.state, ()
            if not began and state["stuck"]:
                began, joints = k, state["joints"][0]
                events = (order("way", json.dumps([(joints + aside).tolist(), joints.tolist()])),)
            elif began and not ended and k > began + 1 and state["way_next"] >= state["way_count"]:
                ended = k
        found = np.array(frames)
        tool = found["tool"]
        ended = ended or len(frames)
        return {
            "stuck_s": began / RATE_HZ,
            "way_s": (ended - began) / RATE_HZ,
            "way_mm": 1000 * float(np.linalg.norm(tool[began:] - tool[began - 1], axis=1).max()),
            "following": float(np.mean(found["mode"] == Mode.FOLLOW)),
        }

    def crowded(seed: int) -> dict[str, float]:
        """An arm that begins nearer to a box than the clearance: it retreats, and then follows."""
        settings, skill, hands, random = resting(seed)
        urdf, joints = robot_description(settings), np.array(settings.arm.posture)
        tool = at_hands(Controller(settings, skill, urdf=urdf), hands, 1)["tool"]
        way = random.standard_normal(3)
        way /= np.linalg.norm(way)

        def with_box(off_m: float) -> Settings:
            box = Box(tuple((tool + off_m * way).tolist()), (CLOSED_M, CLOSED_M, CLOSED_M))
            return msgspec.structs.replace(settings, obstacles=Obstacles(boxes=(box,)))

        near_m, far_m = 0.0, 1.0
        for _ in range(12):
            middle_m = (near_m + far_m) / 2
            clear_m = Separation(with_box(middle_m), urdf).clearance(joints.copy(), hands.reshape(2, 3))[0]
            near_m, far_m = (middle_m, far_m) if clear_m < INSIDE_M else (near_m, middle_m)
        controller = Controller(with_box(far_m), skill, urdf=urdf)
        found = np.array([at_hands(controller, hands, k) for k in range(1, round(RATE_HZ * RESTING_HANDS_S / 2))])
        moved = np.linalg.norm(found["tool"] - tool, axis=1)
        return {
            "moved_mm": 1000 * float(moved[-1]),
            "moved_first_mm": 1000 * float(moved[RATE_HZ // 2]),
            "following": float(np.mean(found["mode"] == Mode.FOLLOW)),
        }

    first: dict[str, Any] = {}

    def golden(_: int) -> dict[str, float]:
        """The inputs of the golden session, which does not react: how many frames change."""
        recording = Recording.open(recordings() / "golden.mcap")
        controller = Controller(recording.settings, shipped_skill(), urdf=recording.urdf)
        frames = np.array([controller.step(tick) for tick in ticks(recording)])
        was = first.setdefault("frames", frames)
        flags = (frames["flags"] ^ was["flags"]) & int(Flag.SPEED_LIMITED | Flag.SEPARATION) > 0
        return {
            "changed": float(np.mean([a.tobytes() != b.tobytes() for a, b in zip(frames, was, strict=True)])),
            "other_mode": float(np.mean(frames["mode"] != was["mode"])),
            "other_flags": float(np.mean(flags)),
            "following": float(np.mean(frames["mode"] == Mode.FOLLOW)),
            "tool_moved_mm": float(1000 * np.linalg.norm(frames["tool"] - was["tool"], axis=1).max()),
        }

    return {
        "motion": lambda seed: follow(person(seed), names, Settings()),
        "stops": stops,
        "soft": soft,
        "disturbed": disturbed,
        "calm": calm,
        "phase": pauses,
        "scene": scene("random"),
        "thrust": scene("thrust"),
        "box": beside_a_box,
        "partners": partners,
        "untold": untold(UNTOLD_KIND, streams["untold"]),
        "turned": untold(TURNED_KIND, streams["turned"]),
        "lost": lost,
        "timed": timed,
        "gripper": gripper,
        "pulled": pulled,
        "implausible": implausible,
        "blocked": blocked,
        "crowded": crowded,
        "golden": golden,
    }


class Known(NamedTuple):
    """Figures at the tuned values, their noise, and the numbers that each session reads."""

    figures: Figures
    noise: Figures
    reads: dict[str, list[str]]
    seconds: dict[str, float]


def at_tuned_values(known: Mapping[str, Number], all_sessions: Mapping[str, Session]) -> Known:
    """Measure all sessions with all seeds. The figures of the first seed are measured once more, as
    those at other values are: in a fork.
    """
    out = Known({}, {}, {}, {})
    for name, session in all_sessions.items():
        forget()  # or a number that is read once, for a cache, would be marked in the first session alone
        marks[:] = 0
        found, began = [session(0)], time.monotonic()
        out.reads[name] = [key for key, one in known.items() if marks[one.at]]
        found += [session(seed) for seed in range(1, 1 if name == "golden" else EACH)]
        out.seconds[name] = (time.monotonic() - began) / max(1, len(found) - 1)
        spread = {figure: [one[figure] for one in found] for figure in found[0]}
        out.noise[name] = {figure: float(np.std(v, ddof=1)) if len(v) > 1 else 0.0 for figure, v in spread.items()}
    figures = in_fork(functools.partial(measured, all_sessions))()
    if isinstance(figures, str):
        raise ExperimentError(f"at the tuned values: {figures}")
    return out._replace(figures=figures)


def measured(some: Mapping[str, Session]) -> Figures:
    """Figures of these sessions with the first seed; no session finds caches of another one."""
    out: Figures = {}
    for name, session in some.items():
        forget()
        out[name] = session(0)
    return out


def in_fork(work: Callable[[], Any]) -> Callable[[], Any]:
    """Start a function in a fork of this process. Returns a function that waits for its result,
    which is an error's text if there is none.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        signal.alarm(LIMIT_S)
        try:
            out = work()
        except Exception as error:
            out = f"{type(error).__name__}: {error}"
        os.write(writing, json.dumps(out).encode())
        os._exit(0)
    os.close(writing)

    def result() -> Any:
        with open(reading, "rb") as pipe:
            found = pipe.read()
        _, status = os.waitpid(child, 0)
        return json.loads(found) if found else f"no result: exit {os.waitstatus_to_exitcode(status)}"

    return result


def at_other_value(one: Number, value: Any, known: Known, all_sessions: Mapping[str, Session]) -> Figures:
    """Figures of the sessions that read a number, at another value; runs in a fork."""
    values[one.at : one.at + one.size] = value
    return measured({name: session for name, session in all_sessions.items() if one.key in known.reads[name]})


def serve(keys: list[str], workers: int, done: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Measure numbers one after the other: first all figures at the tuned values, then a row a
    number; in the sessions that are not `done`, or in all if none is left. With two workers, both
    values of a number are measured at the same time.
    """
    known = begin()
    all_sessions = sessions()
    all_sessions = {name: one for name, one in all_sessions.items() if name not in done} or all_sessions
    here = at_tuned_values(known, all_sessions)
    yield {"tuned": here._asdict()}
    for key in keys:
        one, began = known[key], time.monotonic()
        others = {f"{factor:g}": one.changed(factor) for factor in FACTORS}
        work = {f: functools.partial(at_other_value, one, value, here, all_sessions) for f, value in others.items()}
        if workers == 1:
            figures = {factor: in_fork(measure)() for factor, measure in work.items()}
        else:
            started = {factor: in_fork(measure) for factor, measure in work.items()}
            figures = {factor: result() for factor, result in started.items()}
        changed = {f: {"to": np.asarray(value).tolist(), "figures": figures[f]} for f, value in others.items()}
        seconds = round(time.monotonic() - began, 1)
        yield {
            "number": key,
            "row": {"value": np.asarray(one.value).tolist(), "changed": changed, "seconds": seconds},
        }


def run(results: Results, options: Options) -> dict[str, Any]:
    """Measure the numbers that the result does not have yet, in all sessions; or those that are
    named, in the sessions that the result does not have yet, or in all if it has these. The result
    is written after each number.
    """
    from sim.experiments.evidence import result_of

    known = numbers()
    before = result_of(results.folder, results.name) or {}
    same = before.get("depends_on") == results.origin["depends_on"]
    rows: dict[str, Any] = {
        key: row for key, row in before.get("numbers", {}).items() if same and key in known and known[key].is_of(row)
    }
    named = set(options.numbers.split(",")) if options.numbers else set()
    wanted = [key for key in known if (named & {key, *key.split(".")} if named else key not in rows)]
    out: dict[str, Any] = {"tuned": before.get("tuned", {}) if same else {}, "numbers": rows, "unmeasured": []}
    if not wanted:
        return out
    done = list(out["tuned"].get("figures", ())) if named and all(key in rows for key in wanted) else []
    if not options.workers.isdecimal():
        raise ExperimentError(f"--workers {options.workers}: sensitivity forks its own processes; 1 or 2 needed")
    command = [sys.executable, "-m", "sim.experiments.sensitivity", f"--workers={options.workers}"]
    command += [f"--done={','.join(done)}", *wanted]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT, text=True) as server:
        assert server.stdout is not None
        for line in server.stdout:
            if not line.startswith("{"):
                continue  # the simulation's greeting
            found = json.loads(line)
            if "tuned" in found:
                out["tuned"] = {part: out["tuned"].get(part, {}) | new for part, new in found["tuned"].items()}
            else:
                rows[found["number"]] = joined(rows.get(found["number"]) if done else None, found["row"])
                results.say(f"{found['number']}: {worst(found['row'], out['tuned'])}")
            out["unmeasured"] = [key for key in known if key not in rows]
            results.numbers(out)
    if server.returncode:
        raise ExperimentError(f"the measuring process ended with {server.returncode}")
    return out


def joined(before: Mapping[str, Any] | None, row: dict[str, Any]) -> dict[str, Any]:
    """A row with the figures of other sessions that it had before, unless a session failed."""
    for factor, found in row["changed"].items():
        earlier = before["changed"][factor]["figures"] if before else {}
        if isinstance(found["figures"], dict) and isinstance(earlier, dict):
            found["figures"] = earlier | found["figures"]
    return row


def effects(row: Mapping[str, Any], tuned: Mapping[str, Any]) -> Iterator[tuple[float, str, str, float]]:
    """Changes of figures by a number: how many times the noise, factor, figure, and the change.

    A figure that no seed changes has no noise: its change counts as one noise, so that it comes
    before all changes below the noise. A figure that is no number any more counts as the largest.
    """
    for factor, found in row["changed"].items():
        if isinstance(found["figures"], str):
            yield math.inf, factor, found["figures"], math.nan
            continue
        for session, figures in found["figures"].items():
            for name, value in figures.items():
                before, noise = float(tuned["figures"][session][name]), float(tuned["noise"][session][name])
                change = float(value) - before
                if not math.isfinite(before):
                    continue
                if not math.isfinite(change):
                    yield math.inf, factor, f"{session} {name}", change
                elif noise > 0.0:
                    yield abs(change) / noise, factor, f"{session} {name}", change
                elif change != 0.0:
                    yield 1.0, factor, f"{session} {name}", change


def worst(row: Mapping[str, Any], tuned: Mapping[str, Any]) -> str:
    """The largest change by a number, in words."""
    found = max(effects(row, tuned), default=None)
    if found is None:
        return "no session reads it"
    times, factor, figure, change = found
    return f"{figure} {change:+.3g} at {factor} times the value, {times:.1f} times the noise"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure numbers of the core, by stage.NAME; a line of JSON each.")
    parser.add_argument("numbers", nargs="*", metavar="STAGE.NAME")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--done", metavar="SESSION,...", default="", help="sessions that are left out, if others remain"
    )
    arguments = parser.parse_args()
    for made in serve(arguments.numbers, arguments.workers, arguments.done.split(",")):
        print(json.dumps(made), flush=True)
