"""One session of a person with one skill, open loop: hands through the service's own intake, the
skill's target, the service's own setpoint stage with its limits; and what is judged of it.

All in process at one rate, the same for every skill. The tool is where the setpoint is: no arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2

from service.config import Settings
from service.contract.messages import BASE, PoseStamped
from service.core.frame import state_layout
from service.core.intake.intake import Intake
from service.core.record import blank
from service.core.setpoint.setpoint import SetpointGenerator
from service.core.skill.workspace import Target
from service.core.stops import fastest_stop
from sim.closed_loop import START_NS
from sim.experiments.results import Array
from sim.people import Places
from sim.scene import TOOL_FROM_HAND
from sim.sessions import Session, Shown

RATE_HZ = 125
WITHIN_M, FOR_S, SLOW_MPS = 0.010, 0.3, 0.05  # of an event
NEAR_M, FAST_MPS = 0.05, 0.25  # faster than this nearer than that to a hand is a failure
WRONG_M = 0.10  # a target so far from the teacher's is followed falsely
STEP_S = 0.02  # of differences along the hands' motion
CALM_MPS = 0.2  # a slower hand trembles: its velocity says nothing of where the tool will be
SMOOTHED = 5  # ticks over which a target's velocity is taken where the skill has a memory
RESUMED_S = 0.1  # hands must be near the data for so long after they were far
LONGEST_DELAY_S = 0.6
LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)  # of the regions whose coverage is counted
KEPT = 0.05  # share of the time falsely followed up to which the way was kept
SWAP_NOTICED_S, SWAP_OVER_S = 0.3, 0.2  # until when it must be held; after it the hands' estimates are coming back
Mask = NDArray[np.bool_]


class Predicted(NamedTuple):
    """Means (T, 3) [m], covariances (T, 3, 3) [m²], and whether each is far from the data (T,)."""

    mean: Array
    covariance: Array
    far: Mask


class Placed(Protocol):
    """A skill that was told the places of a scene."""

    @property
    def memoryless(self) -> bool:
        """Whether a prediction depends on the hands of its moment alone, and how they rest."""

    def predict(self, hands: Array, rest: Array) -> Predicted:
        """The tool for both hands (T, 6) [m] that rest so much (T, 2), one row a tick, in the order
        of time.
        """

    def mean(self, hands: Array, rest: Array) -> Array:
        """The means alone (T, 3) [m]; asked of what is memoryless."""


class Model(Protocol):
    """What was learned from demonstrations."""

    def place(self, places: Places) -> Placed:
        """The skill in a scene whose places are perceived so."""


class Method(Protocol):
    """A way to learn, with its parameters."""

    def learn(self, demonstrations: Sequence[Shown]) -> Model:
        """The model of demonstrations."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A session as the service sees it, tick by tick, and as it is."""

    session: Session
    times: Array  # (T,) [s]
    estimates: Array  # (T, 3, 6): position, velocity, acceleration of both hands
    rest: Array  # (T, 2) how much each hand rests
    fresh: Mask  # (T,) whether both hands are seen, by one source
    swapped: Mask  # (T,) whether left is taken for right
    hands: Array  # (T, 6) as they are
    tool: Array  # (T, 3) the teacher's

    @property
    def due(self) -> Mask:
        """Where holding is right (T,)."""
        return np.asarray(~self.fresh | self.swapped)


def settings() -> Settings:
    """The service's own, at the rate of the trials."""
    return msgspec.structs.replace(Settings(), rate_hz=RATE_HZ)


def seen(session: Session) -> Seen:
    """The session through tracker and intake."""
    chosen = settings()
    intake, state = Intake(chosen), blank(state_layout(len(chosen.joints.names)))
    intake.begin(state)
    ticks = int(session.lasts_s * RATE_HZ)
    times = np.arange(ticks) / RATE_HZ
    samples = session.samples()
    at = [np.ceil(stamps * RATE_HZ - 1e-9).astype(int) for stamps, _ in samples]
    upto = [0, 0]
    estimates, rest, fresh = np.zeros((ticks, 3, 6)), np.zeros((ticks, 2)), np.zeros(ticks, bool)
    for k in range(ticks):
        intake.advance(state, 1)
        for side in (0, 1):
            while upto[side] < len(at[side]) and at[side][upto[side]] <= k:
                i = upto[side]
                x, y, z = samples[side][1][i].tolist()
                stamp_ns = START_NS + round(1e9 * float(samples[side][0][i]))
                intake.take_hand(state, side, PoseStamped(stamp_ns, BASE, (x, y, z), (0.0, 0.0, 0.0, 1.0)))
                upto[side] += 1
        estimates[k], rest[k] = state["hands"].transpose(1, 0, 2).reshape(3, 6), state["repose"]
        fresh[k] = intake.are_fresh(state) and not intake.is_contested(state, already=bool(k and not fresh[k - 1]))
    begin, end = session.swapped_s
    swapped = (times >= begin) & (times < end + SWAP_OVER_S)
    return Seen(session, times, estimates, rest, fresh, swapped, session.hands(times), session.tool(times))


