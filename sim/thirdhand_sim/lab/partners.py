"""Learned skills where a third hand does something other than soldering: recordings of real
partners, and made tasks of eleven kinds. Ours beside rivals, on takes that were left out.

The experiment judges the skill that a user gets from `thirdhand learn` with its defaults. If the
command refuses, there is no skill, and the error that it would have had is listed separately.
Recordings are left out take by take, person by person, or in blocks. In the made tasks, some people
demonstrate and others do the task. A rival with given via-points has the same information as a
skill between via-points.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from thirdhand.core.skill.model import LEVELS
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import SkillError, StoredSkill
from thirdhand.workbench.learning.learn import learn
from thirdhand.workbench.learning.records import Figures
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.people.into_reach import RigidMap
from thirdhand_sim.lab.people.left_out import (
    JUDGED_HZ,
    Judged,
    LeftOut,
    judged,
    left_out,
    predicted_rounds,
    read,
)
from thirdhand_sim.lab.reached import taught
from thirdhand_sim.lab.results import (
    ADAPTED,
    OTHER,
    REFERENCE,
    TOOL_COLOUR,
    ExperimentError,
    Options,
    Results,
    brief,
    pyplot,
)
from thirdhand_sim.lab.rivals.partners import RIVALS, left_out_by
from thirdhand_sim.lab.workers import shared_out
from thirdhand_sim.made_tasks import TASK_KINDS, takes

SERVICE = "service"
TOLD = ", told"
RECORDED = {  # prefixes of the files' names
    "robot holds driver": ("robot_hold_driver",),
    "robot hands over plate": ("robot_hand_over_plate",),
    "robot hands over screw": ("robot_hand_over_screw",),
    "screw, begun by a request": ("robot_hand_over_screw",),
    "those three in one": ("robot_hold_driver", "robot_hand_over_plate", "robot_hand_over_screw"),
    "give": ("give",),
    "walk": ("walk",),
}
GROUPED_BY_PERSON = ("give",)  # tasks whose groups are persons
NAMES_PLACES = ("give",)  # tasks whose takes begin and end at via-points
BEGUN_BY_REQUEST = ("screw, begun by a request",)  # tasks whose takes a request begins
TAKES_OF_BLOCK = 9  # takes of `walk` that are left out together
PARTNER_SEEDS = EXPERIMENTS["partners"].seeds
EACH = 2  # takes of a person
OWN = 3  # takes by which a person refines the skill of the others
PARTNERS_SHOWING = len(PARTNER_SEEDS.learned[TASK_KINDS[0]].numbers)
# in the figure: label, and colour of refused skills
GIVEN = ", via-points given"
REFUSED = "#F6D2BD"
SHOWN_SETS = {
    SERVICE: ("service", ADAPTED, "o"),
    "same elapsed time": ("same elapsed time", REFERENCE, "|"),
    "linear": ("linear", REFERENCE, "x"),
    "Gaussian process": ("Gaussian process", OTHER, "s"),
    "with 2 s of memory": ("Gaussian process with 2 s of memory", TOOL_COLOUR, "^"),
    "memory and clock": ("Gaussian process with memory and clock", TOOL_COLOUR, "v"),
    "HMM over demonstrations": ("HMM over demonstrations", "#CC79A7", "D"),
}


class Part(NamedTuple):
    """The work of one process: a task and the group that is left out; made tasks leave no group
    out.
    """

    task: str
    out: str
    people: int
    data: Path | None
    seed_offset: int = 0


class SkillFold(NamedTuple):
    """The skill of the service in one fold, as `thirdhand learn` makes it with its defaults."""

    refusals: tuple[str, ...]  # reasons why the command writes no skill
    residual: tuple[str, ...]  # risks that somebody must accept before the daemon serves it
    figures: Figures | None  # None if nothing could be learned
    model: str
    # each round of each take with the command's skill; none if it is refused
    accepted: list[list[Judged]]
    # each take of a refused fold, with the skill used in spite of the refusal
    in_spite: list[Judged]
    take_refusals: list[str]  # via-points that the skill cannot be adapted to


class Found(NamedTuple):
    """The judged takes of each rival, the service's fold without and with via-points, and further
    results of some tasks.
    """

    rivals: dict[str, list[Judged]]
    service: dict[str, SkillFold]
    moved: RigidMap | None = None  # map of recorded takes into the arm's reach
    # fold of a skill refined by OWN takes of the left-out person, judged on that person's other
    # takes
    own: SkillFold | None = None


@functools.lru_cache(maxsize=2)
def _takes(
    task: str, people: int, data: Path | None, seed_offset: int = 0
) -> tuple[list[LeftOut], list[LeftOut]]:
    """Takes to learn from, and takes to judge wherever they are not learned from."""
    if task in TASK_KINDS:
        groups = [
            [
                left_out(f"person {take.person} take {i % EACH}", "", take.demonstration)
                for i, take in enumerate(
                    takes(task, people=stream.numbers[:people], each=EACH, seed=stream.seed)
                )
            ]
            for stream in (
                PARTNER_SEEDS.learned[task],
                PARTNER_SEEDS.evaluation[task].moved(seed_offset),
            )
        ]
        return groups[0], groups[1]
    assert data is not None
    files = [path for path in sorted(data.glob("*.npz")) if path.name.startswith(RECORDED[task])]
    if len(files) < 2:
        raise ExperimentError(
            f"{len(files)} recordings of {task!r} in {data}: {RECORDED[task][0]}*.npz needed"
        )
    recordings = [
        left_out(
            path.stem,
            group,
            read(path, named=task in NAMES_PLACES)._replace(
                person=group * (task in GROUPED_BY_PERSON),
                begun_s=0.0 if task in BEGUN_BY_REQUEST else None,
            ),
        )
        for path, group in ((path, _group(task, i, path.stem)) for i, path in enumerate(files))
    ]
    return recordings, recordings


def _group(task: str, number: int, name: str) -> str:
    if task == "give":
        return name.split("_")[1]
    return f"block {number // TAKES_OF_BLOCK}" if task == "walk" else name


def part(one: Part) -> Found:
    """The fold of one part."""
    training, asked = _takes(one.task, one.people, one.data, one.seed_offset)
    if one.out:
        training = [t for t in training if t.group != one.out]
        asked = [t for t in asked if t.group == one.out]
    named = bool(training[0].demonstration.via_points)
    result = Found({}, {})
    if one.task not in TASK_KINDS:
        into_reach = RigidMap.of(training, Settings().reach)
        result = result._replace(moved=into_reach)
        training, asked = (list(map(into_reach.moved, batch)) for batch in (training, asked))
    for has_places in [False] * (one.task not in TASK_KINDS) + [True] * named:
        for name, rival in RIVALS.items():
            predictions = left_out_by(rival, training, asked, told=has_places)
            result.rivals[name + TOLD * has_places] = [
                judged(*pair) for pair in zip(asked, predictions, strict=True)
            ]
        result.service[SERVICE + TOLD * has_places] = served(training, asked, told=has_places)
    if one.task in GROUPED_BY_PERSON:
        skill, _ = as_command(training, told=named)
        result = result._replace(own=served(asked[:OWN], asked[OWN:], told=named, refined=skill))
    return result


def as_command(
    shown: Sequence[LeftOut], *, told: bool, refined: StoredSkill | None = None
) -> tuple[StoredSkill | None, tuple[str, ...]]:
    """The skill of `thirdhand learn`, an arm's reach included, and the reasons
    why the command writes none. `told`: the takes hold their via-points. `refined`: the skill that
    is given to --from.
    """
    try:
        skill = learn(
            [
                take.demonstration if told else take.demonstration._replace(via_points=())
                for take in shown
            ],
            names=[take.name for take in shown],
            refined=refined,
        )
    except SkillError as error:
        return None, (str(error),)
    return skill, figures_of(skill).unsafe


def figures_of(skill: StoredSkill) -> Figures:
    """The figures in a skill's file."""
    return msgspec.json.decode(skill.figures, type=Figures)


