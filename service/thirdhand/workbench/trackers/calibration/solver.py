"""The pose of a tracker in frame `base`, from positions of a hand that holds or touches the tool.

With h the hand in the tracker's frame [m], p and Q position and rotation of the tool, R and s the
pose of the tracker, y the hand in the frame of the tool, and d the delay of the hand's stamps:

    R h(t) + s = p(t - d) + Q(t - d) y

A robust fit (soft L1) of R, s, y and d finds the wrong samples. A least-squares fit of the others,
weighted by the inverse covariance of the tracker's errors, gives the result and its covariance.

The orientation of the hand is not used. A palm's orientation is measured to some degrees, and a
hand turns in its grip; positions that are 20 cm apart show the tracker's axes more accurately.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from thirdhand.contract.explain import ExplainedError
from thirdhand.core.frame import Vector
from thirdhand.settings.config import Point, Pose, Settings
from thirdhand.workbench.trackers.calibration.noise import WanderingNoise, estimated

FIRST_SCALE_M = 0.01  # in the first fit, larger residuals have a bounded influence
# bounds of that scale in the next fits, where it is 2 robust standard deviations
SCALES_M = (0.001, 0.05)
OUTLIER_DEVIATIONS = 6.0  # a sample with a residual of more robust standard deviations is not used
NOISE_ROUNDS = 2  # estimates of the noise, each followed by a fit
MAX_STAMP_DELAY_S = 0.5  # a longer delay shows that clocks differ
FIRST_DELAYS_S = tuple(np.linspace(-0.2, 0.4, 13).tolist())  # the fit begins with the best of these
LEVER_M = 0.5  # for the condition number, a rotation by 1 rad is a displacement of 0.5 m
MAX_CONDITION = 1000.0
# numbers of samples of a hand that holds the tool
MIN_SAMPLES = 100
MAX_FIT_SAMPLES = 400
MIN_POINTS = 4
MIN_EXTENT_M = 0.05  # the positions must extend this far in their narrowest direction
EXTENT_DEVIATIONS = 4.0  # extent of positions or orientations / their standard deviation
TRACKER_UNITS_M = {"mm": 0.001, "cm": 0.01, "inches": 0.0254, "feet": 0.3048, "m": 1.0}
# largest ratio of distances of hand and tool that a tracker's errors explain
MAX_SCALE_ERROR = 1.35
# The residual with the right sense of the axes is below this share of that with the other sense: of
# points, of which a few agree by chance, and of a held tool.
MIRRORED_RATIO = 0.5
HELD_MIRRORED_RATIO = 0.75
# the residual of a hand at the tool is at most this share of the tool's motion
MAX_UNEXPLAINED = 0.5
BENCH_HEIGHT_M = 0.4  # the bench extends from the table top to this height
CONFIDENCE = 0.99  # of the variance's upper limit, as few samples may agree by chance
EPSILON = 1e-7  # step of numerical derivatives
TURN_WRIST = "turn the wrist while you lead the tool, about two axes"
LEAD_APART = "lead the tool farther apart, in all three directions, and for longer"
LEAD_FASTER = "lead the tool faster"


class CalibrationError(ExplainedError, ValueError):
    """A calibration that is not possible; the message has the cause and the remedy."""


class HeldTool(NamedTuple):
    """A hand that holds the tool: its times (N,) [s] and positions (N, 3) [m] in the tracker's
    frame; and times (M,) [s], positions (M, 3) [m] and quaternions (M, 4) of the tool in frame
    `base`. Times increase.
    """

    hand_s: Vector
    hand: Vector
    tool_s: Vector
    tool: Vector
    turn: Vector


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """The pose of a tracker in frame `base`, and how well it is known.

    `covariance` is that of rotation [rad] about the centre of the positions, displacement [m] and,
    if the tool was held, of the hand in the tool [m] and the delay [s].
    """

    base_from_tracker: Pose
    hand_in_tool: Point = (0.0, 0.0, 0.0)  # [m] the hand in the frame of the tool
    delay_s: float = 0.0  # the hand's stamps are later than the arm's by this
    rms_m: float  # root mean square of the residual, without outliers
    residual_95_m: float  # 95th percentile of the residual
    covariance: tuple[tuple[float, ...], ...]
    corners: tuple[Point, ...]  # [m] corners of the bench, frame `base`
    corner_std_m: tuple[float, ...]  # standard deviation of a mapped position there
    condition: float
    samples: int
    outliers: int
    remedy: str  # what to do for more accuracy

    @property
    def std_m(self) -> float:
        """Standard deviation of a mapped position [m], root mean square over the corners."""
        return math.sqrt(sum(std**2 for std in self.corner_std_m) / len(self.corner_std_m))

    def mapped(self, hand: Vector) -> Vector:
        """Positions (N, 3) in frame `base` [m], from those in the tracker's frame [m]."""
        turn = Rotation.from_quat(self.base_from_tracker[3:])
        return np.asarray(turn.apply(hand) + np.array(self.base_from_tracker[:3]))


