"""Learning: from demonstrations to a skill, judged by demonstrations that were held out.

By default a KMP whose reference points are the demonstrations' own, its hyper-parameters chosen by
leaving one demonstration out. With a number of components, the paper's way: a mixture by EM, its
regression at sampled inputs, a KMP of that with parameters as given.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from service.contract.records import SIDES
from service.core.frame import Vector
from service.core.skill.model import standard_deviations
from service.core.skill.task import Task
from service.learning.ambiguity import same_hands_m
from service.learning.baselines import left_out, linear, look_up, same_time
from service.learning.demonstration import (
    LEAST_M,
    Demonstration,
    as_shown,
    closure_in_phase,
    fingerprint,
    groups,
    in_phase,
    moved_m,
)
from service.learning.division import task_of, via_points_never_reached
from service.learning.gate import CEILING_M, gate_between, nonsense
from service.learning.inputs import POSITIONS, Fit, Inputs, Pairs, chosen, fitted
from service.learning.judgement import SAME_TIME, Figures, HeldOut, figures, repeated
from service.learning.pose import learned_pose
from service.learning.regions import Apart, calibrated, folds, of_held_out, of_models, of_the_others
from service.learning.skill_file import HIGHEST_GATE_M, SkillError, StoredSkill, with_file
from service.learning.stages import Learned, learned
from service.learning.via_points import of_one
from service.settings.config import Reach

MARGIN_M = 0.25  # by which targets may leave the demonstrated box
ELL, PENALTY = 5.0, 2.0  # of the paper's way, in metres


class Evidence(NamedTuple):
    """What a skill is judged by: hands (T, 6) and tool (T, 3) [m] of each demonstration, and what
    the others' primitive predicts of it.
    """

    skill: StoredSkill
    figures: Figures
    paths: Pairs
    held_out: Sequence[HeldOut]
    inside: Vector  # shares of all their samples in the regions of LEVELS, found without them
    periods_s: Sequence[float]  # between the samples of each demonstration
    beliefs: Sequence[Vector]  # (T, K) in each of K stages along each; none where there are no stages


Looked = TypeVar("Looked")
LINEAR, LOOK_UP, NO_PLACES = "linear", "look-up", "without places"


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
    progress: Callable[[str], None] = lambda line: None,
    show: Callable[[Evidence], None] = lambda evidence: None,
) -> StoredSkill:
    """The skill of some demonstrations, with its figures.

    `ell` [1/m²] not given is chosen. With `components` a mixture of so many makes the reference,
    `ell` and `penalty` (lambda) are as in the paper, in metres, and `spread_m` is added to the
    reference's standard deviation. `names` are those of the demonstrations in the figures; `reach`
    is the arm's; `show` is given what the skill is judged by.

    Raises SkillError where nothing can be learned. A skill that is learned and unsafe says so in
    its figures.
    """
    if not demonstrations:
        raise SkillError("no demonstrations given, at least 1 needed")
    if components is None and penalty is not None:
        raise SkillError("a penalty goes with a number of components: without them it is chosen")
    names = list(names) or [f"demonstration {i + 1}" for i in range(len(demonstrations))]
    demonstrations, names, remarks = _worth_learning(demonstrations, names)
    repeats = "".join(f"; {remark}" for remark in remarks)
    check_count(names, components, repeats)
    if len(demonstrations) == 1:
        remarks.append("one demonstration: none was held out, so its error is of what was learned, and judges nothing")
    together, near_m, alone = groups(demonstrations), same_hands_m(demonstrations), demonstrations[0].conducts
    apart: list[Apart] = []
    side = None if alone == "both" else SIDES.index(alone)
    if side is not None:
        demonstrations = [one._replace(places=tuple(of_one(p, side) for p in one.places)) for one in demonstrations]
    task = task_of(demonstrations) if components is None and ell is None else ""
    is_open = components is None and ell is None and not isinstance(task, Task) and len(set(together.tolist())) > 1
    at_once = is_open or isinstance(task, Task)  # nothing is shifted: what knows of time tells when
    shown = _of_each(names, as_shown if at_once else in_phase, demonstrations)
    closures = [one.gripper if at_once else closure_in_phase(one) for one in demonstrations]
    paths: Pairs = [(hands, tool[:, :3]) for hands, tool in shown]
    beside = {way: left_out(paths, together, predict) for way, predict in ((LINEAR, linear), (LOOK_UP, look_up))}
    beside[SAME_TIME] = same_time(demonstrations, together)
    inputs = POSITIONS
    tried: dict[str, float] = {}
    try:
        if isinstance(task, Task):
            remarks += via_points_never_reached(task, demonstrations, names)
            progress(f"learning between the via-points {', '.join(task.names)}")
            found = learned(task, demonstrations, folds(together), progress)
            progress("learning without the places, to set beside it")
            fit = fitted(POSITIONS, paths, together, points, ell)
            beside = {NO_PLACES: [one.errors for one in _held_out(paths, together, fit, progress)], **beside}
        else:
            remarks += [task] if task else []
            if is_open:
                inputs, paths, fit, tried = chosen(demonstrations, together, points, progress)
                if inputs.alone is not None:
                    side = inputs.alone
                    remarks.append(
                        f"the {SIDES[side]} hand alone tells as well where the tool is: it conducts alone, and the "
                        "other one makes no difference, and may be absent"
                    )
            elif components is None:
                progress(f"choosing parameters over {len(paths)} demonstrations")
                fit = fitted(POSITIONS, paths, together, points, ell)
            else:
                fit = _from_mixture(
                    paths,
                    together,
                    components=components,
                    points=points,
                    ell=ell or ELL,
                    penalty=penalty or PENALTY,
                    spread_m=spread_m,
                    seed=seed,
                )
            found = _learned(inputs, paths, together, fit, progress, calibrated=bool(components))
            if components is None and len(set(together.tolist())) > 2:
                progress("how sure it may be")
                apart = of_models(
                    demonstrations,
                    paths,
                    together,
                    lambda kept: inputs.model(
                        fitted(inputs, [paths[i] for i in kept], together[kept], points, ell)(None)
                    ),
                )
        apart = apart or of_held_out(demonstrations, paths, found.held_out)
        posed = learned_pose(
            found.inputs,
            found.known,
            [tool[:, 3:] for _, tool in shown],
            closures,
            names,
            together,
            points=points,
            gripper_ell=found.model.gripper_ell,
            near_m=near_m,
        )
    except ValueError as error:
        if isinstance(error, SkillError):
            raise SkillError(f"{error}{repeats}") from None
        raise SkillError(f"cannot learn from {sum(len(hands) for hands, _ in paths)} samples: {error}") from None
    told = of_the_others(apart, together)
    judged = figures(
        demonstrations,
        list(zip(found.known, (tool for _, tool in paths), strict=True)),
        names,
        found.held_out,
        told,
        found.gate,
        posed,
        beside=beside if len(set(together.tolist())) > 1 else {},
        tried=tried,
        taken=inputs.name,
        by_person=len(set(together.tolist())) < len(paths),
        near_m=near_m,
        delay=found.delay,
        alone=side is not None,
        reach=reach or Reach(),
        remarks=remarks,
    )
    tools = np.concatenate([tool for _, tool in shown])
    skill = StoredSkill(
        name=name,
        model=found.model,
        orientation=posed.orientation,
        turn=posed.turn,
        gripper=posed.gripper,
        workspace=np.stack([tools[:, :3].min(axis=0) - MARGIN_M, tools[:, :3].max(axis=0) + MARGIN_M]),
        threshold=found.gate.threshold,
        learned_from=fingerprint(demonstrations),
        components=components or 0,
        figures=msgspec.json.encode(judged).decode(),
        conductor=side,
        regions=calibrated(apart, together),
    )
    skill = with_file(skill)
    inside = np.mean([one.inside(sure) for one, sure in told], axis=0)
    periods_s = [one.period_s for one in demonstrations]
    show(Evidence(skill, judged, paths, found.held_out, inside, periods_s, found.beliefs))
    return skill


def check_count(names: Sequence[str], components: int | None, remark: str = "") -> None:
    """Raises SkillError where nothing could be left out of demonstrations of these names."""
    if len(names) == 1 and components is None:
        raise SkillError(
            f"1 demonstration given ({names[0]}): at least 2 needed, as what is learned from the others must predict "
            "each; record another. Of one alone only the way of the paper makes a skill, whose error nobody knows: "
            f"--components 10{remark}"
        )


def _worth_learning(
    demonstrations: Sequence[Demonstration], names: Sequence[str]
) -> tuple[list[Demonstration], list[str], list[str]]:
    """Those that repeat no other, their names, and remarks on the others. Raises SkillError where
    nothing can be learned of them.
    """
    twins = repeated(_of_each(names, as_shown, demonstrations))
    remarks = [f"{names[i]} repeats {names[j]}, and is left out" for i, j in twins.items()]
    kept = [i for i in range(len(demonstrations)) if i not in twins]
    demonstrations, kept_names = [demonstrations[i] for i in kept], [names[i] for i in kept]
    if max(map(moved_m, demonstrations)) < LEAST_M:
        raise SkillError(
            f"demonstrations in which hands or tool move by less than {1000 * LEAST_M:.0f} mm teach nothing"
        )
    if len(who := sorted({one.conducts for one in demonstrations})) > 1:
        by_hand = {
            hand: [name for name, one in zip(kept_names, demonstrations, strict=True) if one.conducts == hand]
            for hand in who
        }
        which = "; ".join(f"{hand}: {', '.join(some)}" for hand, some in by_hand.items())
        raise SkillError(
            f"demonstrations that are conducted by different hands: {', '.join(who)}; take them alike, or leave out "
            f"those of one kind ({which})"
        )
    return demonstrations, kept_names, remarks


def _of_each(
    names: Sequence[str], looked_at: Callable[[Demonstration], Looked], demonstrations: Sequence[Demonstration]
) -> list[Looked]:
    """What is found of each demonstration. Raises SkillError, which names the one at fault."""
    out = []
    for name, demonstration in zip(names, demonstrations, strict=True):
        try:
            out.append(looked_at(demonstration))
        except SkillError as error:
            raise SkillError(f"{name}: {error}") from None
    return out


def _learned(
    inputs: Inputs,
    paths: Pairs,
    together: NDArray[np.intp],
    fit: Fit,
    progress: Callable[[str], None],
    *,
    calibrated: bool,
) -> Learned:
    """What demonstrations tell where they name no via-points."""
    progress(f"learning from all {len(paths)}")
    primitive, shown = fit(None), [some for some, _ in paths]
    held_out = _held_out(paths, together, fit, progress)
    reached = np.concatenate([one.gate_m for one in held_out])
    some = np.concatenate([one[:: max(1, len(one) // 50)] for one in shown])
    behind = (inputs.swapped(some)[:, 6:], some[:, 6:], some[:, 6:])
    wrong = [
        standard_deviations(primitive.predict(np.hstack([one, was.repeat(len(one) // len(some), axis=0)])).covariance)
        for one, was in zip(nonsense(some[:, :6]), behind, strict=True)
    ]
    calibration = _calibration(held_out) if calibrated else 1.0  # of deviations, where the ceiling is of errors
    ceiling = min(CEILING_M * calibration, HIGHEST_GATE_M)
    return Learned(inputs.model(primitive), held_out, gate_between(reached, wrong, ceiling=ceiling), shown, shown)


def _from_mixture(
    paths: Pairs,
    together: NDArray[np.intp],
    *,
    components: int,
    points: int,
    ell: float,
    penalty: float,
    spread_m: float,
    seed: int,
) -> Fit:
    def fit(left_out: int | None) -> KMP:
        kept = [np.hstack(path) for path, its in zip(paths, together, strict=True) if its != left_out]
        samples = np.concatenate(kept)
        mixture = GaussianMixture.fit(samples, components=components, seed=seed)
        inputs = mixture.sample_inputs(points, dimensions=6, seed=seed)
        reference = mixture.regress(inputs)
        return KMP.fit(
            inputs,
            Gaussians(reference.mean, reference.covariance + spread_m**2 * np.eye(3)),
            kernel=GaussianKernel(ell),
            lambda_mean=penalty,
            prior_mean=samples[:, 6:].mean(axis=0),
        )

    return fit


def _held_out(paths: Pairs, together: NDArray[np.intp], fit: Fit, progress: Callable[[str], None]) -> list[HeldOut]:
    """What is predicted of each demonstration from those that are not left out with it; of those
    beside which there are no others, from themselves.
    """
    several = len(set(together.tolist())) > 1
    out: list[HeldOut] = []
    primitives: dict[int, KMP] = {}
    for h, ((hands, tool), group) in enumerate(zip(paths, together.tolist(), strict=True)):
        progress(f"holding out demonstration {h + 1} of {len(paths)}")
        if group not in primitives:
            primitives[group] = fit(group if several else None)
        predicted = primitives[group].predict(hands)
        out.append(HeldOut(tool - predicted.mean, predicted.covariance, standard_deviations(predicted.covariance)))
    return out


def _calibration(held_out: Sequence[HeldOut]) -> float:
    """By how much predicted deviations are greater than errors, at least 1."""
    errors = np.concatenate([one.errors for one in held_out])
    predicted = np.concatenate([one.gate_m for one in held_out])
    return max(1.0, float(np.sqrt((predicted**2).mean() / max(float((errors**2).mean()), 1e-12))))