def served(
    shown: Sequence[LeftOut],
    asked: Sequence[LeftOut],
    *,
    told: bool,
    refined: StoredSkill | None = None,
) -> SkillFold:
    """The service's skill of the demonstrated takes, judged on the left-out ones.

    An accepted skill is judged with the arm's reach. A refused skill is judged without it, as
    otherwise only the reach would decide.
    """
    skill, refusals = as_command(shown, told=told, refined=refined)
    if skill is None:
        return SkillFold(refusals, (), None, "", [[] for _ in asked], [], [])
    figures = figures_of(skill)
    fold = SkillFold(refusals, figures.residual, figures, type(skill.model).__name__, [], [], [])
    for take in asked:
        rounds: list[Judged] = []
        try:
            taught_skill = taught(skill, take.demonstration.via_points) if told else skill
            predictions = predicted_rounds(
                taught_skill, take, reach=None if refusals else Settings().reach
            )
            rounds = [judged(take, prediction) for prediction in predictions]
        except SkillError as error:
            fold.take_refusals.append(str(error))
        if refusals:
            fold.in_spite.extend(rounds[:1])
        fold.accepted.append([] if refusals else rounds)
    return fold


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers of all sets."""
    people = max(2, round(PARTNERS_SHOWING * options.share))
    parts = [
        Part(kind, "", people, None, options.seed_offset)
        for kind in TASK_KINDS[: max(2, round(len(TASK_KINDS) * options.share))]
    ]
    if options.data is not None:
        for task in RECORDED:
            groups = sorted({take.group for take in _takes(task, 0, options.data)[0]})
            parts += [
                Part(task, out, 0, options.data)
                for out in groups[: max(2, round(len(groups) * options.share))]
            ]
    else:
        results.say("made tasks alone: --data DIR adds recordings")
    by_task: dict[str, list[Found]] = {}
    for job, result in zip(parts, shared_out(part, parts, options.workers), strict=True):
        by_task.setdefault(job.task, []).append(result)
        *_, ours = result.service.values()
        results.say(f"{job.task} {job.out}: {_line(ours)}")
    numbers: dict[str, Any] = {
        "judged_hz": JUDGED_HZ,
        "levels": LEVELS,
        "demonstrators": people,
        "takes_each": EACH,
        "tested_people": people,
        "recorded": {task: numbers_of(by_task[task]) for task in RECORDED if task in by_task},
        "made": {kind: numbers_of(by_task[kind]) for kind in TASK_KINDS if kind in by_task},
    }
    for kind in ("recorded", "made"):
        folds = [
            fold
            for task in numbers[kind]
            for result in by_task[task]
            for fold in result.service.values()
        ]
        numbers[f"all_{kind}"] = _accepted(folds)
    draw_numbers(results, numbers)
    return numbers


def numbers_of(found: Sequence[Found]) -> dict[str, Any]:
    """The numbers of a set: of each rival, and of the service.

    The service's numbers are those of accepted takes, and `beside_mm` has each rival on the same
    takes.
    """
    methods = {
        name: summary([take for part in found for take in part.rivals[name]])
        for name in found[0].rivals
    }
    for name in found[0].service:
        methods[name] = _service_numbers(found, name)
    numbers: dict[str, Any] = {"folds": len(found), "methods": methods}
    if found[0].moved:
        numbers["moved"] = [part.moved for part in found]
    own_folds = [part.own for part in found if part.own]
    if own_folds:
        numbers["own_takes"] = _accepted(own_folds) | {
            "own": OWN,
            "folds_refused": sum(bool(fold.refusals) for fold in own_folds),
            "weights": [fold.figures.weight for fold in own_folds if fold.figures],
        }
    return numbers


def _accepted(folds: Sequence[SkillFold]) -> dict[str, Any]:
    """The numbers of all rounds of accepted takes, and the error [mm] by round."""
    every = itertools.chain.from_iterable(fold.accepted for fold in folds)
    takes = [rounds for rounds in every if rounds]
    numbers = summary(list(itertools.chain.from_iterable(takes)))
    rounds_mm = [summary(one_round)["rms_mm"] for one_round in zip(*takes, strict=True)]
    return numbers | {"takes": len(takes), "rounds_mm": rounds_mm}


def _service_numbers(found: Sequence[Found], name: str) -> dict[str, Any]:
    """The numbers of the service in one setting."""
    folds = [part.service[name] for part in found]
    accepted = [bool(take) for fold in folds for take in fold.accepted]
    return _accepted(folds) | {
        "folds": len(folds),
        "folds_refused": sum(bool(fold.refusals) for fold in folds),
        "folds_at_risk": sum(bool(fold.residual and not fold.refusals) for fold in folds),
        "risks": _first_two(fold.residual for fold in folds),
        "refuses": accepted.count(False),
        "reasons": _first_two((*fold.refusals, *fold.take_refusals) for fold in folds),
        "in_spite_of_refusal": summary([take for fold in folds for take in fold.in_spite]),
        "beside_mm": _beside(found, name.removeprefix(SERVICE), accepted),
        "model": next((fold.model for fold in folds if fold.model), None),
        **_said([fold.figures for fold in folds if fold.figures]),
    }


def _first_two(texts: Iterable[Iterable[str]]) -> list[str]:
    """The first two different texts."""
    return list(dict.fromkeys(itertools.chain.from_iterable(texts)))[:2]


def _beside(
    found: Sequence[Found], setting: str, accepted: Sequence[bool]
) -> dict[str, float | None]:
    """The error [mm] of each rival on the takes that the service accepted."""
    errors: dict[str, float | None] = {}
    for rival in RIVALS:
        takes = [take for part in found for take in part.rivals[rival + setting]]
        errors[rival] = summary(list(itertools.compress(takes, accepted))).get("rms_mm")
    return errors


def _said(figures: Sequence[Figures]) -> dict[str, Any]:
    """Figures and remarks of `learn` on its skills."""
    if not figures:
        return {"learn_says_mm": None, "ambiguous": None, "unsafe": 0, "says": []}
    return {
        "learn_says_mm": float(np.mean([skill.all.error_mm for skill in figures])),
        "ambiguous": float(np.mean([skill.ambiguous for skill in figures])) / 100,
        "unsafe": sum(bool(skill.unsafe) for skill in figures),
        "taken": Counter(skill.taken for skill in figures),
        "says": [*figures[0].unsafe, *figures[0].warnings],
    }


def summary(takes: Sequence[Judged]) -> dict[str, Any]:
    """Errors over all samples [mm], and shares of samples; without takes, only their number."""
    if not takes:
        return {"takes": 0}
    count = sum(take.samples for take in takes)
    inside = [take.inside for take in takes if take.inside is not None]
    wrong = sum(take.wrong for take in takes)
    return {
        "takes": len(takes),
        "rms_mm": 1000 * float(np.sqrt(sum(take.squares for take in takes) / count)),
        "shifted_rms_mm": 1000 * float(np.sqrt(sum(take.shifted for take in takes) / count)),
        "shift_s": float(np.median([take.shift_s for take in takes])),
        "worst_mm": 1000 * max(take.worst_m for take in takes),
        "coverage": [float(x) / count for x in np.sum(inside, axis=0)] if inside else None,
        "held": _share([take.held for take in takes], count),
        "unsure": _share([take.unsure for take in takes], count),
        "wrong": wrong / count,
        # the shares of wrong samples, and of the others, at which the skill held or was unsure
        "told": _share([take.told for take in takes], wrong),
        "falsely_told": _share([take.falsely_told for take in takes], count - wrong),
        **_detection(takes),
    }


def _detection(takes: Sequence[Judged]) -> dict[str, Any]:
    """How well the predicted probabilities of an error separate right samples from wrong ones: the
    shares of both above each of PROBABILITIES, the area under this curve, and the mean squared
    difference of the probabilities from the truth, beside that of a constant probability.
    """
    counts = [take.by_probability for take in takes if take.by_probability is not None]
    if not counts:
        return {}
    by_probability = np.sum(counts, axis=0)
    right, wrong = by_probability.sum(axis=1)
    count = right + wrong
    numbers = {
        "brier": sum(take.brier for take in takes) / count,
        "brier_of_constant": right * wrong / count**2,
    }
    if not wrong or not right:
        return numbers
    above = np.cumsum(by_probability[:, ::-1], axis=1) / [[right], [wrong]]
    curve = np.hstack([np.zeros((2, 1)), above])
    area = float(np.trapezoid(curve[1], curve[0]))
    return numbers | {"roc": np.round(curve, 4).tolist(), "area_under_roc": area}


def _share(counts: Sequence[float | None], total: int) -> float | None:
    """The sum of the known counts as a share of a total; None if none is known, or the total is
    0.
    """
    known_counts = [count for count in counts if count is not None]
    return sum(known_counts) / total if known_counts and total > 0 else None


def _line(fold: SkillFold) -> str:
    """A fold as a line of progress."""
    rounds = [one for take in fold.accepted for one in take]
    text = brief(summary(rounds or fold.in_spite))
    return f"refused ({fold.refusals[0]}), in spite of it {text}" if fold.refusals else text


class SetVerdict(NamedTuple):
    """A set as `learn` judges it: summaries of accepted takes, and of refused skills that were used
    all the same.
    """

    accepted: Mapping[str, Any]
    in_spite: Mapping[str, Any]
    folds_refused: int
    refused: str  # the number of refused skills or takes, in words
    at_risk: int = 0  # skills that are served only if somebody accepts their residual risk

    @property
    def some_refused(self) -> bool:
        """True if the errors are those of some takes only, and rivals were judged on the same
        takes.
        """
        return bool(
            self.accepted["takes"] and self.accepted["refuses"] and "beside_mm" in self.accepted
        )


def verdict(task: Mapping[str, Any], method: str) -> SetVerdict:
    """The verdict on the service in a set's numbers.

    In older results without `folds_refused`, `learn` calls all or none of a set's skills unsafe,
    and all were used.
    """
    numbers = task["methods"][method]
    none = {"takes": 0}
    folds_refused = numbers.get("folds_refused", numbers["unsafe"])
    takes = numbers["takes"] + numbers["refuses"]
    refused = (
        f"{folds_refused} of {task['folds']} skills"
        if folds_refused
        else f"{numbers['refuses']} of {takes} takes"
    )
    if "in_spite_of_refusal" not in numbers and folds_refused:
        return SetVerdict(none, numbers, folds_refused, refused)
    in_spite = numbers.get("in_spite_of_refusal", none)
    at_risk = numbers.get("folds_at_risk", 0)
    return SetVerdict(
        numbers, in_spite, folds_refused, refused if numbers["refuses"] else "none", at_risk
    )


def _rows_of(sets: Mapping[str, Any]) -> list[tuple[str, Any, str]]:
    """The rows of a panel: label, numbers of the set, and suffix of the setting."""
    rows = []
    for name, task in sets.items():
        endings = [ending for ending in ("", TOLD) if SERVICE + ending in task["methods"]]
        for ending in endings:
            rows.append((name.replace("_", " ") + GIVEN * (ending != endings[0]), task, ending))
    return rows


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers."""
    plt = pyplot()
    panels = []
    for title, sets in (
        ("recorded partners", numbers["recorded"]),
        ("made tasks, via-points given", numbers["made"]),
    ):
        rows = _rows_of(sets)
        panels += [(title, rows)] if rows else []
    heights = [len(rows) for _, rows in panels]
    figure, axes = plt.subplots(
        len(panels),
        1,
        figsize=(7.5, 1.6 + 0.36 * sum(heights)),
        height_ratios=heights,
        squeeze=False,
        sharex=True,
    )
    for ax, (title, rows) in zip(axes[:, 0], panels, strict=True):
        labels = []
        for y, (name, task, ending) in enumerate(rows):
            ours = verdict(task, SERVICE + ending)
            labels.append(name + f"\n({ours.refused} refused)" * (ours.refused != "none"))
            ax.axhline(y, color="#dddddd", lw=0.8, zorder=0)
            for method, (_, colour, marker) in SHOWN_SETS.items():
                scores = (
                    ours.accepted if method == SERVICE else task["methods"].get(method + ending, {})
                )
                ax.plot(scores.get("rms_mm", np.nan), y, marker, color=colour, ms=5, ls="")
            ax.plot(
                ours.accepted.get("shifted_rms_mm", np.nan),
                y,
                "o",
                mfc="none",
                color=ADAPTED,
                ms=6,
                ls="",
            )
            ax.plot(
                ours.in_spite.get("rms_mm", np.nan),
                y,
                "o",
                color=ADAPTED,
                mfc=REFUSED,
                ms=6,
                ls="",
                zorder=4,
            )
        ax.set_yticks(range(len(rows)), labels)
        ax.set(ylim=(len(rows) - 0.4, -0.6), xlim=(0, None))
        ax.set_title(title, loc="left", fontsize=9)
    for label, colour, marker in SHOWN_SETS.values():
        axes[0, 0].plot([], [], marker, color=colour, ms=5, ls="", label=label)
    axes[0, 0].plot(
        [],
        [],
        "o",
        mfc="none",
        color=ADAPTED,
        ms=6,
        ls="",
        label="service, with the best time shift of each take",
    )
    label = "service, refused by learn, used in spite of it"
    axes[0, 0].plot([], [], "o", color=ADAPTED, mfc=REFUSED, ms=6, ls="", label=label)
    axes[-1, 0].set_xlabel("tool's error on takes that were left out, rms [mm]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8
    )
    results.figure(figure)
    _draw_reliability(results, numbers)