class Coverage(NamedTuple):
    """Extents of a tool's positions along three axes [m], the largest first; the axis (3,) of the
    smallest; and extents of its orientation about three axes [rad].
    """

    extent_m: Vector
    narrow: Vector
    turned_rad: Vector


def coverage(tool: Vector, turn: Vector) -> Coverage:
    """The coverage of three or more tool positions (N, 3) [m] and quaternions (N, 4)."""
    _, stretch, axes = np.linalg.svd(tool - tool.mean(axis=0), full_matrices=False)
    rotations = Rotation.from_quat(turn)
    turned = np.linalg.svd((rotations.mean().inv() * rotations).as_rotvec(), compute_uv=False)
    share = EXTENT_DEVIATIONS / math.sqrt(len(tool))
    narrow = axes[2] * np.sign(axes[2][np.argmax(np.abs(axes[2]))])
    # -0.0 becomes 0.0
    return Coverage(
        np.asarray(share * stretch), np.asarray(narrow.round(1) + 0.0), np.asarray(share * turned)
    )


def bench_corners(settings: Settings) -> Vector:
    """The corners (8, 3) [m] of the bench: the table top where the arm reaches it, up to
    BENCH_HEIGHT_M.
    """
    table = settings.table
    reach = settings.reach
    spans = []
    for axis in range(2):
        middle = table.centre[axis]
        half = table.half_size[axis]
        low = reach.centre[axis] - reach.outer
        high = reach.centre[axis] + reach.outer
        low = max(middle - half, low)
        high = min(middle + half, high)
        spans.append((low, high) if low < high else (middle - half, middle + half))
    spans.append((table.centre[2], table.centre[2] + BENCH_HEIGHT_M))
    return np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 3)


class _Problem(NamedTuple):
    """Positions of a hand (N, 3) [m], and the function that gives the tool's positions (N, 3) and
    rotations at a delay [s]. `section` is the tracker's table in the settings. `times_s` (N,) are
    those of a hand that holds the tool; None: the samples are touches of known points.
    """

    hand: Vector
    tool_at: Callable[[float], tuple[Vector, Rotation]]
    section: str
    times_s: Vector | None = None

    @property
    def is_held(self) -> bool:
        """True if place and delay of the hand are unknown."""
        return self.times_s is not None


def solve_held(
    held: HeldTool, corners: Vector, *, section: str = "[hands]", max_samples: int = MAX_FIT_SAMPLES
) -> Calibration:
    """The calibration from a hand that holds the tool while it is led.

    `corners` (C, 3) are those of the bench [m]; `section` is the table in the settings that an
    error names. Raises CalibrationError.
    """
    if min(len(held.hand), len(held.tool)) < MIN_SAMPLES:
        raise CalibrationError(
            f"{len(held.hand)} samples of the hand and {len(held.tool)} of the arm in the same "
            f"time; {MIN_SAMPLES} of each needed: lead the tool for longer"
        )
    cover = coverage(held.tool, held.turn)
    _check_extent(cover)
    flips = np.where(np.sum(held.turn[1:] * held.turn[:-1], axis=1) < 0, -1.0, 1.0)
    # without changes of sign, to interpolate neighbours
    turn = held.turn * np.cumprod(np.r_[1.0, flips])[:, None]
    poses = [*held.tool.T, *turn.T]
    rows = np.arange(0, len(held.hand), math.ceil(len(held.hand) / max_samples), dtype=np.intp)
    span_s = (held.tool_s[0], held.tool_s[-1])

    def problem(rows: NDArray[np.intp]) -> _Problem:
        times_s = held.hand_s[rows]

        def tool_at(delay_s: float) -> tuple[Vector, Rotation]:
            at_s = np.clip(times_s - delay_s, *span_s)
            x, y, z, *quaternion = (np.interp(at_s, held.tool_s, values) for values in poses)
            return np.stack([x, y, z], axis=1), Rotation.from_quat(np.stack(quaternion, axis=1))

        return _Problem(held.hand[rows], tool_at, section, times_s)

    first = _robust(problem(rows))
    is_near = _inliers(first.off, first.deviation_m)
    inlier_problem = problem(rows[is_near])
    hint = (
        f" The tool turned by {_degrees(cover)}" if cover.turned_rad[1] < math.radians(20) else ""
    )
    return _refined(inlier_problem, first, corners, hint)


