"""Learning: from demonstrations to a skill with its figures.

Demonstrations are divided into takes, a method fits a model to them, held-out takes judge it, and
the skill is stored. Demonstrations are read by `service.files`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from service.learning.demonstration import Demonstration
from service.learning.judgement import judged
from service.learning.pose import learned_pose
from service.learning.records import Evidence, Fitted, Options, Pose, Progress, Taught
from service.learning.skill_file import SkillError, StoredSkill
from service.learning.store import stored
from service.learning.stored_demonstrations import stored_demonstrations
from service.learning.takes import Division, divided
from service.settings.config import Reach


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
    * `reach`: reach of the arm, in which the tool's path should be.
    * `accepted_by`: person who accepts the residual risks of the skill; empty for nobody.
    * `refined`: skill that is refined by the demonstrations. Those in its file are learned from as
      well; only the new ones, and those of the same persons, are held out and judged.
    * `progress`: called with a line of text before each step.
    * `show`: called with the basis of the figures.

    Raises SkillError if nothing can be learned.
    """
    options = Options(points, ell, components, penalty, spread_m, seed)
    division = divided(demonstrations, names, options, stored_demonstrations(refined) if refined else ())
    fitted, pose = _fitted(division, progress)
    judgement = judged(division, fitted, pose, reach or Reach(), accepted_by=accepted_by)
    skill = stored(name, division, fitted, pose, judgement)
    show(Evidence(skill, judgement.figures, fitted.held_out, judgement.inside))
    return skill


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
