"""Sessions of a person with a skill, and their judgement: hands as a tracker sees them pass through
the service's core, whose arm moves exactly as commanded.

All sessions run in process at the same rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from thirdhand.contract.records import SIDES, Mode
from thirdhand.core.frame import Event, Tick, order
from thirdhand.core.skill.model import CHI_SQUARE
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.skills.via_points import StartPlace, adapted, with_points
from thirdhand_sim.closed_loop import START_NS, hand_event
from thirdhand_sim.lab.open_loop import controller, frames
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.as_skill import RivalSaid, along_hands, rival
from thirdhand_sim.lab.rivals.method import DependsOn, Mask, Observed, PlacedModel, Predicted
from thirdhand_sim.scene import TOOL_FROM_HAND
from thirdhand_sim.sessions import Session
from thirdhand_sim.teach import via_points_of

TRIAL_HZ = 125
# an event succeeds within 10 mm for 0.3 s below 5 cm/s
WITHIN_M = 0.010
FOR_S = 0.3
SLOW_MPS = 0.05
# a tool faster than 0.25 m/s within 5 cm of a hand is a failure
NEAR_HAND_M = 0.05
FAST_MPS = 0.25
WRONG_M = 0.10  # a target that is farther from the teacher's tool is followed falsely
SMOOTHED = 5  # ticks over which the velocity of a rival's target is computed, if it has a memory
LONGEST_DELAY_S = 0.6
# on the teacher's path, at most this share of the time is falsely followed
MAX_ASTRAY_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class SeenSession:
    """A session tick by tick: as estimated by the service, and the truth."""

    session: Session
    ticks: tuple[Tick, ...]
    times: Array  # (T,) [s]
    estimates: Array  # (T, 3, 6): position, velocity, acceleration of both hands
    rest: Array  # (T, 2) stillness of each hand, 0 to 1
    fresh: Mask  # (T,) true if both hands are seen, each by one source; else a hold is right
    hands: Array  # (T, 6) true positions
    tool: Array  # (T, 3) the teacher's tool


def settings() -> Settings:
    """The service's settings, at the rate of the trials."""
    return msgspec.structs.replace(Settings(), rate_hz=TRIAL_HZ)


def ticks(session: Session) -> Iterator[Tick]:
    """The tracker's samples of a session, tick by tick."""
    inboxes: list[list[Event]] = [[] for _ in range(int(session.lasts_s * TRIAL_HZ))]
    for side, (stamps, samples) in zip(SIDES, session.samples(), strict=True):
        for stamp, (x, y, z) in zip(stamps.tolist(), samples.tolist(), strict=True):
            if (k := int(np.ceil(stamp * TRIAL_HZ - 1e-9))) < len(inboxes):
                inboxes[k].append(hand_event(side, (x, y, z), START_NS + round(1e9 * stamp)))
    return (Tick(k, tuple(inbox)) for k, inbox in enumerate(inboxes))


def seen(session: Session) -> SeenSession:
    """The session, passed through tracker and service, which holds only for reasons of the
    hands.
    """
    all_ticks = tuple(ticks(session))
    core = controller(replace(shipped_skill(), threshold=np.inf), settings())
    times = np.arange(len(all_ticks)) / TRIAL_HZ
    estimates = np.zeros((len(all_ticks), 3, 6))
    stillness = np.zeros((len(all_ticks), 2))
    fresh = np.zeros(len(all_ticks), bool)
    for k, tick in enumerate(all_ticks):
        fresh[k] = core.step(tick)["mode"] == Mode.FOLLOW
        state = core.state
        estimates[k] = state["hands"].transpose(1, 0, 2).reshape(3, 6)
        stillness[k] = state["hand_stillness"]
    return SeenSession(
        session,
        all_ticks,
        times,
        estimates,
        stillness,
        fresh,
        session.hands(times),
        session.tool(times),
    )


class EventOutcome(NamedTuple):
    """One event: success, least distances [mm] from the perceived and from the true place, and True
    if the tool held during the whole window.
    """

    reached: bool
    error_mm: float
    true_error_mm: float
    held: bool