def solve_points(
    hand: Vector, base: Vector, corners: Vector, *, section: str = "[hands]"
) -> Calibration:
    """The calibration from positions of a hand (N, 3) [m] at known points (N, 3) [m] of frame
    `base`. `corners` (C, 3) are those of the bench [m]; `section` is the table in the settings that
    an error names. Raises CalibrationError.
    """
    if len(hand) < MIN_POINTS:
        raise CalibrationError(
            f"{len(hand)} points given; {MIN_POINTS} or more needed, 8 recommended"
        )
    _check_extent(coverage(base, Rotation.identity(len(base)).as_quat()))
    first = _robust(_touched(hand, base, section))
    is_near = _inliers(first.off, first.deviation_m)
    return _refined(_touched(hand[is_near], base[is_near], section), first, corners, "")


def _inliers(off_m: Vector, deviation_m: float) -> NDArray[np.bool_]:
    """True for residuals (N,) [m] that are no outliers; for all if fewer than MIN_POINTS remain."""
    is_inlier = off_m < OUTLIER_DEVIATIONS * deviation_m
    return np.asarray(is_inlier if is_inlier.sum() >= MIN_POINTS else np.ones_like(is_inlier))


def _touched(hand: Vector, base: Vector, section: str) -> _Problem:
    upright = Rotation.identity(len(base))
    return _Problem(hand, lambda _: (base, upright), section)


def _degrees(cover: Coverage) -> str:
    return " and ".join(f"{math.degrees(angle):.0f}°" for angle in cover.turned_rad[:2])


def _check_extent(cover: Coverage, outliers: Sequence[int] | NDArray[np.intp] = ()) -> None:
    """Raise CalibrationError if the positions are not spread in all three directions: then the pose
    is uncertain, and mirrored axes would remain unnoticed. `outliers` are points that were left
    out, which the message names.
    """
    if cover.extent_m[2] >= MIN_EXTENT_M:
        return
    sizes = " x ".join(f"{100 * size:.0f}" for size in cover.extent_m)
    axis = "({:.1f}, {:.1f}, {:.1f}) of frame base".format(*cover.narrow)
    if len(outliers):
        points = ", ".join(str(number + 1) for number in outliers)
        raise CalibrationError(
            f"point {points} does not fit the others, which extend over {sizes} cm alone; "
            f"{100 * MIN_EXTENT_M:.0f} cm or more needed in every direction. Touch it again, and "
            f"two more points that are farther along {axis}"
        )
    raise CalibrationError(
        f"the positions extend over {sizes} cm; {100 * MIN_EXTENT_M:.0f} cm or more needed in "
        f"every direction. Lead the tool farther apart, above all along {axis}"
    )


class _Fit(NamedTuple):
    """A rigid map: rotation, centre of the hand and its image (3,) [m], then the hand in the tool
    (3,) [m] and the delay [s]; distances (N,) [m] of its residuals, and their robust standard
    deviation on an axis [m].
    """

    turn: Rotation
    centre: Vector
    image: Vector
    grip: Vector
    delay_s: float
    off: Vector
    deviation_m: float

    @property
    def parameters(self) -> Vector:
        """Parameters (10,): rotation from `turn` [rad], image, grip, delay."""
        return np.concatenate([np.zeros(3), self.image, self.grip, [self.delay_s]])


def _residual(problem: _Problem, turn: Rotation, centre: Vector, x: Vector) -> Vector:
    """Residuals (N, 3) [m] at parameters (10,), or (6,) of touched points."""
    tool, tool_turn = problem.tool_at(float(x[9]) if problem.is_held else 0.0)
    held = tool + tool_turn.apply(x[6:9]) if problem.is_held else tool
    return np.asarray(
        (Rotation.from_rotvec(x[:3]) * turn).apply(problem.hand - centre) + x[3:6] - held
    )


