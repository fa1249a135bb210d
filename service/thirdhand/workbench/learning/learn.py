"""Learning: from demonstrations to a skill with its figures.

Demonstrations are divided into takes, a method fits a model to them, held-out takes judge it, and
the skill is stored. Demonstrations are read by `thirdhand.recordings`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from kmp.criteria.errors import rms
from thirdhand.process.parallel import workers_of
from thirdhand.settings.config import Reach
from thirdhand.skills.demonstration import Demonstration, exchanged
from thirdhand.skills.skill_file import SkillError, StoredSkill
from thirdhand.skills.stored_demonstrations import stored_demonstrations
from thirdhand.workbench.learning.judgement import judged
from thirdhand.workbench.learning.pose import learned_pose
from thirdhand.workbench.learning.records import Evidence, Fitted, Options, Pose, Progress, Taught
from thirdhand.workbench.learning.store import stored
from thirdhand.workbench.learning.takes import Division, divided, standing_out

# a take fits with its hands exchanged if that reduces its error to less than this share
EXCHANGED_SHARE = 0.5


def learn(
    demonstrations: Sequence[Demonstration],
    *,
    name: str = "skill",
    names: Sequence[str] = (),
    components: int | None = None,
    points: int = 200,
    ell: float | None = None,
    penalty: float | None = None,
    spread_m: float = 0.01,
    seed: int = 0,
    delay_s: float | None = None,
    workers: str = "1",
    reach: Reach | None = None,
    accepted_by: str = "",
    refined: StoredSkill | None = None,
    progress: Progress = lambda line: None,
    show: Callable[[Evidence], None] = lambda evidence: None,
) -> StoredSkill:
    """The skill of demonstrations, with its figures. An unsafe skill has reasons in its figures.

    * `names`: names of the demonstrations in the figures.
    * `components`: number of components of the paper's mixture; None to learn without a mixture.
    * `points`: number of reference points, about.
    * `ell`: parameter of the kernel [1/m²]; None to choose it.
    * `penalty`: lambda of the paper, for a mixture only; None for its default.
    * `spread_m`: added to the standard deviation of a mixture's reference [m].
    * `seed`: seed of the mixture.
    * `delay_s`: the teacher's delay [s] between via-points; None to choose it.
    * `workers`: number of processes that share the work, or `dask:ADDRESS`; the skill is the same.
    * `reach`: reach of the arm, in which the tool's path should be.
    * `accepted_by`: person who accepts the residual risks of the skill; empty for nobody.
    * `refined`: skill that is refined by the demonstrations. Those in its file are learned from as
      well; only the new ones, and those of the same persons, are held out and judged.
    * `progress`: called with a line of text before each step.
    * `show`: called with the basis of the figures.

    Raises SkillError if nothing can be learned.
    """
    before = stored_demonstrations(refined) if refined else ()
    with workers_of(workers) as spread:
        options = Options(points, ell, components, penalty, spread_m, seed, delay_s, spread)
        division = divided(demonstrations, names, options, before)
        fitted, pose = _fitted(division, progress)
        if odd_m := standing_out(fitted.held_out):
            named = {take.name: take.demonstration for take in division.takes}
            remarks = [
                _remark(name, error_m, named, options, progress) for name, error_m in odd_m.items()
            ]
            inliers = {
                name: demonstration for name, demonstration in named.items() if name not in odd_m
            }
            division = divided(list(inliers.values()), list(inliers), options, before)
            division = division._replace(remarks=[*remarks, *division.remarks])
            fitted, pose = _fitted(division, progress)
    judgement = judged(division, fitted, pose, reach or Reach(), accepted_by=accepted_by)
    skill = stored(name, division, fitted, pose, judgement)
    show(Evidence(skill, judgement.figures, fitted.held_out, judgement.inside))
    return skill


def _remark(
    name: str, error_m: float, named: dict[str, Demonstration], options: Options, progress: Progress
) -> str:
    """The remark on a take that stands out, and whether it fits with its hands exchanged."""
    progress(f"trying {name} with its hands exchanged")
    errors_m = []
    for other in exchanged(named[name]):
        fitted, _ = _fitted(
            divided([*(named | {name: other}).values()], list(named), options), progress
        )
        errors_m += [rms(result.errors) for result in fitted.held_out if result.take.name == name]
    text = (
        f"{name} stands out, and is left out: its tool is {1000 * error_m:.0f} mm from where the "
        "others have it"
    )
    if min(errors_m) < EXCHANGED_SHARE * error_m:
        text += (
            f", and {1000 * min(errors_m):.0f} mm with its hands exchanged: put each tracker on "
            "its own hand"
        )
    return f"{text}; record it again"


def _fitted(division: Division, progress: Progress) -> tuple[Fitted, Pose]:
    """The model of the tool's position, and its orientation and gripper.

    Raises SkillError if nothing can be learned.
    """
    try:
        fitted = division.method.fit(Taught(division.takes, division.earlier), progress)
        return fitted, learned_pose(
            fitted.held_out,
            points=division.options.points,
            gripper_ell=fitted.model.gripper_ell,
            near_m=division.near_m,
        )
    except SkillError as error:
        raise SkillError("; ".join([str(error), *division.repeats])) from None
    except ValueError as error:
        count = sum(len(take.hands) for take in (*division.takes, *division.earlier))
        raise SkillError(f"cannot learn from {count} samples: {error}") from None
