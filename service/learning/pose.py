"""What a skill learns of the tool besides where it is: how it is turned, and what the gripper does.

Each is a primitive of its own beside the position's, from the same inputs. An orientation that is
the same all along stays a constant; demonstrations that contradict each other are told of, and
refused where they do so often: nothing is averaged in silence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kmp import KMP, GaussianKernel, Gaussians
from kmp.kernel import Kernel
from kmp.orientation import continuous, log
from service.core.frame import Vector
from service.core.geometry import angles
from service.core.skill.pose import CLOSED, UNKNOWN, LearnedGripper, LearnedOrientation, decided
from service.learning.ambiguity import ambiguity
from service.learning.choice import Choice, Parameters, rms
from service.learning.judgement import Posed

CONSTANT_RAD = math.radians(5.0)  # a tool that is never farther from its mean is not turned
APART_RAD = math.radians(30.0)  # tools turned so far apart, with the hands the same, contradict each other
NOTED, UNSAFE = 0.01, 0.10  # shares of the samples that contradict others
NOTED_DEG, UNSAFE_DEG = 15.0, 60.0  # errors of held-out demonstrations that are noted, and that are no skill
FOLLOWED = 100  # samples of a demonstration that are compared with those of another
MOST_TURN_DEG = 480.0  # a tool that turns farther comes too near to the opposite of the mean orientation
ALONE = Parameters(8.0, 1e-2, 1e-2, 0.2)  # of a single demonstration, which tells nothing of others
UNDECIDED = 0.5  # closure off all data, where a gripper stays as it is
POINT_NOISE = 0.1  # a point's variance over the kernel's
DEVIATION = 0.2  # [rad, half the angle], or of the closure
GRIPPER_WRONG = 0.15  # share of the held-out time that is noted


def learned_pose(
    inputs: Sequence[Vector],
    hands: Sequence[Vector],
    quaternions: Sequence[Vector],
    closures: Sequence[Vector | None],
    names: Sequence[str],
    together: NDArray[np.intp],
    *,
    points: int,
    gripper_ell: float,
    near_m: float,
) -> Posed:
    """What demonstrations with these inputs (T, I) of the position's primitive, hands (T, 6) [m],
    orientations of the tool (T, 4) and closures of the gripper (T,), or none, tell; those with the
    same number are left out `together` (H,). `near_m` is as in `ambiguity`.
    """
    mean = mean_orientation(np.concatenate(quaternions))
    unit = [q / np.linalg.norm(q, axis=1)[:, None] for q in quaternions]
    mean, signed = _followed(mean, unit)
    warnings: list[str] = []
    unsafe: list[str] = []
    turn, turn_error, missed = _learned_turn(mean, inputs, signed, together, points)
    if turn is not None:
        share, worst = ambiguity(
            hands,
            unit,
            names,
            lambda tools: angles(tools[:, None], tools),
            apart=APART_RAD,
            near_m=near_m,
            missed=missed,
            told=lambda apart_rad: f"turned by {math.degrees(apart_rad):.0f}°",
        )
        if share > NOTED:
            told = f"the tool's orientation contradicts itself in {100 * share:.0f} % of the samples, up to "
            (unsafe if share > UNSAFE else warnings).append(f"{told}{100 * UNSAFE:.0f} % accepted: {worst}")
    if turn_error is not None and turn_error > NOTED_DEG:
        text = f"the tool's orientation in held-out demonstrations is missed by {turn_error:.0f}° rms"
        if turn_error > UNSAFE_DEG:
            turned_deg = max(math.degrees(turned_rad(q)) for q in unit)
            unsafe.append(
                f"{text}, up to {UNSAFE_DEG:.0f}° accepted: it turns by up to {turned_deg:.0f}° in one of them; let it "
                f"turn by less than {MOST_TURN_DEG:.0f}°, the same way in each"
            )
        else:
            warnings.append(text)
    gripper, right = _learned_gripper(inputs, closures, names, points=points, ell=gripper_ell, warnings=warnings)
    return Posed(mean, turn, gripper, turn_error, right, warnings, unsafe)


def flat_orientation(skill_inputs: Vector, kernel: Kernel, orientation: Vector) -> LearnedOrientation:
    """The constant orientation (4,) as a primitive over inputs (N, I), to be taught via-points."""
    inputs = skill_inputs[:: max(1, len(skill_inputs) // 200)]
    zeta = np.zeros((len(inputs), 3))
    return LearnedOrientation(_fitted(inputs, zeta, kernel, np.zeros(3)), np.asarray(orientation, np.float64))


def flat_gripper(skill_inputs: Vector, *, ell: float) -> LearnedGripper:
    """A gripper that is undecided everywhere, to be taught via-points."""
    prior = np.array([UNDECIDED])
    return LearnedGripper(_fitted(skill_inputs[:1], prior[None], GaussianKernel(ell), prior))


def is_flat(primitive: KMP) -> bool:
    """Whether it says the same everywhere, but for what it was taught."""
    return bool((primitive.base.reference.mean == primitive.prior_offset).all())


def turned_rad(quaternions: Vector) -> float:
    """The largest angle by which orientations (T, 4), followed from the first on, turn from it."""
    smooth = continuous(quaternions)
    return float(2.0 * np.arccos(np.clip(smooth @ smooth[0], -1.0, 1.0)).max())


def mean_orientation(quaternions: ArrayLike) -> Vector:
    """The mean (4,) of quaternions x y z w (M, 4), whatever their signs: the leading eigenvector of
    their scatter (Markley et al. 2007).
    """
    q = np.asarray(quaternions, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.asarray(mean * (1 if mean[3] >= 0 else -1))


def _learned_turn(
    mean: Vector, inputs: Sequence[Vector], unit: Sequence[Vector], together: NDArray[np.intp], points: int
) -> tuple[LearnedOrientation | None, float | None, list[Vector]]:
    """The primitive of orientations (T, 4), None where they are constant; its error [deg], and by
    how much the others' misses those of each demonstration (T,) [rad].
    """
    if angles(np.concatenate(unit), mean).max() <= CONSTANT_RAD:
        return None, None, []
    zetas = [log(q, mean) for q in unit]
    choice = Choice.of(list(zip(inputs, zetas, strict=True)), points, together=together, alike=True)
    several = len(set(together.tolist())) > 1
    parameters = choice.parameters() if several else ALONE
    residuals = choice.residuals(parameters.ell, parameters.noise)
    error_deg = math.degrees(2.0 * rms(residuals)) if several else None
    missed = []
    for group, at, zeta in zip(together.tolist(), inputs, zetas, strict=True):
        others = choice.primitive(parameters, residuals, without=group if several else None)
        missed.append(2.0 * np.linalg.norm(zeta - others.mean(at), axis=1))
    return LearnedOrientation(choice.primitive(parameters, residuals), mean), error_deg, missed


def _followed(mean: Vector, unit: Sequence[Vector]) -> tuple[Vector, list[Vector]]:
    """The mean orientation (4,), and orientations (T, 4) with signs that do not change in time.

    Farther than half a turn from the mean the nearer sign is the wrong one: there each
    demonstration has the sign by which it is nearest to the first, and the mean is that of signed
    quaternions.
    """
    smooth = [continuous(q) for q in unit]
    near = [q if (q @ mean).sum() >= 0.0 else -q for q in smooth]
    if all((q @ mean > 0.0).all() for q in near):
        return mean, near
    along = [q[np.linspace(0, len(q) - 1, FOLLOWED).round().astype(int)] for q in smooth]
    signed = [q if (at * along[0]).sum() >= 0.0 else -q for q, at in zip(smooth, along, strict=True)]
    total = np.concatenate(signed).sum(axis=0)
    size = float(np.linalg.norm(total))
    return (total / size, signed) if size > 0.0 else (mean, near)


def _learned_gripper(
    inputs: Sequence[Vector],
    closures: Sequence[Vector | None],
    names: Sequence[str],
    *,
    points: int,
    ell: float,
    warnings: list[str],
) -> tuple[LearnedGripper | None, float | None]:
    """The gripper, and in how much of what is held out it is right [%]; adds to the warnings."""
    told = [(x, c[:, None]) for x, c in zip(inputs, closures, strict=True) if c is not None]
    if not told:
        return None, None
    silent = [name for name, closure in zip(names, closures, strict=True) if closure is None]
    if silent:
        warnings.append(f"{', '.join(silent)} told nothing of the gripper: it is learned from the others")
    choice = Choice.of(told, points)
    right = None
    prior = np.array([UNDECIDED])
    if len(told) > 1:
        right = 100.0 * float(np.concatenate([_right(choice, i, prior, ell) for i in range(len(told))]).mean())
        if right < 100.0 * (1.0 - GRIPPER_WRONG):
            warnings.append(f"the gripper is right in {right:.0f} % of held-out samples only: teach it via-points")
    primitive = _fitted(choice.inputs, choice.outputs, GaussianKernel(ell), prior)
    return LearnedGripper(primitive), right


def _right(choice: Choice, held_out: int, prior: Vector, ell: float) -> NDArray[np.bool_]:
    """Whether what the others' primitive decides along a demonstration (N,) is what was shown."""
    mine = choice.owner == held_out
    others = _fitted(choice.inputs[~mine], choice.outputs[~mine], GaussianKernel(ell), prior)
    gripper, found = UNKNOWN, []
    for closure in others.mean(choice.inputs[mine])[:, 0].tolist():
        gripper = decided(gripper, closure)
        found.append(gripper == CLOSED)
    return np.asarray(np.array(found) == (choice.outputs[mine, 0] > UNDECIDED))


def _fitted(inputs: Vector, outputs: Vector, kernel: Kernel, prior: Vector) -> KMP:
    """A primitive of equally exact points, of standard deviation DEVIATION far from them."""
    width, scale = outputs.shape[1], len(inputs) / DEVIATION**2
    covariance = np.tile(POINT_NOISE / scale * np.eye(width), (len(inputs), 1, 1))
    return KMP.fit(
        inputs,
        Gaussians(outputs, covariance),
        kernel=kernel,
        lambda_mean=scale,
        lambda_covariance=scale,
        prior_mean=prior,
    )