def _robust(problem: _Problem) -> _Fit:
    """The robust rigid map. Raises CalibrationError if there is none, with the likely cause."""
    delay_s, matrix, centre = _affine(problem) if problem.is_held else _similar(problem)
    _check_motion(problem, delay_s, matrix, centre)
    _check_scale(matrix, problem.section)
    fit = _rigid(problem, matrix, centre, delay_s)
    _check_sense(problem, matrix, fit)
    return fit


def _check_sense(problem: _Problem, matrix: Vector, fit: _Fit) -> None:
    """Raise CalibrationError unless the samples fit clearly worse if an axis is reversed: the
    tracker's axes are left-handed, or the samples do not tell.

    They are reversed along n, in which the hand moves least: h' = c + (I - 2 n n^T) (h - c).
    """
    moved = problem.hand - fit.centre
    narrow = np.linalg.svd(moved, full_matrices=False)[2][2]
    flip = np.eye(3) - 2.0 * np.outer(narrow, narrow)
    start = matrix @ flip if np.linalg.det(matrix) < 0 else fit.turn.as_matrix()
    mirrored = _rigid(
        problem._replace(hand=fit.centre + moved @ flip), start, fit.centre, fit.delay_s
    )
    # Each of few points counts that fits in either sense; of many samples, most do.
    fits = _inliers(np.minimum(fit.off, mirrored.off), min(fit.deviation_m, mirrored.deviation_m))
    tool, turn = problem.tool_at(fit.delay_s)
    _check_extent(
        coverage(tool[fits], turn.as_quat()[fits]), () if problem.is_held else np.flatnonzero(~fits)
    )
    middle, ratio = (
        (np.median, HELD_MIRRORED_RATIO) if problem.is_held else (np.mean, MIRRORED_RATIO)
    )
    off_mm = 1e3 * float(middle(fit.off[fits]))
    mirrored_mm = 1e3 * float(middle(mirrored.off[fits]))
    differ = f"the residual is {off_mm:.0f} mm, and {mirrored_mm:.0f} mm with one axis reversed"
    if mirrored_mm < ratio * off_mm:
        raise CalibrationError(
            f"the tracker's axes are mirrored (left-handed): {differ}. base_from_tracker cannot "
            "express that: reverse one axis in the tracker's program, like z = -z for Unity's "
            f"axes, or change {problem.section} axes"
        )
    if off_mm > ratio * mirrored_mm:
        raise CalibrationError(
            "the positions do not tell whether the tracker's axes are mirrored (left-handed): "
            f"{differ}. Repeat the positions, two or more of them at least 20 cm above the others"
        )


def _similar(problem: _Problem) -> tuple[float, Vector, Vector]:
    """No delay, matrix (3, 3) and centre of the hand (3,) [m] of the similarity, mirrored or not,
    that fits best (Procrustes): few touched points do not show an affine map.
    """
    base, _ = problem.tool_at(0.0)
    centre = problem.hand.mean(axis=0)
    hand = problem.hand - centre
    base = base - base.mean(axis=0)
    u, _, vt = np.linalg.svd(base.T @ hand)
    return 0.0, u @ vt * (np.linalg.norm(base) / max(float(np.linalg.norm(hand)), 1e-12)), centre


def _affine(problem: _Problem) -> tuple[float, Vector, Vector]:
    """Delay [s], matrix A (3, 3) and centre of the hand (3,) [m] of the affine map that fits best,
    of a hand that holds the tool.

    A (h - centre) + s = p + Q y is linear in A, s and y. The singular values of A show the
    tracker's unit, and its determinant mirrored axes: no rotation expresses either.
    """
    best: tuple[float, float, Vector] | None = None
    centre = np.median(problem.hand, axis=0)
    size = max(float(np.median(np.linalg.norm(problem.hand - centre, axis=1))), 1e-12)
    hand = (problem.hand - centre) / size
    count = len(problem.hand)
    rows = np.zeros((count, 3, 15))
    for axis in range(3):
        rows[:, axis, 3 * axis : 3 * axis + 3] = hand
        rows[:, axis, 9 + axis] = 1.0
    for delay_s in FIRST_DELAYS_S:
        tool, turn = problem.tool_at(delay_s)
        rows[:, :, 12:] = -turn.as_matrix()
        weights = np.ones((count, 1))
        # reweighted, so that it minimises the distances rather than their squares
        for _ in range(5):
            weighted = (weights[:, :, None] * rows).reshape(3 * count, -1)
            solution = np.linalg.lstsq(weighted, (weights * tool).ravel(), rcond=1e-9)[0]
            distances_m = np.linalg.norm(rows @ solution - tool, axis=1)
            weights = 1.0 / np.sqrt(FIRST_SCALE_M + distances_m)[:, None]
        if best is None or distances_m.mean() < best[0]:
            best = float(distances_m.mean()), delay_s, np.asarray(solution[:9].reshape(3, 3) / size)
    assert best is not None
    return best[1], best[2], centre