class TrialOutcome(NamedTuple):
    """The outcome of a session with a skill. Shares are of the session's ticks."""

    person: str
    number: int
    success: bool
    events: tuple[EventOutcome, EventOutcome, EventOutcome]
    too_near: bool
    path_mm: float  # rms distance of the target from the teacher's tool, without its delay
    delay_s: float  # delay of the target; next, that of the tool
    tool_delay_s: float
    held: float
    falsely_held: float
    falsely_followed: float
    negative_log_likelihood: float
    inside: tuple[float, ...]  # share of the ticks in the region of each of LEVELS
    predicted_mm: float  # rms that the covariance predicts
    error_mm: float  # rms over the same ticks

    @property
    def kept(self) -> bool:
        """True for a success in which the tool also stays on the teacher's path."""
        return self.success and self.falsely_followed <= MAX_ASTRAY_SHARE


def judge(placed: PlacedModel | Skill | None, one: SeenSession) -> TrialOutcome:
    """The outcome of a session with a skill; None: with the teacher, who perceives the places as
    the methods do.
    """
    served_frames = served(placed, one)
    target = served_frames["target"]
    tool = served_frames["tool"]
    held = served_frames["mode"] != Mode.FOLLOW
    speed = np.linalg.norm(np.gradient(tool, 1.0 / TRIAL_HZ, axis=0), axis=1)
    events = tuple(_event(one, tool, speed, held, i) for i in range(3))
    hand_distance_m = np.linalg.norm(tool[:, None] - one.hands.reshape(-1, 2, 3), axis=2).min(
        axis=1
    )
    too_near = bool(((hand_distance_m < NEAR_HAND_M) & (speed > FAST_MPS)).any())
    judged = one.times > 0.5
    good = judged & one.fresh
    delay, _ = _delayed(target, one.tool, good)
    tool_delay, _ = _delayed(tool, one.tool, good & ~held)
    teacher_tool = np.concatenate(
        [np.repeat(one.tool[:1], delay, axis=0), one.tool[: len(target) - delay]]
    )
    errors = (teacher_tool - target)[good]
    covariance = served_frames["covariance"][good]
    squares = np.einsum(
        "ti,ti->t", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0]
    )
    radii = placed.regions.radii if isinstance(placed, Skill) else CHI_SQUARE
    likelihood = 0.5 * (squares + np.linalg.slogdet(covariance)[1] + 3.0 * np.log(2.0 * np.pi))
    wrong = np.linalg.norm(target - teacher_tool, axis=1) > WRONG_M
    return TrialOutcome(
        one.session.person.name,
        one.session.number,
        all(event.reached for event in events) and not too_near,
        events,  # type: ignore[arg-type]
        too_near,
        1000 * float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        delay / TRIAL_HZ,
        tool_delay / TRIAL_HZ,
        float(held[judged].mean()),
        float((held & good).sum() / judged.sum()),
        float((~held & wrong & judged).sum() / judged.sum()),
        float(np.minimum(likelihood, 1e3).mean()),
        tuple(float((squares <= radius).mean()) for radius in radii),
        1000 * float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())),
        1000 * float(np.sqrt(np.sum(errors**2, axis=1).mean())),
    )


def served(placed: PlacedModel | Skill | None, one: SeenSession) -> NDArray[np.void]:
    """The service's frames (T,) of a session, with its skill or a rival."""
    if isinstance(placed, StoredSkill):
        return _of_service(placed, one)
    assert not isinstance(placed, Skill)
    predicted, motion = _moving(placed, one)
    assert predicted.covariance is not None
    covariance = predicted.covariance
    held = predicted.held
    now = 0

    def counted() -> Iterator[Tick]:
        nonlocal now
        for tick in one.ticks:
            now = tick.index
            yield tick

    skill = rival(
        shipped_skill(),
        lambda *moving: RivalSaid(
            motion[now], covariance[now], held is not None and bool(held[now])
        ),
        via_points=via_points_of(one.session.told),
    )
    return frames(skill, counted(), settings())


