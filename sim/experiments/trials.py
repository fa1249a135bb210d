"""One session of a person with one skill: hands as a tracker sees them through the service's core,
whose arm does as it is told; and what is judged of it.

All in process at one rate, the same for every skill.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from service.contract.records import SIDES, Mode
from service.core.frame import Event, Tick
from service.core.skill.model import CHI_SQUARE
from service.core.skill.skill import Skill
from service.files.shipped import shipped_skill
from service.settings.config import Settings
from sim.closed_loop import START_NS, hand_event
from sim.experiments.open_loop import Said, along_hands, controller, frames, rival
from sim.experiments.results import Array
from sim.people import Places
from sim.scene import TOOL_FROM_HAND
from sim.sessions import Session, SessionDemonstration
from sim.teach import places_of

RATE_HZ = 125
WITHIN_M, FOR_S, SLOW_MPS = 0.010, 0.3, 0.05  # of an event
NEAR_M, FAST_MPS = 0.05, 0.25  # faster than this nearer than that to a hand is a failure
WRONG_M = 0.10  # a target so far from the teacher's is followed falsely
SMOOTHED = 5  # ticks over which a target's velocity is taken where a rival has a memory
LONGEST_DELAY_S = 0.6
KEPT = 0.05  # share of the time falsely followed up to which the way was kept
SWAP_NOTICED_S, SWAP_OVER_S = 0.3, 0.2  # until when it must be held; after it the hands' estimates are coming back
Mask = NDArray[np.bool_]


class Predicted(NamedTuple):
    """Means (T, 3) [m], covariances (T, 3, 3) [m²], and whether each is far from the data (T,)."""

    mean: Array
    covariance: Array
    far: Mask


class Placed(Protocol):
    """A rival that was told the places of a scene."""

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

    def place(self, places: Places) -> Placed | Skill:
        """The rival, or a skill of the service, in a scene whose places are perceived so."""


class Method(Protocol):
    """A way to learn, with its parameters."""

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> Model:
        """The model of demonstrations."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A session as the service sees it, tick by tick, and as it is."""

    session: Session
    ticks: tuple[Tick, ...]
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


def ticks(session: Session) -> Iterator[Tick]:
    """What the tracker says of a session, tick by tick."""
    inboxes: list[list[Event]] = [[] for _ in range(int(session.lasts_s * RATE_HZ))]
    for side, (stamps, samples) in zip(SIDES, session.samples(), strict=True):
        for stamp, (x, y, z) in zip(stamps.tolist(), samples.tolist(), strict=True):
            if (k := int(np.ceil(stamp * RATE_HZ - 1e-9))) < len(inboxes):
                inboxes[k].append(hand_event(side, (x, y, z), START_NS + round(1e9 * stamp)))
    return (Tick(k, tuple(inbox)) for k, inbox in enumerate(inboxes))


def seen(session: Session) -> Seen:
    """The session through tracker and service, which holds for nothing but the hands."""
    known = tuple(ticks(session))
    core = controller(replace(shipped_skill(), threshold=np.inf), settings())
    times = np.arange(len(known)) / RATE_HZ
    estimates, rest, fresh = np.zeros((len(known), 3, 6)), np.zeros((len(known), 2)), np.zeros(len(known), bool)
    for k, tick in enumerate(known):
        fresh[k] = core.step(tick)["mode"] == Mode.FOLLOW
        state = core.state
        estimates[k], rest[k] = state["hands"].transpose(1, 0, 2).reshape(3, 6), state["hand_stillness"]
    begin, end = session.swapped_s
    swapped = (times >= begin) & (times < end + SWAP_OVER_S)
    return Seen(session, known, times, estimates, rest, fresh, swapped, session.hands(times), session.tool(times))


class EventOutcome(NamedTuple):
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
    events: tuple[EventOutcome, EventOutcome, EventOutcome]
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


