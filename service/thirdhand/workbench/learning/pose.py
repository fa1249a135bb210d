"""Learning of the tool's orientation and of the gripper.

Each is a primitive over the inputs of the position's primitive. An orientation is represented by
zeta (3,), half the rotation vector from the mean orientation. An orientation that hardly changes
stays constant. Takes that contradict each other are reported, and refused if they do so often.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp import GaussianKernel
from kmp.criteria.errors import rms
from kmp.orientation import continuous, log
from thirdhand.core.frame import Vector
from thirdhand.core.geometry import angles
from thirdhand.core.skill.pose import CLOSED, UNKNOWN, LearnedGripper, LearnedOrientation, decided
from thirdhand.skills.flat import UNDECIDED, even
from thirdhand.workbench.learning.ambiguity import contradictions
from thirdhand.workbench.learning.choice import selection_of
from thirdhand.workbench.learning.direct_selection import DirectSelection, Parameters
from thirdhand.workbench.learning.records import HeldOut, Pose, Verdict, by_fold, folds_of

# an orientation that stays this near to its mean counts as constant
CONSTANT_RAD = math.radians(5.0)
# orientations this far from each other contradict each other at the same hands
DIFFERENT_RAD = math.radians(30.0)
# limits of the share of samples that contradict others
NOTED_SHARE = 0.01
UNSAFE_SHARE = 0.10
# limits of the held-out error
NOTED_DEG = 15.0
UNSAFE_DEG = 60.0
SIGN_SAMPLES = 100  # samples of a take by which its quaternions' sign is chosen
# a tool that turns farther comes too near to the opposite of the mean orientation
MOST_TURN_DEG = 480.0
# hyper-parameters if there is one person, and nothing to choose by
SINGLE_TAKE = Parameters(8.0, 1e-2, 1e-2, 0.2)
GRIPPER_WRONG_SHARE = 0.15  # a gripper that is wrong in a larger share of held-out samples is noted


def learned_pose(
    held_out: Sequence[HeldOut], *, points: int, gripper_ell: float, near_m: float
) -> Pose:
    """The orientation and the gripper of held-out takes, over their inputs (T, I), from about
    `points` samples; `near_m` as in `contradictions`.

    Raises ValueError if primitives cannot be fitted.
    """
    unit = [
        result.take.tool[:, 3:] / np.linalg.norm(result.take.tool[:, 3:], axis=1)[:, None]
        for result in held_out
    ]
    mean, signed = _signed(
        mean_orientation(np.concatenate([result.take.tool[:, 3:] for result in held_out])), unit
    )
    turn, turn_error_deg, missed = _learned_turn(mean, held_out, signed, points)
    verdicts: list[Verdict] = []
    if turn is not None:
        verdicts += _contradicting(held_out, unit, missed, near_m)
    if turn_error_deg is not None and turn_error_deg > NOTED_DEG:
        verdicts.append(_missed(turn_error_deg, unit))
    gripper, right, remarks = _learned_gripper(held_out, points=points, ell=gripper_ell)
    verdicts += (Verdict("warning", text) for text in remarks)
    return Pose(mean, turn, gripper, turn_error_deg, right, verdicts)


def _contradicting(
    held_out: Sequence[HeldOut], unit: Sequence[Vector], missed: Sequence[Vector], near_m: float
) -> Iterator[Verdict]:
    """A verdict on orientations (T, 4) that contradict each other; none if few do."""
    conflicts = contradictions(
        held_out,
        unit,
        missed,
        lambda tools, others: angles(tools[:, None], others),
        different=DIFFERENT_RAD,
        near_m=near_m,
    )
    if conflicts.share > NOTED_SHARE:
        yield Verdict(
            "unsafe" if conflicts.share > UNSAFE_SHARE else "warning",
            f"the tool's orientation contradicts itself in {100 * conflicts.share:.0f} % of "
            f"the samples, up to {100 * UNSAFE_SHARE:.0f} % accepted: {conflicts.pair} have "
            f"the hands {1000 * conflicts.hands_m:.0f} mm from each other and the tools turned "
            f"by {math.degrees(conflicts.tools):.0f}°",
        )


def _missed(error_deg: float, unit: Sequence[Vector]) -> Verdict:
    """The verdict on a large held-out error [deg] of orientations (T, 4)."""
    text = f"the tool's orientation in held-out demonstrations is missed by {error_deg:.0f}° rms"
    if error_deg <= UNSAFE_DEG:
        return Verdict("warning", text)
    turned_deg = max(math.degrees(turned_rad(q)) for q in unit)
    return Verdict(
        "unsafe",
        f"{text}, up to {UNSAFE_DEG:.0f}° accepted: it turns by up to {turned_deg:.0f}° in one "
        f"of them; let it turn by less than {MOST_TURN_DEG:.0f}°, the same way in each",
    )


def turned_rad(quaternions: Vector) -> float:
    """The largest angle [rad] of the orientations (T, 4) from the first one, also beyond pi."""
    smooth = continuous(quaternions)
    return float(2.0 * np.arccos(np.clip(smooth @ smooth[0], -1.0, 1.0)).max())


def mean_orientation(quaternions: ArrayLike) -> Vector:
    """The mean (4,) of quaternions x y z w (M, 4) of any signs: the leading eigenvector of Σ q qᵀ
    (Markley et al. 2007).
    """
    q = np.asarray(quaternions, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.asarray(mean * (1 if mean[3] >= 0 else -1))


def _learned_turn(
    mean: Vector, held_out: Sequence[HeldOut], unit: Sequence[Vector], points: int
) -> tuple[LearnedOrientation | None, float | None, list[Vector]]:
    """The primitive of orientations (T, 4), None if they are constant; its held-out error [deg];
    and the held-out error (T,) [rad] of each take.
    """
    if angles(np.concatenate(unit), mean).max() <= CONSTANT_RAD:
        return None, None, []
    takes = [result.take for result in held_out]
    zetas = [log(q, mean) for q in unit]
    pairs = [(result.inputs, zeta) for result, zeta in zip(held_out, zetas, strict=True)]
    choice = selection_of(pairs, points, persons=folds_of(takes), isotropic=True)
    several = len({take.person for take in takes}) > 1
    parameters = choice.parameters() if several else SINGLE_TAKE
    residuals = choice.residuals(parameters.ell, parameters.noise)
    error_deg = math.degrees(2.0 * rms(residuals)) if several else None
    missed: dict[int, Vector] = {}
    for fold, members, _ in by_fold(takes):
        others = choice.primitive(parameters, residuals, without=fold if several else None)
        for h in members:
            off = zetas[h] - others.mean(held_out[h].inputs)
            missed[h] = 2.0 * np.linalg.norm(off, axis=1)
    learned = LearnedOrientation(choice.primitive(parameters, residuals), mean)
    return learned, error_deg, [missed[h] for h in range(len(takes))]


def _signed(mean: Vector, unit: Sequence[Vector]) -> tuple[Vector, list[Vector]]:
    """The mean orientation (4,), and the orientations (T, 4) with signs that are constant in time.

    Beyond half a turn from the mean, the nearer sign is the wrong one. Then each take has the sign
    with which it is nearest to the first take, and the mean is that of the signed quaternions.
    """
    smooth = [continuous(q) for q in unit]
    near = [q if (q @ mean).sum() >= 0.0 else -q for q in smooth]
    if all((q @ mean > 0.0).all() for q in near):
        return mean, near
    along = [q[np.linspace(0, len(q) - 1, SIGN_SAMPLES).round().astype(int)] for q in smooth]
    signed = [
        q if (samples * along[0]).sum() >= 0.0 else -q
        for q, samples in zip(smooth, along, strict=True)
    ]
    total = np.concatenate(signed).sum(axis=0)
    size = float(np.linalg.norm(total))
    return (total / size, signed) if size > 0.0 else (mean, near)


def _learned_gripper(
    held_out: Sequence[HeldOut], *, points: int, ell: float
) -> tuple[LearnedGripper | None, float | None, list[str]]:
    """The gripper, the share of held-out samples [%] in which it is right, and warnings."""
    pairs = [
        (result.inputs, result.take.closure[:, None])
        for result in held_out
        if result.take.closure is not None
    ]
    if not pairs:
        return None, None, []
    unknown = [result.take.name for result in held_out if result.take.closure is None]
    remarks = [f"{', '.join(unknown)} without gripper: it is learned from the others"] * bool(
        unknown
    )
    choice = selection_of(pairs, points)
    right = None
    prior = np.array([UNDECIDED])
    if len(pairs) > 1:
        right = 100.0 * float(
            np.concatenate([_is_right(choice, i, prior, ell) for i in range(len(pairs))]).mean()
        )
        if right < 100.0 * (1.0 - GRIPPER_WRONG_SHARE):
            remarks.append(
                f"the gripper is right in {right:.0f} % of held-out samples only: teach it "
                "via-points"
            )
    primitive = even(choice.inputs, choice.outputs, GaussianKernel(ell), prior)
    return LearnedGripper(primitive), right, remarks


def _is_right(choice: DirectSelection, take: int, prior: Vector, ell: float) -> NDArray[np.bool_]:
    """Return whether the gripper that the other takes lead to is right at a take's points (N,)."""
    mine = choice.group == take
    others = even(choice.inputs[~mine], choice.outputs[~mine], GaussianKernel(ell), prior)
    gripper = UNKNOWN
    is_closed = []
    for closure in others.mean(choice.inputs[mine])[:, 0].tolist():
        gripper = decided(gripper, closure)
        is_closed.append(gripper == CLOSED)
    return np.asarray(np.array(is_closed) == (choice.outputs[mine, 0] > UNDECIDED))
