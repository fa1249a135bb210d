"""Distance and speed of the arm toward hands: random scenes in closed loop, and scenes in which a
hand is thrust in its way.

Both are judged by the joints measured in the simulation and by the true hands.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, NamedTuple
from unittest.mock import patch

import msgspec
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from kmp.compiled import compiled
from thirdhand.contract.records import Flag
from thirdhand.core.geometry import between_segments, place
from thirdhand.core.separation.body import Body, body_of
from thirdhand.core.separation.stage import Separation
from thirdhand.core.separation.step import allowed_speed
from thirdhand.core.tuning import TUNING
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.bench import Bench
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.reached import EVENTS, ours
from thirdhand_sim.lab.rehearsal import SESSION_NOISE_M, TREMOR_M, Rehearsed, rehearse
from thirdhand_sim.lab.results import ADAPTED, OTHER, Array, Options, Results, brief, pyplot
from thirdhand_sim.lab.scenes import OFFSET_M, Drawn, draw
from thirdhand_sim.lab.workers import shared_out
from thirdhand_sim.script import (
    PAUSE_RAMP_S,
    Clock,
    HandMotions,
    HandScript,
    PointMotion,
    ScriptPause,
    Teacher,
)

# separate from the tuning scenes; the rate is halved to save time
RANDOM_SCENES = EXPERIMENTS["separation"].seeds.evaluation["scenes"]
SEPARATION_HZ = 250
SCENE_KINDS = ("random", "thrust", "unheeded")
EXCESS = ("excess_at_once", "excess_after_reaction", "excess_hurried", "excess_lasts_s")
GREATEST = ("pushed_mm", *EXCESS, "fastest_hand")  # results are maxima over all scenes
# durations of a thrust
THRUST_S = (0.35, 0.7)
STAY_S = 2 * PAUSE_RAMP_S
# a hand is thrust at a point of the tool's path this distance ahead, and at most this time ahead
AHEAD_M = 0.22
AHEAD_S = 1.5
THRUST_STEP_S = 0.02  # times at which the path is sampled
CLEARANCE_TICKS = 5
SEARCHED_M = 0.3
SHOWN_M = 0.3
SPEED_STEP_S = 1e-6
# the figure shows the first scenes, and every tenth tick
SHOWN_SCENES = 5
SHOWN_TICKS = 10
# [m/s] a hand that exceeds the assumed speed by more than this is hurried
HURRY = 0.05
UNHEEDED_EVERY = 4  # every 4th scene is run without separation too, to measure its cost


class ThrustScript(HandScript):
    """Hands of a random scene; one hand thrusts into the tool's path once, stays, and returns.

    Meanwhile the script moves back, so that no part of the task is lost.
    """

    def __init__(self, drawn: Drawn) -> None:
        random = np.random.default_rng([drawn.seed, 7])
        clock = Clock(speed=drawn.speed, pauses=drawn.pauses)
        teacher = Teacher(drawn.scene, seed=drawn.seed, clock=clock)
        self.side = int(random.integers(2))
        self.lasts_s = float(random.uniform(*THRUST_S))
        self.away_s = 2 * self.lasts_s + STAY_S
        self.at_s, self._place = _thrust(
            random, teacher, drawn, clock.elapsed(drawn.scene.duration_s), self.lasts_s
        )
        there_s = self.at_s + self.lasts_s
        later = [p._replace(at_s=p.at_s + self.away_s * (p.at_s >= there_s)) for p in drawn.pauses]
        back = ScriptPause(there_s, self.lasts_s + STAY_S, 2.0)  # undoes the progress since at_s
        super().__init__(
            drawn.scene,
            seed=drawn.seed,
            speed=drawn.speed,
            pauses=(*later, back),
            offset_std=OFFSET_M,
            tremor_rms=TREMOR_M,
            noise_std=SESSION_NOISE_M,
        )

    def truth(self, t: float) -> HandMotions:
        """The motion of both hands, including the thrust."""
        hands = list(super().truth(t))
        begin = (t - self.at_s) / self.lasts_s
        back = (t - self.at_s - self.lasts_s - STAY_S) / self.lasts_s
        share, rate = (a - b for a, b in zip(_reach(begin), _reach(back), strict=True))
        motion = hands[self.side]
        offset_m = self._place - hands[self.side].position
        hands[self.side] = PointMotion(
            motion.position + share * offset_m,
            (1.0 - share) * motion.velocity + rate / self.lasts_s * offset_m,
            motion.acceleration,
        )
        return HandMotions(*hands)


def _thrust(
    random: np.random.Generator, teacher: Teacher, drawn: Drawn, duration_s: float, lasts_s: float
) -> tuple[float, Array]:
    """Time [s] of a thrust, outside of pauses, and its place (3,) [m] on the tool's path.

    At that time the tool is AHEAD_M from the place, and arrives there within AHEAD_S. If the tool
    is never that fast, the place is the farthest that it reaches in AHEAD_S.
    """
    times = np.arange(0.5, duration_s - 1.0, THRUST_STEP_S)
    count = round(AHEAD_S / THRUST_STEP_S)
    path = np.array(
        [
            teacher.truth(times[0] + i * THRUST_STEP_S).position
            for i in range(len(times) + count - 1)
        ]
    )
    ahead = sliding_window_view(path, count, axis=0).transpose(0, 2, 1)  # (T, count, 3)
    away_m = np.linalg.norm(ahead - ahead[:, :1], axis=2)
    for pause in drawn.pauses:
        away_m[(times < pause.at_s + pause.lasts_s) & (times + lasts_s > pause.at_s)] = 0.0
    least_m = min(AHEAD_M, away_m.max())
    start = random.choice(np.flatnonzero(away_m.max(axis=1) >= least_m))
    return float(times[start]), ahead[start, np.argmax(away_m[start] >= least_m)]


def _reach(u: float) -> tuple[float, float]:
    """A minimum-jerk step from 0 to 1 for u in [0, 1], and its derivative."""
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u), 30 * (u * (1 - u)) ** 2


class SeparationOutcome(NamedTuple):
    """One run. While the tool offers the board to the left hand, the contact speed applies, as in
    the service.
    """

    kind: str
    number: int
    success: bool
    errors_mm: tuple[float, float, float]
    times_s: tuple[float, float, float]  # of the events
    away_s: float  # time in which a hand was in the tool's path
    # least distance of the arm's and the hands' shapes in the simulation; below 0 they overlap
    shapes_mm: float
    capsules_mm: float  # least distance of the capsules of the rule, which are wider
    pushed_mm: float  # path of a part of the arm toward a hand that it touches
    excess_at_once: float  # [m/s] largest excess over the rule
    excess_after_reaction: float  # [m/s] over the largest allowed speed within the reaction time
    excess_hurried: float  # as above, for hands that were faster than the rule assumes
    excess_lasts_s: float  # longest time of an excess above slip_speed_mps
    fastest_hand: float  # [m/s] toward the arm, near enough for the rule
    limited_s: float  # time in which separation limited the arm
    self_mm: float  # least distance of links that are kept apart
    table_mm: float
    near: Array  # (N, 2): distance [m] and speed [m/s] of the pair nearest to its limit, some ticks


def run_one(task: tuple[str, int]) -> SeparationOutcome:
    """The outcome of one scene."""
    kind, number = task
    drawn = draw(number, seed=RANDOM_SCENES.seed)
    script = ThrustScript(drawn) if kind == "thrust" else drawn.script()
    clearances: list[tuple[float, float]] = []

    def look(bench: Bench) -> None:
        if bench.tick % CLEARANCE_TICKS == 0:
            world = bench.world
            clearances.append(
                (
                    world.clearance(world.left, within=SEARCHED_M),
                    world.clearance(world.right, within=SEARCHED_M),
                )
            )

    skill_for = ours(drawn.scene)
    with patch.object(Separation, "step") if kind == "unheeded" else nullcontext():
        done = rehearse(script, skill_for, rate_hz=SEPARATION_HZ, keep=True, look=look)
    away_s = script.away_s if isinstance(script, ThrustScript) else 0.0
    return _judged(kind, number, drawn, away_s, done, clearances)


def _judged(
    kind: str,
    number: int,
    drawn: Drawn,
    away_s: float,
    done: Rehearsed,
    clearances: list[tuple[float, float]],
) -> SeparationOutcome:
    settings = msgspec.structs.replace(Settings(), rate_hz=SEPARATION_HZ)
    dt = 1 / SEPARATION_HZ
    people = settings.people
    body = body_of(settings, robot_description(settings))
    distance, speed, coming, self_m, table = nearest(settings, body, done.joints, done.hands)
    reaction_s = (settings.hands.stale_ms + people.reaction_ms) / 1000
    allowed = np.empty_like(distance)
    _allow(distance, coming, people.brake, reaction_s, people.distance, allowed)
    offered = np.abs(done.hands[:, 0] - drawn.scene.handover).max(axis=1) < 0.05
    links = body.capsules["link"]
    tool = links[links > 0] == len(settings.joints.names)
    allowed[:, 0] = np.where(
        offered[:, None] & tool, np.maximum(allowed[:, 0], people.contact_speed), allowed[:, 0]
    )
    half = round(0.5 * reaction_s / dt)
    lately, hurried = (
        _later_by(half, maximum_filter1d(x, size=2 * half + 1, axis=0)) for x in (allowed, coming)
    )
    assumed = hurried <= np.minimum(
        _later_by(2 * half, coming) + HURRY, TUNING.separation.unknown_speed_mps
    )
    over = speed - lately
    began = np.flatnonzero(done.time_s > 0)
    pushed = np.where(distance < 0, np.maximum(speed, 0.0), 0.0).sum(axis=0) * dt
    worst = np.argmax((speed - allowed).reshape(len(speed), -1), axis=1)
    rows = np.arange(len(speed))
    picked = np.stack([x.reshape(len(x), -1)[rows, worst] for x in (distance, speed)], axis=1)
    return SeparationOutcome(
        kind,
        number,
        done.events.success,
        done.errors_mm,
        tuple(getattr(done.events, name).time_s for name in EVENTS),
        away_s,
        1000 * min(map(min, clearances)),
        1000 * float(distance[began].min()),
        1000 * float(pushed.max()),
        float((speed - allowed)[began].max()),
        float(np.where(assumed, over, -1.0)[began].max()),
        float(np.where(assumed, -1.0, over)[began].max()),
        dt * _longest(((speed - allowed > TUNING.separation.slip_speed_mps) & assumed)[began]),
        float(coming[began][distance[began] < SHOWN_M].max(initial=0.0)),
        float(((done.frames["flags"] & Flag.SEPARATION) > 0).sum() * dt),
        1000 * float(self_m.min()),
        1000 * float(table.min()),
        picked[began][::SHOWN_TICKS],
    )


def _longest(found: NDArray[np.bool_]) -> int:
    """The largest number of consecutive true ticks in (T, ...)."""
    run = np.zeros(found.shape[1:], np.int64)
    most = 0
    for now in found:
        run = (run + 1) * now
        most = max(most, int(run.max()))
    return most


def _later_by(ticks: int, values: Array) -> Array:
    """Values (T, ...) delayed by a number of ticks; the first one is repeated."""
    return np.concatenate([np.repeat(values[:1], ticks, axis=0), values])[: len(values)]


def nearest(settings: Settings, body: Body, joints: Array, hands: Array) -> tuple[Array, ...]:
    """Distance [m] of each moving capsule of the body from each hand, approach speeds of the
    capsule's nearest point and of the hand [m/s], (T, 2, N) each; then least distances (T,) [m]
    between links, and between links and table. Joints (T, 2, J) [rad, rad/s], hands (T, 2, 3) [m].
    """
    people = settings.people
    count = int((body.capsules["link"] > 0).sum())
    moving = np.stack([hands, np.gradient(hands, settings.period_s, axis=0)], axis=2)
    pairs = np.empty((3, len(hands), 2, count))
    least = np.ones((2, len(hands)))
    forearm = people.length / np.linalg.norm(people.toward_elbow) * np.array(people.toward_elbow)
    shape = np.array([people.radius, *forearm, settings.table.centre[2]])
    _measure(np.ascontiguousarray(joints), moving, body, shape, pairs, least)
    return (*pairs, *least)


@compiled
def _measure(
    joints: Array, hands: Array, body: Body, shape: Array, pairs: Array, least: Array
) -> None:
    """`nearest`, with the hands' velocities (T, 2, 2, 3), and the shape (5,) of a forearm and the
    table: radius, way to the elbow, height. Into pairs (3, T, 2, N) and least (2, T).
    """
    frames, axes, capsules, kept_apart = body
    count = len(capsules)
    near = np.empty(9)
    arm = np.empty((2, 3))
    segments = np.empty((count, 2, 3))
    moved = np.empty((count, 2, 3))
    fixed = count - pairs.shape[3]
    for t in range(len(joints)):
        q = joints[t, 0]
        place(q, frames, axes, capsules, segments)
        place(q + SPEED_STEP_S * joints[t, 1], frames, axes, capsules, moved)
        for pair in range(len(kept_apart)):
            capsule = kept_apart[pair, 0]
            other = kept_apart[pair, 1]
            distance_m = (
                between_segments(segments[capsule], segments[other], near)
                - capsules[capsule].radius
                - capsules[other].radius
            )
            least[0, t] = min(least[0, t], distance_m)
        for c in range(fixed, count):
            if max(segments[c, 0, 0], segments[c, 1, 0]) > 0.35:
                least[1, t] = min(
                    least[1, t],
                    min(segments[c, 0, 2], segments[c, 1, 2]) - capsules[c].radius - shape[4],
                )
            for side in range(2):
                arm[0] = hands[t, side, 0]
                arm[1] = arm[0] + shape[1:4]
                pairs[0, t, side, c - fixed] = (
                    between_segments(segments[c], arm, near) - capsules[c].radius - shape[0]
                )
                long = whole = along = coming = 0.0
                for i in range(3):
                    extent = segments[c, 1, i] - segments[c, 0, i]
                    whole += extent * extent
                    long += extent * (near[i] - segments[c, 0, i])
                share = long / whole if whole > 0.0 else 0.0
                for i in range(3):
                    first = moved[c, 0, i] - segments[c, 0, i]
                    second = moved[c, 1, i] - segments[c, 1, i]
                    along += near[6 + i] * ((1.0 - share) * first + share * second) / SPEED_STEP_S
                    coming -= near[6 + i] * hands[t, side, 1, i]
                pairs[1, t, side, c - fixed] = along
                pairs[2, t, side, c - fixed] = max(coming, 0.0)


@compiled
def _allow(
    distance: Array, coming: Array, brake: float, reaction: float, clearance: float, out: Array
) -> None:
    for t in range(distance.shape[0]):
        for side in range(2):
            for c in range(distance.shape[2]):
                out[t, side, c] = allowed_speed(
                    distance[t, side, c], coming[t, side, c], brake, reaction, clearance
                )


def _kinds_of(n: int) -> list[str]:
    """The kinds of the n-th scene."""
    return [kind for kind in SCENE_KINDS if kind != "unheeded" or n % UNHEEDED_EVERY == 0]


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers."""
    scenes = RANDOM_SCENES.moved(options.seed_offset).share(options.share)
    by_kind: dict[str, list[SeparationOutcome]] = {kind: [] for kind in SCENE_KINDS}
    tasks = [(kind, number) for n, number in enumerate(scenes) for kind in _kinds_of(n)]
    for row in shared_out(run_one, tasks, options.workers):
        by_kind[row.kind].append(row)
        if len(by_kind[row.kind]) % max(1, len(scenes) // 5) == 0:
            results.say(f"{row.kind}: {brief(_summary(by_kind[row.kind]))}")
    _draw_errors(results, by_kind)
    numbers = {
        "scenes": len(scenes),
        "rate_hz": SEPARATION_HZ,
        "slip_m_per_s": TUNING.separation.slip_speed_mps,
        **{kind: _summary(rows) for kind, rows in by_kind.items()},
        "later_than_unheeded_s": _later(by_kind["random"], by_kind["unheeded"]),
        "later_for_a_thrust_s": _later_for(by_kind["thrust"], by_kind["random"]),
        "worst_scene": {kind: _worst(rows) for kind, rows in by_kind.items()},
        "failed_scenes": {kind: _failed(rows) for kind, rows in by_kind.items()},
        "shown": {kind: _shown(rows, scenes[:SHOWN_SCENES]) for kind, rows in by_kind.items()},
    }
    draw_numbers(results, numbers)
    return numbers


def _draw_errors(results: Results, by_kind: dict[str, list[SeparationOutcome]]) -> None:
    """The smallest distances and the largest excess over the scenes, by kind."""
    series: dict[str, list[float]] = {}
    for kind, rows in by_kind.items():
        for name in ("capsules_mm", "shapes_mm", "excess_after_reaction"):
            series[f"/{name}/{kind}"] = [getattr(row, name) for row in rows]
    results.series(series, "scene")


def _worst(rows: list[SeparationOutcome]) -> int:
    """The number of the scene with the largest excess."""
    return max(rows, key=lambda row: row.excess_after_reaction).number


def _failed(rows: list[SeparationOutcome]) -> list[int]:
    """The numbers of the scenes that did not succeed."""
    return [row.number for row in rows if not row.success]


def _shown(rows: list[SeparationOutcome], scenes: range) -> dict[str, Any]:
    """The points of the figure, from some scenes: distances [mm] and speeds [mm/s]."""
    rows = [row for row in rows if row.number in scenes]
    near = np.concatenate([row.near for row in rows])
    return {
        "scenes": len(rows),
        "closest_of_capsules_mm": min(row.capsules_mm for row in rows),
        "closest_of_shapes_mm": min(row.shapes_mm for row in rows),
        "points": np.round(1000 * near[near[:, 0] < SHOWN_M]).astype(int).T,
    }


def _summary(rows: list[SeparationOutcome]) -> dict[str, Any]:
    closest = np.array([row.shapes_mm for row in rows])
    return {
        "successes": sum(row.success for row in rows),
        "closest_of_shapes_mm": {"least": closest.min(), "median": float(np.median(closest))},
        "overlaps": int((closest < 0).sum()),
        "above_after_reaction": sum(
            row.excess_after_reaction > TUNING.separation.slip_speed_mps for row in rows
        ),
        "limited_s": float(np.mean([row.limited_s for row in rows])),
        **{name: max(getattr(row, name) for row in rows) for name in GREATEST},
        **{name: min(getattr(row, name) for row in rows) for name in ("self_mm", "table_mm")},
    }


def _later(ours: list[SeparationOutcome], free: list[SeparationOutcome]) -> dict[str, Any]:
    """Delay of the events [s] against the same scenes without separation."""
    times_s = {row.number: row.times_s for row in ours}
    late = np.array([np.subtract(times_s[row.number], row.times_s) for row in free])
    return {
        name: {"mean": float(late[:, i].mean()), "most": float(late[:, i].max())}
        for i, name in enumerate(EVENTS)
    }


def _later_for(
    thrust: list[SeparationOutcome], undisturbed: list[SeparationOutcome]
) -> dict[str, Any]:
    """Delay of the end of the task [s] by a thrust, less the time of the thrust, if both runs
    succeed.
    """
    pairs = [
        (row, other)
        for row, other in zip(thrust, undisturbed, strict=True)
        if row.success and other.success
    ]
    late = np.array([row.times_s[-1] - other.times_s[-1] - row.away_s for row, other in pairs])
    away = float(np.mean([row.away_s for row in thrust]))
    return {
        "away": away,
        "mean": float(late.mean()),
        "least": float(late.min()),
        "most": float(late.max()),
    }


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers."""
    plt = pyplot()
    people = Settings().people
    reaction_s = (Settings().hands.stale_ms + people.reaction_ms) / 1000
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.8), sharey=True)
    titles = ("random scenes", "a hand thrust into the path", "random scenes, without separation")
    colours = (OTHER, ADAPTED, "#595959")
    for ax, kind, title, colour in zip(axes, SCENE_KINDS, titles, colours, strict=True):
        content = numbers["shown"][kind]
        distance_mm, speed_mm_s = np.array(content["points"])
        ax.scatter(
            distance_mm, speed_mm_s / 1000, s=5, alpha=0.5, color=colour, lw=0, rasterized=True
        )
        distances = np.linspace(-0.1, SHOWN_M, 200)
        for hand, style in ((0.0, "-"), (0.5, "--")):
            rule = [
                allowed_speed(d, hand, people.brake, reaction_s, people.distance) for d in distances
            ]
            ax.plot(
                1000 * distances,
                rule,
                style,
                color="black",
                lw=1,
                label=f"allowed, hand at {hand:g} m/s",
            )
        closest = content["closest_of_capsules_mm"]
        ax.axvline(closest, color=colour, lw=1.2, ls=":", label=f"least distance: {closest:.0f} mm")
        ax.axvline(0, color="black", lw=0.6)
        ax.set_title(f"{title} ({content['scenes']} shown)", fontsize=9)
        ax.set(xlim=(-100, 1000 * SHOWN_M), ylim=(-0.6, 0.9))
        ax.legend(frameon=False, fontsize=7.5, loc="lower right")
    axes[0].set(ylabel="speed toward the hand [m/s]")
    axes[1].set(xlabel="distance between the rule's capsules of arm and hand [mm]")
    results.figure(figure)