def judge(placed: Placed | Skill | None, one: Seen) -> Outcome:
    """The outcome of a session; None stands for the teacher, who is told the places as the others
    are.
    """
    found = served(placed, one)
    target, tool, held = found["target"], found["tool"], found["mode"] != Mode.FOLLOW
    speed = np.linalg.norm(np.gradient(tool, 1.0 / RATE_HZ, axis=0), axis=1)
    events = tuple(_event(one, tool, speed, held, i) for i in range(3))
    apart = np.linalg.norm(tool[:, None] - one.hands.reshape(-1, 2, 3), axis=2).min(axis=1)
    too_near = bool(((apart < NEAR_M) & (speed > FAST_MPS)).any())
    judged = one.times > 0.5
    good = judged & ~one.due
    delay, _ = _delayed(target, one.tool, good)
    tool_delay, _ = _delayed(tool, one.tool, good & ~held)
    wanted = np.concatenate([np.repeat(one.tool[:1], delay, axis=0), one.tool[: len(target) - delay]])
    errors, covariance = (wanted - target)[good], found["covariance"][good]
    squares = np.einsum("ti,ti->t", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0])
    radii = placed.regions.radii if isinstance(placed, Skill) else CHI_SQUARE
    likelihood = 0.5 * (squares + np.linalg.slogdet(covariance)[1] + 3.0 * np.log(2.0 * np.pi))
    wrong = np.linalg.norm(target - wanted, axis=1) > WRONG_M
    planted = (one.times >= one.session.swapped_s[0] + SWAP_NOTICED_S) & (one.times < one.session.swapped_s[1]) & judged
    return Outcome(
        one.session.person.name,
        one.session.number,
        all(event.reached for event in events) and not too_near,
        events,  # type: ignore[arg-type]
        too_near,
        1000 * float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
        delay / RATE_HZ,
        tool_delay / RATE_HZ,
        float(held[judged].mean()),
        float((held & good).sum() / judged.sum()),
        float((~held & wrong & judged).sum() / judged.sum()),
        float(planted.sum() / judged.sum()),
        float((held & planted).sum() / judged.sum()),
        float(np.minimum(likelihood, 1e3).mean()),
        tuple(float((squares <= radius).mean()) for radius in radii),
        1000 * float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())),
        1000 * float(np.sqrt(np.sum(errors**2, axis=1).mean())),
    )


def served(placed: Placed | Skill | None, one: Seen) -> NDArray[np.void]:
    """The service's frames (T,) of a session: with its skill, or with a rival in its place."""
    if isinstance(placed, Skill):
        return frames(placed, one.ticks, settings())
    predicted, motion = _moving(placed, one)
    now = 0

    def counted() -> Iterator[Tick]:
        nonlocal now
        for tick in one.ticks:
            now = tick.index
            yield tick

    skill = rival(
        shipped_skill(),
        lambda *moving: Said(motion[now], predicted.covariance[now], bool(predicted.far[now])),
        via_points=places_of(one.session.told),
    )
    return frames(skill, counted(), settings())


def _moving(placed: Placed | None, one: Seen) -> tuple[Predicted, Array]:
    """A rival's predictions of all ticks, and how its target moves (T, 3, 3).

    Of a memoryless one along the hands' motion, as of the service's skill; of another by
    differences in time of what it has said.
    """
    s, v, a = one.estimates.transpose(1, 0, 2)
    if placed is None:
        count, as_told = len(one.times), replace(one.session, places=one.session.told)
        predicted = Predicted(as_told.tool(one.times), np.tile(1e-4 * np.eye(3), (count, 1, 1)), np.zeros(count, bool))
    else:
        predicted = placed.predict(s, one.rest)
        if placed.memoryless:
            return predicted, along_hands(lambda hands: placed.mean(hands, one.rest), s, v, a)
    before = np.concatenate([np.repeat(predicted.mean[:1], SMOOTHED, axis=0), predicted.mean[:-SMOOTHED]])
    velocity = (predicted.mean - before) * RATE_HZ / SMOOTHED
    return predicted, np.stack([predicted.mean, velocity, np.zeros_like(velocity)], axis=1)


def _event(one: Seen, tool: Array, speed: Array, held: Mask, i: int) -> EventOutcome:
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
    return EventOutcome(reached, 1000 * float(off[best]), 1000 * float(true_off[best]), was_held)


def _delayed(x: Array, wanted: Array, good: Mask) -> tuple[int, float]:
    """By how many ticks `x` (T, 3) comes after `wanted`, and its mean square distance then [m²]."""
    count = len(x)
    found = []
    for delay in range(0, int(LONGEST_DELAY_S * RATE_HZ), 2):
        off = np.sum((x[delay:] - wanted[: count - delay]) ** 2, axis=1)[good[delay:]]
        found.append((float(off.mean()) if len(off) else np.inf, delay))
    least, delay = min(found)
    return delay, least
