"""Learned skills on modelled people who did not demonstrate, ours beside rivals.

All methods learn from the same demonstrations, get the same places with the same errors, and their
targets are followed by the same core. Parameters are chosen on the people of the tuning set, from
the same number of candidates for each method. The figures are those of the test set.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thirdhand.core.skill.model import LEVELS
from thirdhand_sim.lab.catalogue import DRAWING, EXPERIMENTS, Stream
from thirdhand_sim.lab.people.recorded_people import recorded_people
from thirdhand_sim.lab.people.trials import (
    FAST_MPS,
    FOR_S,
    NEAR_HAND_M,
    SLOW_MPS,
    TRIAL_HZ,
    WITHIN_M,
    WRONG_M,
    SeenSession,
    TrialOutcome,
    judge,
    seen,
)
from thirdhand_sim.lab.results import ADAPTED, OTHER, Array, Options, Results, brief, pyplot
from thirdhand_sim.lab.rivals.gaussian_process import GaussianProcess
from thirdhand_sim.lab.rivals.method import RivalMethod, RivalModel
from thirdhand_sim.lab.rivals.mixtures import MixtureRegression
from thirdhand_sim.lab.rivals.places import LookUp, NoDemonstrations
from thirdhand_sim.lab.rivals.promp import InteractionProMP
from thirdhand_sim.lab.rivals.service import Service, ServiceAsPaper
from thirdhand_sim.lab.workers import shared_out
from thirdhand_sim.people import Group, Places, person
from thirdhand_sim.sessions import BREAKING, SessionDemonstration, breaking, demonstrations, session

PEOPLE_SEEDS = EXPERIMENTS["people"].seeds
STREAMS_OF_GROUP: dict[Group, Mapping[str, Stream]] = {
    "tuning": PEOPLE_SEEDS.tuning,
    "test": PEOPLE_SEEDS.evaluation,
}
PEOPLE_SHOWING = len(PEOPLE_SEEDS.learned["people"].numbers)
PEOPLE_OF_GROUP: dict[Group, int] = {
    group: len(part["people"].numbers) for group, part in STREAMS_OF_GROUP.items()
}
# scenes of each person, half with each of SIGMAS_M
SCENES_OF_GROUP: dict[Group, int] = {
    "tuning": 2,
    "test": 4,
}
SIGMAS_M = (0.005, 0.010)
BREAKING_SCENES: dict[Group, int] = {
    group: len(part["breaking"].numbers) for group, part in STREAMS_OF_GROUP.items()
}
RESAMPLED = 2000
SAME = 0.05  # candidates within this difference of success are equally good
TEACHER = "teacher"


class Entry(NamedTuple):
    """A method: its label, and the candidates of its parameters, the chosen ones first."""

    label: str
    candidates: tuple[RivalMethod, ...]


PEOPLE_METHODS = {
    "ours": Entry("ours, between places", (Service(),)),
    "as_paper": Entry("ours, the paper's way:\nplaces are via-points", (ServiceAsPaper(),)),
    "none": Entry(
        "no demonstrations",
        tuple(NoDemonstrations(ell) for ell in (5.0, 1.0, 2.5, 10.0, 20.0, 40.0)),
    ),
    "look_up": Entry(
        "distance-weighted\nlook-up",
        tuple(LookUp(power) for power in (4.0, 2.0, 3.0, 6.0, 8.0, 12.0)),
    ),
    "gaussian_process": Entry(
        "Gaussian process",
        tuple(
            GaussianProcess(count, own_m)
            for count, own_m in ((15, 0.0), (30, 0.0), (30, 0.05), (30, 0.1), (15, 0.05), (15, 0.1))
        ),
    ),
    "gmr": Entry("GMR", tuple(MixtureRegression(count) for count in (6, 5, 8, 12, 16, 20))),
    "paper": Entry(
        "KMP, the paper's numbers,\nour neighbourhoods",
        tuple(
            ServiceAsPaper(0.5, 2.0, spread) for spread in (0.005, 0.0001, 0.001, 0.003, 0.01, 0.02)
        ),
    ),
    "promp": Entry(
        "Interaction ProMP",
        tuple(
            InteractionProMP(by_length=by_length, hands_m=hands_m)
            for by_length in (True, False)
            for hands_m in (0.01, 0.02, 0.03)
        ),
    ),
}


class MethodTask(NamedTuple):
    """One method with the parameters of one candidate, in the people's scenes or in the breaking
    ones.
    """

    method: str
    candidate: int
    group: Group
    kind: str  # "" or one of BREAKING
    people: int
    scenes: int
    hands: Path | None
    first: int = 0  # number of the first person, or of the first breaking scene


@functools.cache
def _taught() -> list[SessionDemonstration]:
    return demonstrations(PEOPLE_SHOWING)


@functools.cache
def _learned(method: str, candidate: int) -> RivalModel[Places]:
    return PEOPLE_METHODS[method].candidates[candidate].learn(_taught())


@functools.lru_cache(maxsize=8)
def sessions_of(
    group: Group, kind: str, people: int, scenes: int, hands: Path | None, first: int
) -> list[SeenSession]:
    """The sessions of a group, with alternating sigma from scene to scene; in breaking scenes the
    places are exact.
    """
    if kind:
        numbers = range(first, first + scenes)
        return [seen(breaking(kind, number, group=group)) for number in numbers]
    everyone = [person(group, number) for number in range(first, first + people)]
    if hands is not None and group == "tuning":
        everyone += recorded_people(hands)
    return [
        seen(session(subject, number, group=group, sigma_m=SIGMAS_M[number % 2]))
        for subject in everyone
        for number in range(scenes)
    ]


def outcomes(task: MethodTask) -> list[TrialOutcome]:
    """The outcomes of a task's sessions."""
    runs = sessions_of(task.group, task.kind, task.people, task.scenes, task.hands, task.first)
    if task.method == TEACHER:
        return [judge(None, trial) for trial in runs]
    model = _learned(task.method, task.candidate)
    return [judge(model.place(trial.session.told), trial) for trial in runs]


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers: all candidates on the tuning set, or the chosen ones on the test set."""
    group = options.group
    breaking_scenes = max(2, round(BREAKING_SCENES[group] * options.share))
    tasks = tasks_of(options, breaking_scenes)
    by_task: dict[MethodTask, list[TrialOutcome]] = {}
    for task, rows in zip(tasks, shared_out(outcomes, tasks, options.workers), strict=True):
        by_task[task] = rows
        if task.kind:
            results.say(f"{task.method:<17} {task.kind}: {_broken(rows)}")
        else:
            results.say(f"{task.method:<17} {task.candidate}: {brief(summary(rows))}")
    _say_better_candidates(results, by_task)

    usual = {task: rows for task, rows in by_task.items() if not task.kind}
    main = {task.method: rows for task, rows in usual.items() if task.candidate == 0}
    numbers = {
        "set": group,
        "people": len({row.person for row in main["ours"]}),
        "scenes_of_each": SCENES_OF_GROUP[group],
        "breaking_scenes_of_each": breaking_scenes,
        "demonstrations": len(_taught()),
        "rate_hz": TRIAL_HZ,
        "success_is": {
            "within_mm": 1000 * WITHIN_M,
            "for_s": FOR_S,
            "below_m_per_s": SLOW_MPS,
            "no_nearer_to_a_hand_than_m": NEAR_HAND_M,
            "when_faster_than_m_per_s": FAST_MPS,
        },
        "falsely_followed_is_farther_from_the_teacher_than_m": WRONG_M,
        "levels": LEVELS,
        "methods": {method: _of_method(method, rows) for method, rows in main.items()},
        "breaking": _breaking(by_task),
        "candidates": {
            f"{task.method} {PEOPLE_METHODS[task.method].candidates[task.candidate]!r}": summary(
                rows
            )
            for task, rows in usual.items()
            if group == "tuning" and task.method != TEACHER
        },
    }
    draw_numbers(results, numbers)
    return numbers


def tasks_of(options: Options, breaking_scenes: int) -> list[MethodTask]:
    """The tasks: the teacher, each method with its candidates, and each method in breaking
    scenes.
    """
    group = options.group
    people = max(2, round(PEOPLE_OF_GROUP[group] * options.share))
    has_candidates = group == "tuning" and options.share == 1
    tasks = [MethodTask(TEACHER, 0, group, "", people, SCENES_OF_GROUP[group], options.hands)]
    for method, entry in PEOPLE_METHODS.items():
        for number in range(len(entry.candidates) if has_candidates else 1):
            tasks.append(
                MethodTask(method, number, group, "", people, SCENES_OF_GROUP[group], options.hands)
            )
        for kind in BREAKING:
            tasks.append(MethodTask(method, 0, group, kind, 0, breaking_scenes, None))
    return [task._replace(first=options.seed_offset) for task in tasks]


def _say_better_candidates(results: Results, by_task: dict[MethodTask, list[TrialOutcome]]) -> None:
    """Report each method whose first candidate is not its best one."""
    for method, entry in PEOPLE_METHODS.items():
        compared = [
            rows for task, rows in by_task.items() if task.method == method and not task.kind
        ]
        if (best := chosen(compared)) > 0:
            results.say(
                f"{method}: {entry.candidates[best]} is better than what is chosen; put it first"
            )


def _breaking(by_task: dict[MethodTask, list[TrialOutcome]]) -> dict[str, dict[str, Any]]:
    """The figures of breaking scenes, by method and kind."""
    broken: dict[str, dict[str, Any]] = {method: {} for method in PEOPLE_METHODS}
    for task, rows in by_task.items():
        if task.kind:
            broken[task.method][task.kind] = _broken(rows)
    return broken


def _of_method(method: str, rows: Sequence[TrialOutcome]) -> dict[str, Any]:
    """The figures of a method, with its parameters."""
    if method == TEACHER:
        return summary(rows)
    return {"parameters": repr(PEOPLE_METHODS[method].candidates[0]), **summary(rows)}


MEASURES: dict[str, Callable[[TrialOutcome], float]] = {
    "success": lambda one: one.success,
    "success_on_the_way": lambda one: one.kept,
    "path_rms_mm": lambda one: one.path_mm,
    "held": lambda one: one.held,
    "falsely_held": lambda one: one.falsely_held,
    "falsely_followed": lambda one: one.falsely_followed,
    "negative_log_likelihood": lambda one: one.negative_log_likelihood,
    "inside_50": lambda one: one.inside[LEVELS.index(0.5)],
    "inside_95": lambda one: one.inside[LEVELS.index(0.95)],
    "delay_s": lambda one: one.delay_s,
    "tool_delay_s": lambda one: one.tool_delay_s,
    "too_near": lambda one: one.too_near,
}


def summary(rows: Sequence[TrialOutcome]) -> dict[str, Any]:
    """The mean of each measure with its 95 % interval by bootstrap over people, and more."""
    out: dict[str, Any] = {}
    for name, measure in MEASURES.items():
        mean, low, high = _resampled(rows, np.array([float(measure(row)) for row in rows]))
        out[name] = {"mean": mean, "low": low, "high": high}
    out["coverage"] = np.mean([row.inside for row in rows], axis=0).tolist()
    for name in ("predicted_mm", "error_mm"):
        out[f"{name[:-3]}_rms_mm"] = float(
            np.sqrt(np.mean([getattr(row, name) ** 2 for row in rows]))
        )
    out["events"] = [float(np.mean([row.events[i].reached for row in rows])) for i in range(3)]
    for name in ("error_mm", "true_error_mm"):
        out[f"event_{name}_median"] = [
            float(np.median([getattr(o.events[i], name) for o in rows])) for i in range(3)
        ]
    return out


def chosen(tried: Sequence[Sequence[TrialOutcome]]) -> int:
    """The chosen candidate: among those whose success is within SAME of the best, the one whose
    target is nearest to the teacher's tool.
    """
    success = [float(np.mean([row.success for row in rows])) for rows in tried]
    path = [float(np.mean([row.path_mm for row in rows])) for rows in tried]
    return min((p, i) for i, p in enumerate(path) if success[i] >= max(success) - SAME)[1]


def _resampled(rows: Sequence[TrialOutcome], values: Array) -> tuple[float, float, float]:
    """The mean of values (M,), and its 95 % interval by drawing people with replacement."""
    names = sorted({row.person for row in rows})
    index = np.array([names.index(row.person) for row in rows])
    total = np.bincount(index, values)
    count = np.bincount(index)
    drawn = np.random.default_rng(DRAWING).integers(len(names), size=(RESAMPLED, len(names)))
    means = total[drawn].sum(axis=1) / count[drawn].sum(axis=1)
    return float(values.mean()), float(np.percentile(means, 2.5)), float(np.percentile(means, 97.5))


def _broken(rows: Sequence[TrialOutcome]) -> dict[str, int]:
    """Successes, and failures in which the tool held during each missed event."""
    held = [
        not o.success and all(e.held for e in o.events if not e.reached) and not o.too_near
        for o in rows
    ]
    return {"successes": sum(row.success for row in rows), "held": sum(held), "of": len(rows)}


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers."""
    methods = numbers["methods"]
    plt = pyplot()
    figure, axes = plt.subplots(1, 4, figsize=(13.5, 4.8), width_ratios=(1.1, 1, 1, 1.3))
    labels = {
        TEACHER: "teacher who knows\nthe scene",
        **{name: entry.label for name, entry in PEOPLE_METHODS.items()},
    }
    colours = {TEACHER: "#444444", **dict.fromkeys(PEOPLE_METHODS, OTHER), "ours": ADAPTED}
    bars = (
        ("success", 100.0, "success [%]\n(dark: on the teacher's path throughout)"),
        ("path_rms_mm", 1.0, "distance of target and\nteacher's tool, rms [mm]"),
        ("falsely_followed", 100.0, "time falsely\nfollowed [%]"),
    )
    for ax, (name, scale, label) in zip(axes, bars, strict=False):
        for i, (method, scores) in enumerate(methods.items()):
            mean, low, high = (scale * scores[name][value] for value in ("mean", "low", "high"))
            dark = mean
            if name == "success":
                dark = scale * scores["success_on_the_way"]["mean"]
                ax.barh(i, mean, color=colours[method], height=0.65, alpha=0.4)
            ax.barh(i, dark, color=colours[method], height=0.65)
            ax.plot((low, high), (i, i), color="black", lw=1.2)
            ax.text(max(mean, high), i, f" {mean:.0f}", va="center", fontsize=8)
        ax.set(xlabel=label)
        ax.set_yticks(
            range(len(methods)),
            [labels[m] for m in methods] if ax is axes[0] else [""] * len(methods),
            fontsize=8,
        )
        ax.invert_yaxis()
    levels = 100 * np.array(LEVELS)
    axes[3].plot((0, 100), (0, 100), "--", color="black", lw=0.8)
    label_y = 104.0
    for method, scores in sorted(
        methods.items(), key=lambda item: -item[1].get("coverage", [0.0])[-1]
    ):
        if method != TEACHER:
            inside = 100 * np.array(scores["coverage"])
            axes[3].plot(
                levels,
                inside,
                "o-",
                ms=3,
                lw=1.2,
                color=colours[method],
                zorder=3 if method == "ours" else 2,
            )
            label_y = min(label_y - 4.5, inside[-1])  # below the one before it
            axes[3].annotate(
                labels[method].partition(",\n")[0].partition(":")[0].replace("\n", " "),
                (levels[-1], inside[-1]),
                (106, label_y),
                va="center",
                fontsize=7.5,
                color=colours[method],
                annotation_clip=False,
                arrowprops={
                    "arrowstyle": "-",
                    "lw": 0.6,
                    "color": colours[method],
                    "relpos": (0, 0.5),
                    "shrinkB": 2,
                },
            )
    axes[3].set(
        xlabel="nominal region [%]",
        ylabel="teacher's tool inside [%]",
        xlim=(0, 101),
        ylim=(0, 101),
    )
    people = numbers["people"]
    scenes = numbers["scenes_of_each"]
    figure.suptitle(
        f"{people} people who did not demonstrate, {people * scenes} scenes; lines: 95 % intervals"
    )
    results.figure(figure)
