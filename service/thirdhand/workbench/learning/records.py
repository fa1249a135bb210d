"""Records that the steps of learning hand on: options, takes, predictions of held-out takes, the
fitted model, and the figures that a skill's file holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from thirdhand.core.frame import Vector
from thirdhand.core.skill.model import Model, Regions, standard_deviations
from thirdhand.core.skill.pose import LearnedGripper, LearnedOrientation
from thirdhand.core.skill.support import error_probability
from thirdhand.core.skill.tuning import UNSURE_M
from thirdhand.process.parallel import Workers, here
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.workbench.learning.cross_validation import mahalanobis
from thirdhand.workbench.learning.gate import Gate

Progress = Callable[[str], None]
MOST_FOLDS = 10
Severity = Literal["warning", "residual", "unsafe"]


class Options(NamedTuple):
    """The options of `learn` that methods take, see there."""

    points: int
    ell: float | None  # [1/m²]
    components: int | None
    penalty: float | None
    spread_m: float
    seed: int
    delay_s: float | None = None  # of the teacher, between via-points; None: chosen
    spread: Workers = here


class Take(NamedTuple):
    """A demonstration with its name, the number of its person, and the T samples that are learned
    from: hands (T, 6), tool (T, 7) and the gripper's closure (T,), if it is known.

    All takes of a person are held out at once, see `folds_of`.
    """

    name: str
    person: int
    demonstration: Demonstration
    hands: Vector
    tool: Vector
    closure: Vector | None

    @property
    def position(self) -> Vector:
        """The tool's position (T, 3) [m]."""
        return self.tool[:, :3]


def persons_of(takes: Sequence[Take]) -> NDArray[np.intp]:
    """The numbers (H,) of the takes' persons."""
    return np.array([take.person for take in takes], np.intp)


def folds_of(takes: Sequence[Take], earlier: int = 0) -> NDArray[np.intp]:
    """The numbers (H,) of the folds in which takes are held out: by person, or if there are more
    than MOST_FOLDS, by blocks of persons whose numbers follow each other. The last `earlier` takes,
    of a skill that is refined, are in folds of their own.
    """
    folds = list[NDArray[np.intp]]()
    first = 0
    for part in (takes[: len(takes) - earlier], takes[len(takes) - earlier :]):
        numbers, ranks = np.unique(persons_of(part), return_inverse=True)
        count = max(1, min(MOST_FOLDS, len(numbers)))
        blocks = np.array_split(np.arange(len(numbers)), count)
        own = np.repeat(np.arange(count), [len(block) for block in blocks])[ranks]
        folds.append(first + own)
        first += count
    return np.concatenate(folds)


def by_fold(takes: Sequence[Take]) -> Iterator[tuple[int, list[int], list[int]]]:
    """The number of each fold, the numbers of its takes, and those of all other takes."""
    folds = folds_of(takes)
    for fold in np.unique(folds).tolist():
        yield fold, np.flatnonzero(folds == fold).tolist(), np.flatnonzero(folds != fold).tolist()


class Taught(NamedTuple):
    """The takes that a skill is learned from.

    The `new` ones are all that is held out and judged. The `earlier` ones are those of a skill that
    is refined; there are none if a skill is learned anew. Their persons have other numbers.
    """

    new: Sequence[Take]
    earlier: Sequence[Take] = ()

    @property
    def folds(self) -> NDArray[np.intp]:
        """The folds (H,) of all takes."""
        return folds_of(self.all, len(self.earlier))

    @property
    def all(self) -> Sequence[Take]:
        """All takes, the new ones first."""
        return [*self.new, *self.earlier]


class Weights(NamedTuple):
    """The weight of new takes against earlier ones, by name, and the held-out error [m] of the new
    ones with each weight that was tried.
    """

    taken: str
    tried_m: Mapping[str, float]