def workspace(demonstrations: Sequence[Shown]) -> Array:
    """The box (2, 3) [m] that targets are kept in, the same for every skill."""
    tools = np.concatenate([one.tool for one in demonstrations])
    return np.stack([tools.min(axis=0) - 0.25, tools.max(axis=0) + 0.25])


class Event(NamedTuple):
    """How one event went: whether it succeeded, the least distance [mm] to the place as perceived,
    then to the true one, and whether the tool held all through its window.
    """

    reached: bool
    error_mm: float
    true_error_mm: float
    held: bool


class Outcome(NamedTuple):
    """What became of a session with a skill. Shares are of the session's ticks."""

    person: str
    number: int
    success: bool
    events: tuple[Event, Event, Event]
    too_near: bool
    path_mm: float  # rms of the target from the teacher's tool, its delay taken out
    delay_s: float  # of the target; and of the tool
    tool_delay_s: float
    held: float
    falsely_held: float
    falsely_followed: float
    swapped: float  # from 0.3 s after left was taken for right
    swapped_held: float  # of the session, as all shares
    negative_log_likelihood: float
    inside: tuple[float, ...]  # share of the ticks in the region of each of LEVELS
    predicted_mm: float  # rms that the covariance predicts
    error_mm: float  # rms over the same ticks

    @property
    def kept(self) -> bool:
        """A success on the teacher's way, not only at its places."""
        return self.success and self.falsely_followed <= KEPT


def judge(placed: Placed | None, one: Seen, box: Array) -> Outcome:
    """The outcome of a session; None stands for the teacher, who is told the places as the others
    are.
    """
    predicted, velocity, acceleration = _targets(placed, one)
    mean = np.clip(predicted.mean, box[0], box[1])
    inside = mean == predicted.mean
    held = _held(predicted.far) | ~one.fresh
    targets = np.stack([mean, velocity * inside, acceleration * inside])
    tool = follow(targets, held, start=one.session.places.robot_start, box=box)
    speed = np.linalg.norm(np.gradient(tool, 1.0 / RATE_HZ, axis=0), axis=1)
    events = tuple(_event(one, tool, speed, held, i) for i in range(3))
    apart = np.linalg.norm(tool[:, None] - one.hands.reshape(-1, 2, 3), axis=2).min(axis=1)
    too_near = bool(((apart < NEAR_M) & (speed > FAST_MPS)).any())
    judged = one.times > 0.5
    good = judged & ~one.due
    delay, _ = _delayed(mean, one.tool, good)
    tool_delay, _ = _delayed(tool, one.tool, good & ~held)
    wanted = np.concatenate([np.repeat(one.tool[:1], delay, axis=0), one.tool[: len(mean) - delay]])
    errors = (wanted - predicted.mean)[good]
    covariance = predicted.covariance[good]
    squares = np.einsum("ti,ti->t", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0])
    likelihood = 0.5 * (squares + np.linalg.slogdet(covariance)[1] + 3.0 * np.log(2.0 * np.pi))
    wrong = np.linalg.norm(mean - wanted, axis=1) > WRONG_M
    planted = (one.times >= one.session.swapped_s[0] + SWAP_NOTICED_S) & (one.times < one.session.swapped_s[1]) & judged
    return Outcome(
        one.session.person.name,
        one.session.number,
        all(event.reached for event in events) and not too_near,
        events,  # type: ignore[arg-type]
        too_near,
        1000 * float(np.sqrt(np.mean(np.sum((wanted - mean)[good] ** 2, axis=1)))),
        delay / RATE_HZ,
        tool_delay / RATE_HZ,
        float(held[judged].mean()),
        float((held & good).sum() / judged.sum()),
        float((~held & wrong & judged).sum() / judged.sum()),
        float(planted.sum() / judged.sum()),
        float((held & planted).sum() / judged.sum()),
        float(np.minimum(likelihood, 1e3).mean()),
        tuple(float((squares <= quantile).mean()) for quantile in np.asarray(chi2.ppf(LEVELS, 3))),
        1000 * float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())),
        1000 * float(np.sqrt(np.sum(errors**2, axis=1).mean())),
    )