def _draw_reliability(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the skills' own estimates of their errors, set by set."""
    plt = pyplot()
    figure, (inside, warned) = plt.subplots(1, 2, figsize=(7.5, 3.6))
    inside.plot([0, 100], [0, 100], color="#dddddd", zorder=0)
    warned.plot([0, 100], [0, 100], color="#dddddd", zorder=0)
    for part, colour, label in (
        ("recorded", TOOL_COLOUR, "recorded partners"),
        ("made", ADAPTED, "made tasks"),
    ):
        for task in numbers[part].values():
            name = [name for name in task["methods"] if name.startswith(SERVICE)][-1]
            scores = task["methods"][name]
            if scores["takes"] and scores["coverage"]:
                levels, shares = 100 * np.array([numbers["levels"], scores["coverage"]])
                inside.plot(levels, shares, ".-", color=colour, lw=0.8)
            if "roc" in scores:
                warned.plot(*(100 * np.array(scores["roc"])), color=colour, lw=0.8)
                told = 100 * scores["falsely_told"], 100 * scores["told"]
                warned.plot(*told, "o", color=colour, ms=4)
        inside.plot([], [], ".-", color=colour, label=label)
    inside.set(
        xlim=(0, 100), ylim=(0, 100), xlabel="confidence region [%]", ylabel="samples inside [%]"
    )
    warned.set(xlim=(0, 100), ylim=(0, 100), xlabel="right samples above a probability [%]")
    warned.set_ylabel("wrong samples above it [%]")
    inside.legend(fontsize=8)
    results.figure(figure, "reliability")