def _check_motion(problem: _Problem, delay_s: float, matrix: Vector, centre: Vector) -> None:
    """Raise CalibrationError if the hand does not move as the tool does."""
    tool, _ = problem.tool_at(delay_s)
    tool = tool - np.median(tool, axis=0)
    moved = (problem.hand - centre) @ matrix.T
    off_m = np.median(np.linalg.norm(moved - np.median(moved, axis=0) - tool, axis=1))
    motion_m = np.median(np.linalg.norm(tool, axis=1))
    if off_m > MAX_UNEXPLAINED * motion_m:
        raise CalibrationError(
            f"the hand does not move with the tool: they differ by {1e3 * off_m:.0f} mm while the "
            f"tool moves by {1e3 * motion_m:.0f} mm. Hold the tool in the tracked hand, and let go "
            "of it only at the end"
        )


def _check_scale(matrix: Vector, section: str) -> None:
    """Raise CalibrationError if the tracker's positions are not in metres."""
    # the widest direction has the least error
    scale = max(float(np.linalg.svd(matrix, compute_uv=False)[0]), 1e-9)
    if 1 / MAX_SCALE_ERROR < scale < MAX_SCALE_ERROR:
        return
    unit = min(TRACKER_UNITS_M, key=lambda name: abs(math.log(TRACKER_UNITS_M[name] / scale)))
    if not 1 / MAX_SCALE_ERROR < TRACKER_UNITS_M[unit] / scale < MAX_SCALE_ERROR:
        unit = ""
    times = f"{float(f'{1 / scale:.2g}'):g}"
    finding = f"the hand moves {times} times as far as the tool"
    if unit in ("mm", "cm"):
        raise CalibrationError(
            f'{finding}: the tracker looks to publish {unit}. Set {section} unit = "{unit}"'
        )
    looks = f": the tracker looks to publish {unit}" if unit else ""
    raise CalibrationError(f"{finding}{looks}. Let it publish metres, or correct {section} unit")


def _rigid(problem: _Problem, matrix: Vector, centre: Vector, delay_s: float) -> _Fit:
    """The robust rigid map, from an affine one."""
    u, _, vt = np.linalg.svd(matrix)
    turn = Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
    count = 10 if problem.is_held else 6
    bounds = np.array([np.inf] * 9 + [MAX_STAMP_DELAY_S])[:count]
    image = np.median(problem.tool_at(delay_s)[0], axis=0)
    x = np.concatenate([np.zeros(3), image, np.zeros(3), [delay_s]])[:count]
    scale_m = FIRST_SCALE_M
    for _ in range(3):

        def off(x: Vector, turn: Rotation = turn) -> Vector:
            return _residual(problem, turn, centre, x).ravel()

        fit = least_squares(
            off, x, loss="soft_l1", f_scale=scale_m, bounds=(-bounds, bounds), x_scale=0.1
        )
        turn = Rotation.from_rotvec(fit.x[:3]) * turn
        x = fit.x
        x[:3] = 0.0
        deviation_m = max(1.4826 * float(np.median(np.abs(fit.fun))), 1e-5)
        scale_m = float(np.clip(2.0 * deviation_m, *SCALES_M))
    x = np.pad(x, (0, 10 - count))
    distances = np.linalg.norm(fit.fun.reshape(-1, 3), axis=1)
    return _Fit(turn, centre, x[3:6], x[6:9], float(x[9]), distances, deviation_m)