def _targets(placed: Placed | None, one: Seen) -> tuple[Predicted, Array, Array]:
    """The predictions of all ticks, and how the target moves: velocities and accelerations (T, 3).

    Of a memoryless skill by differences along the hands' motion, as the service's own derivatives
    say, and none along that of a hand which only trembles; of another by differences in time of
    what it has said.
    """
    s, v, a = one.estimates.transpose(1, 0, 2)
    if placed is None or not placed.memoryless:
        if placed is None:
            count, as_told = len(one.times), replace(one.session, places=one.session.told)
            predicted = Predicted(
                as_told.tool(one.times), np.tile(1e-4 * np.eye(3), (count, 1, 1)), np.zeros(count, bool)
            )
        else:
            predicted = placed.predict(s, one.rest)
        before = np.concatenate([np.repeat(predicted.mean[:1], SMOOTHED, axis=0), predicted.mean[:-SMOOTHED]])
        velocity = (predicted.mean - before) * RATE_HZ / SMOOTHED
        return predicted, velocity, np.zeros_like(velocity)
    predicted = placed.predict(s, one.rest)
    speed = np.repeat(np.linalg.norm(v.reshape(-1, 2, 3), axis=2), 3, axis=1)
    goes = 1.0 - np.exp(-((speed / CALM_MPS) ** 4))
    step, curve = STEP_S * goes * v, STEP_S**2 / 2 * goes * a
    behind, ahead = (placed.mean(s + way * step + curve, one.rest) for way in (-1, 1))
    most = settings().tool.max_acceleration
    acceleration = np.clip((ahead - 2 * predicted.mean + behind) / STEP_S**2, -most, most)
    return predicted, (ahead - behind) / (2 * STEP_S), acceleration


def _held(far: Mask) -> Mask:
    """Far, and a moment longer (T,)."""
    steps = int(RESUMED_S * RATE_HZ)
    recent = np.convolve(far, np.ones(steps + 1))[: len(far)]
    return np.asarray(recent > 0)


def follow(targets: Array, held: Mask, *, start: Array, box: Array) -> Array:
    """The setpoints (T, 3) [m] that follow targets (3, T, 3), positions, velocities and
    accelerations, and brake where held (T,), from rest at `start`.
    """
    chosen = settings()
    generator, state = SetpointGenerator(chosen), blank(state_layout(len(chosen.joints.names)))
    generator.begin(state, np.stack([start, np.zeros(3), np.zeros(3)]))
    mean, velocity, acceleration = np.ascontiguousarray(targets)
    costs, out, stop = np.zeros((3, 3, 1)), np.empty(mean.shape), np.empty(6)
    tool = chosen.tool
    for k in range(len(mean)):
        if held[k]:
            now = state["setpoint"]
            if not now[1:].any():
                out[k] = now[0]
                continue
            for i in range(3):
                fastest_stop(now[1, i], now[2, i], tool.max_acceleration, tool.max_jerk, chosen.period_s, stop)
                now[0, i] += stop[2]
                now[1, i], now[2, i] = stop[0], stop[1]
            generator.begin(state, now.copy())
        else:
            generator.step(state, Target(mean[k], velocity[k], acceleration[k], clamped=False), box, costs, 1.0)
        out[k] = state["setpoint"][0]
    return out


def _event(one: Seen, tool: Array, speed: Array, held: Mask, i: int) -> Event:
    begin, end = one.session.windows[i]
    window = (one.times >= begin) & (one.times < end)
    if i == 0:  # the board is wanted where the hand is, as it is seen
        told = one.estimates[window, 0, :3] + TOOL_FROM_HAND
        true = one.hands[window, :3] + TOOL_FROM_HAND
    else:
        places = one.session.told, one.session.places
        told, true = (np.broadcast_to(p.glass if i == 1 else p.carry, (int(window.sum()), 3)) for p in places)
    off = np.linalg.norm(tool[window] - told, axis=1)
    there = (off <= WITHIN_M) & (speed[window] < SLOW_MPS)
    steps = int(FOR_S * RATE_HZ)
    runs = np.convolve(there, np.ones(steps), mode="valid") if len(there) >= steps else np.zeros(1)
    best = int(np.argmin(uniform_filter1d(off, steps, mode="nearest")))
    true_off = np.linalg.norm(tool[window] - true, axis=1)
    reached, was_held = bool((runs >= steps - 0.5).any()), bool(held[window].mean() > 0.8)
    return Event(reached, 1000 * float(off[best]), 1000 * float(true_off[best]), was_held)


def _delayed(x: Array, wanted: Array, good: Mask) -> tuple[int, float]:
    """By how many ticks `x` (T, 3) comes after `wanted`, and its mean square distance then [m²]."""
    count = len(x)
    found = []
    for delay in range(0, int(LONGEST_DELAY_S * RATE_HZ), 2):
        off = np.sum((x[delay:] - wanted[: count - delay]) ** 2, axis=1)[good[delay:]]
        found.append((float(off.mean()) if len(off) else np.inf, delay))
    least, delay = min(found)
    return delay, least