class TimedErrors(NamedTuple):
    """The predictions of a held-out take at S samples, compared with the tool at the same moment:
    errors (S, 3) [m], covariances (S, 3, 3) [m²], and recent velocities of the prediction (S, 3)
    [m/s].
    """

    errors: Vector
    covariance: Vector
    velocity: Vector
    signs: Vector  # (S, SIGNS) of an error

    def with_timing(self, std_s: float) -> Vector:
        """The covariances (S, 3, 3) [m²] for this deviation of the timing: C + std_s² v vᵀ."""
        return np.asarray(
            self.covariance + std_s**2 * self.velocity[:, :, None] * self.velocity[:, None, :]
        )

    def squares(self, std_s: float) -> Vector:
        """The squared Mahalanobis distances (S,) for this standard deviation of the timing."""
        return mahalanobis(self.errors, self.with_timing(std_s))

    @property
    def is_wrong(self) -> NDArray[np.bool_]:
        """True where the tool is farther than UNSURE_M from its prediction (S,)."""
        return np.asarray(np.linalg.norm(self.errors, axis=1) > UNSURE_M)

    def published(self, regions: Regions) -> Vector:
        """The calibrated covariances (S, 3, 3) [m²]."""
        return np.asarray(regions.scale * self.with_timing(regions.std_s))

    def features(self, regions: Regions) -> Vector:
        """The inputs (S, 2 + SIGNS) of the logistic regression, in the order of its weights."""
        traces = np.trace(self.published(regions), axis1=1, axis2=2)
        return np.column_stack([np.ones(len(traces)), np.log(traces / UNSURE_M**2), self.signs])

    def probabilities(self, regions: Regions) -> Vector:
        """The error probabilities (S,)."""
        weights = np.array(regions.weights)
        rows = zip(self.published(regions), self.signs @ weights[2:], strict=True)
        return np.array([error_probability(row, 0.0, signs, weights) for row, signs in rows])

    def expected_m(self, regions: Regions) -> Vector:
        """The expected distances (S,) [m] of tool and prediction, root mean square."""
        return np.asarray(
            np.sqrt(3 * regions.scale) * standard_deviations(self.with_timing(regions.std_s))
        )

    def inside(self, regions: Regions) -> Vector:
        """The shares (L,) of the samples inside the regions of each of LEVELS."""
        squares = self.squares(regions.std_s)[:, None] / regions.scale
        return np.asarray((squares <= regions.radii).mean(axis=0))


class HeldOut(NamedTuple):
    """A take as a model predicts it that was learned without its person: errors (T, 3) [m],
    demonstrated minus predicted, covariances (T, 3, 3) [m²], and what the gate compares (T,) [m],
    see `Model.measure`.

    `inputs` (T, I) are those of the model's primitive. `known` (T, D) [m] is everything that the
    position may depend on, so takes that agree in it and differ in the tool contradict each other.
    """

    take: Take
    errors: Vector
    covariance: Vector
    gate_m: Vector
    inputs: Vector
    known: Vector
    # (T, K) probability of each of K segments; None if there are no segments
    belief: Vector | None = None
    timed: TimedErrors | None = None  # None: they follow from the errors


class Delay(NamedTuple):
    """The teacher's delay [s], and its standard deviation over the demonstrations."""

    mean_s: float
    std_s: float


class Fitted(NamedTuple):
    """The result of a method: a model of the tool's position, the held-out takes and the gate."""

    model: Model
    held_out: Sequence[HeldOut]
    gate: Gate
    delay: Delay | None = None  # None if the method does not learn it
    conductor: int | None = None  # the side of the only hand that the model depends on
    taken: str = ""  # the name of the inputs that were chosen among those tried
    tried_m: Mapping[str, float] = {}  # held-out error of each kind of inputs
    baselines: Mapping[
        str, Sequence[Vector]
    ] = {}  # errors (T, 3) [m] of each take by simpler predictions
    remarks: Sequence[str] = ()
    weights: Weights | None = None  # None if the skill refines no other