def _refined(problem: _Problem, first: _Fit, corners: Vector, hint: str) -> Calibration:
    """The calibration from the samples without outliers. Raises CalibrationError if the pose is
    not observable.
    """
    if abs(first.delay_s) > 0.98 * MAX_STAMP_DELAY_S:
        raise CalibrationError(
            f"the stamps of hand and arm differ by {MAX_STAMP_DELAY_S:g} s or more: synchronise "
            "the clocks, or let "
            "each program stamp a sample when it is measured"
        )
    count = 10 if problem.is_held else 6
    samples = len(problem.hand)

    def off(x: Vector) -> Vector:
        return _residual(problem, first.turn, first.centre, x)

    def slopes(x: Vector) -> Vector:
        reference = off(x)
        return np.stack(
            [(off(x + EPSILON * axis) - reference) / EPSILON for axis in np.eye(count)], axis=2
        )

    def fitted(x: Vector, noise: WanderingNoise | None) -> Vector:
        def white(x: Vector) -> Vector:
            return (off(x) if noise is None else noise.whitened(off(x))).ravel()

        return np.asarray(least_squares(white, x, x_scale=0.1).x)

    x = first.parameters[:count]
    jacobian = slopes(x)
    condition = _condition(jacobian.reshape(-1, count), hint)
    if problem.times_s is not None:
        for _ in range(NOISE_ROUNDS):
            noise = estimated(problem.times_s, off(x), jacobian)
            x = fitted(x, noise)
            jacobian = slopes(x)
        white = noise.whitened(off(x))
        weighted = noise.whitened(jacobian)
    else:
        x = fitted(x, None)
        white = off(x)
        weighted = slopes(x)
    information = np.einsum("nik,nil->kl", weighted, weighted)
    outliers = len(first.off) - samples  # each has chosen a sample to be left out
    freedom = max(3 * (samples - outliers) - count, 1)
    variance = (
        np.square(white).sum() / (3 * samples - count) * freedom / chdtri(freedom, CONFIDENCE)
    )
    covariance = variance * np.linalg.inv(information)
    levers = corners - x[3:6]
    stds = _stds(covariance, levers)
    remedy = LEAD_APART
    if problem.is_held:
        firm = np.array([*range(6), 9])
        firm_covariance = variance * np.linalg.inv(information[np.ix_(firm, firm)])
        remedy = (
            TURN_WRIST if _stds(firm_covariance, levers).max() < 0.7 * stds.max() else LEAD_APART
        )
    turn = Rotation.from_rotvec(x[:3]) * first.turn
    residual = np.linalg.norm(off(x), axis=1)
    x = np.pad(x, (0, 10 - count))
    return Calibration(
        base_from_tracker=(
            *(x[3:6] - turn.apply(first.centre)).round(5).tolist(),
            *turn.as_quat().round(7).tolist(),
        ),
        hand_in_tool=tuple(x[6:9].round(5).tolist()),
        delay_s=round(float(x[9]), 5),
        rms_m=float(np.sqrt(np.square(residual).mean())),
        residual_95_m=float(np.quantile(first.off, 0.95)),
        covariance=tuple(map(tuple, covariance.tolist())),
        corners=tuple(map(tuple, corners.tolist())),
        corner_std_m=tuple(stds.tolist()),
        condition=condition,
        samples=len(first.off),
        outliers=outliers,
        remedy=remedy,
    )


def _condition(jacobian: Vector, hint: str) -> float:
    """Condition number of a Jacobian (3 N, K). Raises CalibrationError above MAX_CONDITION, with
    what to do about the direction that is known least.
    """
    count = jacobian.shape[1]
    _, strength, directions = np.linalg.svd(
        jacobian / np.array([LEVER_M] * 3 + [1.0] * (count - 3))
    )
    condition = float(strength[0] / max(strength[-1], 1e-12))
    if condition > MAX_CONDITION:
        weakest = directions[-1]
        parts = {LEAD_APART: weakest[:3], TURN_WRIST: weakest[3:9], LEAD_FASTER: weakest[9:]}
        remedy = max(parts, key=lambda name: float(np.linalg.norm(parts[name])))
        raise CalibrationError(
            "the positions do not determine the tracker's pose: their condition number is "
            f"{min(condition, 1e9):.0f}, at most {MAX_CONDITION:.0f} accepted.{hint}. To determine "
            f"it, {remedy}"
        )
    return condition


def _stds(covariance: Vector, levers: Vector) -> Vector:
    """Standard deviations (C,) [m] of mapped positions at `levers` (C, 3) [m] from the centre.

    With S the covariance of rotation and displacement and G = (-[lever]x, I): sqrt(trace G S G^T).
    """
    stds = []
    for x, y, z in levers:
        g = np.array([[0, z, -y, 1, 0, 0], [-z, 0, x, 0, 1, 0], [y, -x, 0, 0, 0, 1]])
        stds.append(math.sqrt(max(float(np.trace(g @ covariance[:6, :6] @ g.T)), 0.0)))
    return np.array(stds)
