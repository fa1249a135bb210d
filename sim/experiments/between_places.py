"""A KMP of how far hands have come between the places of a scene, not of where they are: what was
learned in one scene holds in another. Not the service's skill: what that could come to be.

Hands become shares of their places (barycentric coordinates), the tool shares of its own and a
deviation from them. A hand that rests belongs to the place it rests nearest to; one that moves is
on its way. Covariances are those of demonstrations that were left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians, ViaPointMissed
from sim.experiments.results import Array
from sim.experiments.trials import Predicted
from sim.people import Places
from sim.scene import TOOL_FROM_HAND
from sim.sessions import Shown

FOLLOWED_M = 0.25  # within which of the handover the tool goes with the hand
AT, ALIKE = 0.9, 0.85  # share from which on hands are at a place; and the tool, in the median
LEAST_SAMPLES = 10  # there, for a pair of places to be known
UNSEEN = (0.15, 0.3, 0.45)  # of the way to a pair that was not: the tool stays
TAUGHT = 1e-4  # deviation of the share at a known pair
SMOOTHED_S = 0.28  # of hands in demonstrations
ALMOST = 1e-4  # share that every place has, so that none is of an undefined power
COVARIANCE_EVERY = 4  # ticks
NEAR = 0.25  # width, in shares, of what is near to a moment when scatter is looked up
LEAST_STD_M = 0.003


@dataclass(frozen=True)
class BetweenPlaces:
    """The method; lengths are shares, from 0 at a place to 1 at the next."""

    sharpness: float = 4.0  # power of a resting hand's shares
    rest_mps: float = 0.12  # a hand this fast is on its way
    ell: float = 4.0
    deviation: float = 0.05  # of a demonstration's sample
    each: int = 30  # samples of a demonstration
    gate: float = 1.5  # times as far from its places as in the demonstrations: far

    def learn(self, demonstrations: Sequence[Shown]) -> LearnedBetween:
        """The skill, and how it errs in demonstrations that were left out."""
        shown = [_Told.of(self, one) for one in demonstrations]
        whole = _fitted(self, shown)
        shares, errors = [], []
        for i, one in enumerate(shown):
            placed = PlacedBetween(LearnedBetween(self, _fitted(self, shown[:i] + shown[i + 1 :])), one.places)
            shares.append(one.shares)
            errors.append(one.tool - placed.mean(one.hands, one.velocities))
        reach = max(float(off_places(one.hands, one.places).max()) for one in shown)
        return LearnedBetween(self, whole, np.concatenate(shares), np.concatenate(errors), self.gate * reach)

    def shares(self, hands: Array, velocities: Array, places: Places) -> Array:
        """Features (T, 5) of hands and velocities (T, 6): the left hand's shares of start, handover
        and board; the right one's of start and iron together, and of where it solders.
        """
        out = []
        for side, corners in enumerate(hand_places(places)):
            part = slice(3 * side, 3 * side + 3)
            share = barycentric(hands[:, part], corners) + ALMOST
            rest = np.exp(-((np.linalg.norm(velocities[:, part], axis=1) / self.rest_mps) ** 4))
            share **= (1.0 + (self.sharpness - 1.0) * rest)[:, None]
            out.append(share / share.sum(axis=1, keepdims=True))
        left, right = out
        return np.column_stack([left, right[:, 0] + right[:, 1], right[:, 2]])


def hand_places(places: Places) -> tuple[Array, Array]:
    """Where the left and the right hand come to (3, 3) [m]."""
    p = places
    return np.array([p.left_start, p.handover, p.board]), np.array([p.right_start, p.iron, p.right_final])


def tool_places(places: Places) -> Array:
    """Where the tool comes to (4, 3) [m]."""
    return np.array([places.robot_start, places.handover + TOOL_FROM_HAND, places.glass, places.carry])


def barycentric(points: Array, corners: Array) -> Array:
    """Coordinates (T, 3), at least 0 and 1 in sum, of the point of a triangle (3, 3) that is
    nearest to each point (T, 3).
    """
    a, b, c = corners
    edges = np.stack([b - a, c - a], axis=1)
    inner = np.linalg.solve(edges.T @ edges + 1e-6 * np.eye(2), edges.T @ (points - a).T).T
    out = np.column_stack([1.0 - inner.sum(axis=1), inner])
    outside = np.flatnonzero((out < 0.0).any(axis=1))
    least = np.full(len(outside), np.inf)
    for i, j in ((0, 1), (1, 2), (0, 2)):
        way = corners[j] - corners[i]
        along = np.clip((points[outside] - corners[i]) @ way / (way @ way + 1e-9), 0.0, 1.0)
        off = np.sum((points[outside] - corners[i] - along[:, None] * way) ** 2, axis=1)
        nearer = off < least
        least[nearer] = off[nearer]
        rows, share = outside[nearer], along[nearer]
        out[rows] = 0.0
        out[rows, i], out[rows, j] = 1.0 - share, share
    return out


def off_places(hands: Array, places: Places) -> Array:
    """How far each hand (T, 2) [m] is from the triangle of its places; hands are (T, 6)."""
    found = []
    for side, corners in enumerate(hand_places(places)):
        points = hands[:, 3 * side : 3 * side + 3]
        found.append(np.linalg.norm(points - barycentric(points, corners) @ corners, axis=1))
    return np.stack(found, axis=1)


def carried(hands: Array, places: Places, share: Array) -> Array:
    """By how much the tool goes with the left hand (T, 3) [m] where it has this share (T,) of the
    handover.
    """
    off = hands[:, :3] - places.handover
    return np.asarray((share * np.exp(-((np.linalg.norm(off, axis=1) / FOLLOWED_M) ** 4)))[:, None] * off)


@dataclass(frozen=True, eq=False)
class _Told:
    """A demonstration in shares: of the hands (T, 5), and of the tool (T, 4) with its deviation."""

    places: Places
    hands: Array
    velocities: Array
    tool: Array
    shares: Array
    tool_shares: Array
    rows: Array  # the samples that are learned from, evenly along the way
    wanted: Array  # (T, 6)

    @staticmethod
    def of(method: BetweenPlaces, shown: Shown) -> _Told:
        period_s = float(np.diff(shown.times).mean())
        window = np.hanning(round(SMOOTHED_S / period_s) + 2)[1:-1]
        reach = len(window) // 2
        padded = [np.pad(column, (reach, len(window) - 1 - reach), mode="edge") for column in shown.hands.T]
        hands = np.stack([np.convolve(column, window / window.sum(), mode="valid") for column in padded], axis=1)
        velocities = np.gradient(hands, period_s, axis=0)
        places, corners = shown.places, tool_places(shown.places)
        shares = method.shares(hands, velocities, places)
        tool_shares = _along(shown.tool, corners)
        deviation = shown.tool - tool_shares @ corners - carried(hands, places, tool_shares[:, 1])
        steps = np.linalg.norm(np.diff(np.hstack([shares, 3.0 * shown.tool]), axis=0), axis=1) + 0.002
        way = np.concatenate([[0.0], np.cumsum(steps)])
        rows = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], method.each)).clip(0, len(way) - 1))
        wanted = np.hstack([tool_shares[:, 1:], deviation])
        return _Told(places, hands, velocities, shown.tool, shares, tool_shares, rows, wanted)


def _along(tool: Array, corners: Array) -> Array:
    """Shares (T, 4) of the point nearest to the tool (T, 3) on the way from place to place."""
    out, least = np.zeros((len(tool), len(corners))), np.full(len(tool), np.inf)
    for i in range(len(corners) - 1):
        way = corners[i + 1] - corners[i]
        along = np.clip((tool - corners[i]) @ way / (way @ way), 0.0, 1.0)
        off = np.sum((tool - corners[i] - along[:, None] * way) ** 2, axis=1)
        nearer = off < least
        least[nearer] = off[nearer]
        out[nearer] = 0.0
        out[nearer, i], out[nearer, i + 1] = 1.0 - along[nearer], along[nearer]
    return out


def _fitted(method: BetweenPlaces, shown: Sequence[_Told]) -> KMP:
    """The KMP, with the tool at its place wherever both hands were found to be at theirs."""
    inputs = np.concatenate([one.shares[one.rows] for one in shown])
    outputs = np.concatenate([one.wanted[one.rows] for one in shown])
    reference = Gaussians(outputs, np.tile(method.deviation**2 * np.eye(6), (len(inputs), 1, 1)))
    kernel = GaussianKernel(method.ell)
    primitive = KMP.fit(inputs, reference, kernel=kernel, lambda_mean=1.0, prior_mean=outputs.mean(axis=0))
    at, wanted = _pairs(np.concatenate([o.shares for o in shown]), np.concatenate([o.tool_shares for o in shown]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ViaPointMissed)
        taught = Gaussians(wanted, np.tile(TAUGHT**2 * np.eye(6), (len(at), 1, 1)))
        return primitive.adapt(at, taught, tolerance=0.05)


def _pairs(shares: Array, tool_shares: Array) -> tuple[Array, Array]:
    """Inputs (V, 5) and outputs (V, 6) of the pairs of places at which the tool was always at the
    same one, and some way toward pairs at which nobody was: there it stays.
    """
    known: dict[tuple[int, int], Array] = {}
    for left in range(3):
        for right in range(2):
            there = (shares[:, left] > AT) & (shares[:, 3 + right] > AT)
            if there.sum() >= LEAST_SAMPLES:
                usual = np.median(tool_shares[there], axis=0)
                if usual.max() > ALIKE:
                    known[left, right] = np.append(np.eye(4)[np.argmax(usual), 1:], np.zeros(3))
    at, wanted = [], []
    for (left, right), tool in known.items():
        here = _corner(left, right)
        at.append(here)
        wanted.append(tool)
        beside = [(other, right) for other in range(3) if other != left] + [(left, 1 - right)]
        for pair in beside:
            if pair not in known:
                at += [(1.0 - share) * here + share * _corner(*pair) for share in UNSEEN]
                wanted += [tool] * len(UNSEEN)
    return np.array(at), np.array(wanted)


def _corner(left: int, right: int) -> Array:
    return np.concatenate([np.eye(3)[left], np.eye(2)[right]])


@dataclass(frozen=True, eq=False)
class LearnedBetween:
    """A KMP of shares, and what its errors (M, 3) [m] were at shares (M, 5)."""

    method: BetweenPlaces
    primitive: KMP
    shares: Array | None = None
    errors: Array | None = None
    reach: float = np.inf  # [m] off its places, from which on a hand is far

    def place(self, places: Places) -> PlacedBetween:
        """The skill among these places."""
        return PlacedBetween(self, places)


@dataclass(frozen=True, eq=False)
class PlacedBetween:
    """The skill among places."""

    learned: LearnedBetween
    places: Places
    memoryless = True

    def mean(self, hands: Array, velocities: Array) -> Array:
        """As `trials.Placed`."""
        found = self.learned.primitive.mean(self.learned.method.shares(hands, velocities, self.places))
        shares = np.column_stack([1.0 - found[:, :3].sum(axis=1), found[:, :3]])
        with_hand = carried(hands, self.places, np.clip(shares[:, 1], 0.0, 1.0))
        return np.asarray(shares @ tool_places(self.places) + found[:, 3:] + with_hand)

    def predict(self, hands: Array, velocities: Array) -> Predicted:
        """As `trials.Placed`; the covariance is the scatter of errors near such shares, and that of
        the places.
        """
        told = self.learned
        assert told.shares is not None
        assert told.errors is not None
        some = told.method.shares(hands[::COVARIANCE_EVERY], velocities[::COVARIANCE_EVERY], self.places)
        squares = np.einsum("mi,mj->mij", told.errors, told.errors).reshape(-1, 9)
        apart = np.sum((some[:, None] - told.shares) ** 2, axis=2)
        weights = np.exp(-0.5 * (apart - apart.min(axis=1, keepdims=True)) / NEAR**2)
        scatter = (weights @ squares / weights.sum(axis=1, keepdims=True)).reshape(-1, 3, 3)
        least = (self.places.std_m**2 / 3.0 + LEAST_STD_M**2) * np.eye(3)
        covariance = np.repeat(scatter + least, COVARIANCE_EVERY, axis=0)[: len(hands)]
        far = np.asarray((off_places(hands, self.places) > told.reach).any(axis=1))
        return Predicted(self.mean(hands, velocities), covariance, far)