class Verdict(NamedTuple):
    """A finding about a skill: a warning; a residual risk, which somebody must accept before the
    skill is served; or a reason not to use it.
    """

    severity: Severity
    text: str


class Pose(NamedTuple):
    """The learned orientation of the tool and the learned gripper, with their figures."""

    orientation: Vector  # (4,) the mean one, quaternion x y z w
    turn: LearnedOrientation | None  # None if the orientation is constant
    gripper: LearnedGripper | None  # None if no demonstration has a gripper
    turn_error_deg: float | None  # held out, root mean square
    gripper_right: float | None  # [%] of held-out samples
    verdicts: Sequence[Verdict]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a held-out demonstration, or of all of them. Errors are root mean squares."""

    name: str
    error_mm: float
    worst_mm: float
    moment_mm: float = 0.0  # error with hyper-parameters that were chosen without its block
    predicted_mm: (
        float  # `moment_mm` as the covariance predicts it, calibrated without this demonstration
    )
    within_50: float  # [%] of the samples inside the region that should contain 50 %
    within_95: float
    held: float  # [%] of the time in which the gate would hold
    # [%] of the samples at which the tool is more than 10 cm from its prediction
    wrong: float = 0.0
    # [%] of these samples at which the skill is unsure; None if there are no such samples
    told: float | None = None
    falsely_told: float = 0.0  # [%] of the other samples at which the skill is unsure
    other_mm: dict[str, float] = {}  # errors of baselines


class Spread(msgspec.Struct, frozen=True):
    """The spread of the error over people, whose takes are held out at once."""

    people: int
    least_mm: float
    most_mm: float
    std_mm: float
    as_said: int  # people whose error is at most the one that the skill expects


class Figures(msgspec.Struct, frozen=True, kw_only=True):
    """The figures that a skill's file holds. Shares are in per cent."""

    demonstrations: tuple[Row, ...]
    all: Row
    gate_mm: float
    held_std: float = 0.0  # standard deviation of `held` over the demonstrations
    swapped: float  # share of wrong samples that the gate holds: left and right hand swapped
    beside: float  # share held with both hands displaced by 30 cm
    one_beside: float  # share held with one hand displaced by 30 cm
    ambiguous: float  # share of the samples that contradict another: same hands, other tool
    beyond_reach: float  # share of the tool's path
    # share of the tool's variance that held-out predictions explain, see `judged`
    explained: float | None = None
    # held out, root mean square; None if it was not learned
    orientation_error_deg: float | None = None
    gripper_right: float | None = None  # share of held-out samples
    warnings: tuple[str, ...] = ()
    residual: tuple[
        str, ...
    ] = ()  # residual risks: the skill is not served unless somebody accepts them
    accepted_by: str = ""  # who accepted them; empty if nobody did, or there are none
    unsafe: tuple[str, ...] = ()  # reasons not to use the skill
    tried_mm: dict[str, float] = {}  # held-out error of each kind of inputs
    taken: str = ""  # the kind of inputs that was chosen
    weight: str = ""  # weight of a new take against an earlier one; empty if no skill is refined
    weights_mm: dict[str, float] = {}  # held-out error of the new takes with each weight
    by_person: bool = False  # true if all demonstrations of a person were held out at once
    spread: Spread | None = None  # None for fewer than two people
    conclusion: str = ""  # whether the task suits the method, and what would help
    delay_s: float | None = None  # the teacher's delay; None if it was not learned
    delay_std_s: float = 0.0  # its standard deviation over the demonstrations
    # true if one hand conducts alone, and `beside` refers to it
    alone: bool | msgspec.UnsetType = msgspec.UNSET


class Evidence(NamedTuple):
    """The basis of a skill's figures."""

    skill: StoredSkill
    figures: Figures
    held_out: Sequence[HeldOut]
    inside: (
        Vector  # (L,) shares of the samples inside the regions of LEVELS, calibrated without them
    )