def _of_service(skill: StoredSkill, one: SeenSession) -> NDArray[np.void]:
    """The frames (T,) with the service's skill, whose start is moved as the daemon does."""
    core = controller(skill, settings())
    start = StartPlace(settings().period_s)
    out = []
    events: tuple[Event, ...] = ()
    for tick in one.ticks:
        out.append(core.step(Tick(tick.index, (*events, *tick.inbox))))
        events = ()
        if points := start.moved(skill, core.state):
            skill = adapted(skill, with_points(skill, points), tolerance=skill.tolerance)
            start.taken()
            events = Event("skill", skill.file, skill.for_loop()), order("begin")
    return np.array(out)


def _moving(placed: PlacedModel | None, one: SeenSession) -> tuple[Predicted, Array]:
    """A rival's predictions at all ticks, and the motion of its target (T, 3, 3).

    If a rival is a function of the hands, its target moves with them, as with the service's skill;
    otherwise velocities follow from consecutive predictions.
    """
    s, v, a = one.estimates.transpose(1, 0, 2)
    if placed is None:
        count = len(one.times)
        as_told = replace(one.session, places=one.session.told)
        predicted = Predicted(as_told.tool(one.times), np.tile(1e-4 * np.eye(3), (count, 1, 1)))
    else:
        observed = Observed(one.times, s, v, one.rest)
        predicted = placed.predict(observed)
        if placed.depends_on is DependsOn.HANDS:
            return predicted, along_hands(
                lambda hands: placed.mean(observed._replace(hands=hands)), s, v, a
            )
    before = np.concatenate(
        [np.repeat(predicted.mean[:1], SMOOTHED, axis=0), predicted.mean[:-SMOOTHED]]
    )
    velocity = (predicted.mean - before) * TRIAL_HZ / SMOOTHED
    return predicted, np.stack([predicted.mean, velocity, np.zeros_like(velocity)], axis=1)


def _event(one: SeenSession, tool: Array, speed: Array, held: Mask, i: int) -> EventOutcome:
    begin, end = one.session.windows[i]
    window = (one.times >= begin) & (one.times < end)
    # the board belongs to the tracked hand
    if i == 0:
        perceived = one.estimates[window, 0, :3] + TOOL_FROM_HAND
        true = one.hands[window, :3] + TOOL_FROM_HAND
    else:
        places = one.session.told, one.session.places
        perceived, true = (
            np.broadcast_to(p.glass if i == 1 else p.carry, (int(window.sum()), 3)) for p in places
        )
    distance_m = np.linalg.norm(tool[window] - perceived, axis=1)
    is_within = (distance_m <= WITHIN_M) & (speed[window] < SLOW_MPS)
    steps = int(FOR_S * TRIAL_HZ)
    runs = (
        np.convolve(is_within, np.ones(steps), mode="valid")
        if len(is_within) >= steps
        else np.zeros(1)
    )
    best = int(np.argmin(uniform_filter1d(distance_m, steps, mode="nearest")))
    true_off = np.linalg.norm(tool[window] - true, axis=1)
    reached = bool((runs >= steps - 0.5).any())
    was_held = bool(held[window].mean() > 0.8)
    return EventOutcome(
        reached, 1000 * float(distance_m[best]), 1000 * float(true_off[best]), was_held
    )


def _delayed(x: Array, wanted: Array, good: Mask) -> tuple[int, float]:
    """Delay [ticks] of `x` (T, 3) behind `wanted`, and the mean square distance at it [m²]."""
    count = len(x)
    candidates = []
    for delay in range(0, int(LONGEST_DELAY_S * TRIAL_HZ), 2):
        squares = np.sum((x[delay:] - wanted[: count - delay]) ** 2, axis=1)[good[delay:]]
        candidates.append((float(squares.mean()) if len(squares) else np.inf, delay))
    least, delay = min(candidates)
    return delay, least
