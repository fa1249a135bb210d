"""Learning: from demonstrations to a skill, judged by demonstrations that were held out.

By default a KMP whose reference points are the demonstrations' own, its hyper-parameters chosen by
leaving one demonstration out. With a number of components, the paper's way: a mixture by EM, its
regression at sampled inputs, a KMP of that with parameters as given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from service.config import Reach
from service.core.frame import Vector
from service.core.skill import ORDER
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.memory import features
from service.core.skill.model import standard_deviations
from service.core.skill.task import Task
from service.learning.ambiguity import same_hands_m
from service.learning.baselines import left_out, linear, look_up
from service.learning.choice import CLEARLY, Choice, rms
from service.learning.demonstration import Demonstration, closure_in_phase, fingerprint, in_phase
from service.learning.gate import CEILING_M, gate_between, nonsense
from service.learning.judgement import Figures, HeldOut, figures, repeated
from service.learning.pose import learned_pose
from service.learning.skill_file import HIGHEST_GATE_M, SkillError, StoredSkill, with_file
from service.learning.tasks import Learned, learned, task_of, via_points_never_reached

MARGIN_M = 0.25  # by which targets may leave the demonstrated box
WORTH_M = 0.005  # by which a memory must better predict, else it is left out
ELL, PENALTY = 5.0, 2.0  # of the paper's way, in metres


class Evidence(NamedTuple):
    """What a skill is judged by: hands (T, 6) and tool (T, 3) [m] of each demonstration, and what
    the others' primitive predicts of it.
    """

    skill: StoredSkill
    figures: Figures
    paths: Sequence[tuple[Vector, Vector]]
    held_out: Sequence[HeldOut]


Looked = TypeVar("Looked")
LINEAR, LOOK_UP, NO_PLACES, NO_MEMORY = "linear", "look-up", "without places", "without memory"
Fit = Callable[[int | None], KMP]  # the primitive of all demonstrations but one, or of all


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
    pairs = _of_each(names, in_phase, demonstrations)
    twins = repeated(pairs)
    remarks = [f"{names[i]} repeats {names[j]}, and is left out" for i, j in twins.items()]
    repeats = "".join(f"; {remark}" for remark in remarks)
    kept = [i for i in range(len(pairs)) if i not in twins]
    demonstrations, names = [demonstrations[i] for i in kept], [names[i] for i in kept]
    paths, poses = [(pairs[i][0], pairs[i][1][:, :3]) for i in kept], [pairs[i][1][:, 3:] for i in kept]
    closures = _of_each(names, closure_in_phase, demonstrations)
    if len(kept) == 1:
        remarks.append("one demonstration: none was held out, so its error is of what was learned, and judges nothing")
    beside = {way: left_out(paths, predict) for way, predict in ((LINEAR, linear), (LOOK_UP, look_up))}
    near_m = same_hands_m(demonstrations)
    alone = demonstrations[0].conducts
    if len(who := sorted({one.conducts for one in demonstrations})) > 1:
        raise SkillError(f"demonstrations that are conducted by different hands: {', '.join(who)}; take them alike")
    task = task_of(demonstrations) if components is None and ell is None and alone == "both" else ""
    try:
        if isinstance(task, Task):
            remarks += via_points_never_reached(task, demonstrations, names)
            progress(f"learning between the via-points {', '.join(task.names)}")
            found = learned(task, demonstrations, paths, progress)
            progress("learning without the places, to set beside it")
            fit = _from_demonstrations(paths, points, ell)
            beside = {NO_PLACES: [one.errors for one in _held_out(paths, fit, progress)], **beside}
        else:
            remarks += [task] if task else []
            if alone != "both" and any(one.places for one in demonstrations):
                remarks.append(f"the places that are named are not used: the {alone} hand conducts alone")
            if components is None:
                progress(f"choosing parameters over {len(paths)} demonstrations")
                fit = _from_demonstrations(paths, points, ell)
                if ell is None and len(paths) > 1:
                    progress("whether where the hands were tells more")
                    past = [(features(one.hands, one.period_s, ORDER), one.tool[:, :3]) for one in demonstrations]
                    remembering = _from_demonstrations(past, points, None)
                    without = [one.errors for one in _held_out(paths, fit, progress)]
                    error = rms(np.concatenate([one.errors for one in _held_out(past, remembering, progress)]))
                    usual = rms(np.concatenate(without))
                    if error < min(CLEARLY * usual, usual - WORTH_M):
                        beside = {NO_MEMORY: without, **beside}
                        fit, paths = remembering, past
                        poses = [one.tool[:, 3:] for one in demonstrations]
                        closures = [one.gripper for one in demonstrations]
            else:
                fit = _from_mixture(
                    paths,
                    components=components,
                    points=points,
                    ell=ell or ELL,
                    penalty=penalty or PENALTY,
                    spread_m=spread_m,
                    seed=seed,
                )
            found = _learned(paths, fit, progress, calibrated=bool(components))
        posed = learned_pose(
            found.inputs,
            [hands for hands, _ in paths],
            poses,
            closures,
            names,
            points=points,
            gripper_ell=found.model.gripper_ell,
            near_m=near_m,
        )
    except ValueError as error:
        if isinstance(error, SkillError):
            raise SkillError(f"{error}{repeats}") from None
        raise SkillError(f"cannot learn from {sum(len(hands) for hands, _ in paths)} samples: {error}") from None
    judged = figures(
        demonstrations,
        paths,
        names,
        found.held_out,
        found.gate,
        posed,
        beside=beside if len(paths) > 1 else {},
        near_m=near_m,
        reach=reach or Reach(),
        remarks=remarks,
    )
    tools = np.concatenate([pairs[i][1] for i in kept])
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
        conductor=None if alone == "both" else ("left", "right").index(alone),
    )
    skill = with_file(skill)
    show(Evidence(skill, judged, paths, found.held_out))
    return skill


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
    paths: Sequence[tuple[Vector, Vector]], fit: Fit, progress: Callable[[str], None], *, calibrated: bool
) -> Learned:
    """What demonstrations tell where they name no via-points."""
    progress(f"learning from all {len(paths)}")
    primitive, hands = fit(None), [hands for hands, _ in paths]
    held_out = list(_held_out(paths, fit, progress))
    reached = np.concatenate([one.gate_m for one in held_out])
    some = np.concatenate([one[:: max(1, len(one) // 50)] for one in hands])
    behind = some[:, 6:].reshape(len(some), -1, 2, 3)
    swapped = behind[:, :, ::-1].reshape(len(some), -1)
    wrong = [
        standard_deviations(primitive.predict(np.hstack([one, was.repeat(len(one) // len(some), axis=0)])).covariance)
        for one, was in zip(nonsense(some[:, :6]), (swapped, some[:, 6:], some[:, 6:]), strict=True)
    ]
    calibration = _calibration(held_out) if calibrated else 1.0  # of deviations, where the ceiling is of errors
    ceiling = min(CEILING_M * calibration, HIGHEST_GATE_M)
    return Learned(HandsKMP(primitive), held_out, gate_between(reached, wrong, ceiling=ceiling), hands)


def _from_demonstrations(paths: Sequence[tuple[Vector, Vector]], points: int, ell: float | None) -> Fit:
    choice = Choice.of(paths, points)
    parameters = choice.parameters(ell, may_be_linear=True)
    residuals = choice.residuals(parameters.ell, parameters.noise, is_linear=parameters.is_linear)

    return lambda left_out: choice.primitive(parameters, residuals, without=left_out)


def _from_mixture(
    paths: Sequence[tuple[Vector, Vector]],
    *,
    components: int,
    points: int,
    ell: float,
    penalty: float,
    spread_m: float,
    seed: int,
) -> Fit:
    def fit(left_out: int | None) -> KMP:
        samples = np.concatenate([np.hstack(path) for i, path in enumerate(paths) if i != left_out])
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


def _held_out(paths: Sequence[tuple[Vector, Vector]], fit: Fit, progress: Callable[[str], None]) -> Iterator[HeldOut]:
    """What is predicted of each demonstration from the others; of a single one, from itself."""
    for h, (hands, tool) in enumerate(paths):
        progress(f"holding out demonstration {h + 1} of {len(paths)}")
        predicted = fit(h if len(paths) > 1 else None).predict(hands)
        yield HeldOut(tool - predicted.mean, predicted.covariance, standard_deviations(predicted.covariance))


def _calibration(held_out: Sequence[HeldOut]) -> float:
    """By how much predicted deviations are greater than errors, at least 1."""
    errors = np.concatenate([one.errors for one in held_out])
    predicted = np.concatenate([one.gate_m for one in held_out])
    return max(1.0, float(np.sqrt((predicted**2).mean() / max(float((errors**2).mean()), 1e-12))))
