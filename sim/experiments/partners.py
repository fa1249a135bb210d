"""What learned skills are worth where a third hand does something else than soldering: recordings
of real partners, and made tasks of eleven kinds. Ours beside its rivals, on takes left out.

Recordings are left out take by take, person by person, or in blocks. The made tasks are shown by
some people and done by others. A rival that is told the places knows as much as a skill between
them.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from service.contract.requests import TOLERANCE_M
from service.core.skill.model import LEVELS
from service.learning.judgement import Figures
from service.learning.learn import learn
from service.learning.skill_file import SkillError
from service.learning.via_points import adapted
from sim.experiments.left_out import JUDGED_HZ, Judged, LeftOut, judged, left_out, predicted, read
from sim.experiments.partner_rivals import RIVALS, left_out_by
from sim.experiments.results import ADAPTED, OTHER, REFERENCE, TOOL, ExperimentError, Options, Results, pyplot
from sim.experiments.seeds import BY_EXPERIMENT
from sim.experiments.workers import shared_out
from sim.made_tasks import TASK_KINDS, takes

SERVICE, TOLD = "service", ", told"
RECORDED = {  # the beginnings of the files' names
    "robot holds driver": ("robot_hold_driver",),
    "robot hands over plate": ("robot_hand_over_plate",),
    "robot hands over screw": ("robot_hand_over_screw",),
    "those three in one": ("robot_hold_driver", "robot_hand_over_plate", "robot_hand_over_screw"),
    "give": ("give",),
    "walk": ("walk",),
}
PEOPLE = ("give",)  # its groups are persons
NAMES_PLACES = ("give",)  # its takes begin and end at places that could be told
BLOCK = 9  # takes of `walk` that are left out together
SEEDS = BY_EXPERIMENT["partners"]
EACH = 2  # takes of a person
DEMONSTRATORS = len(SEEDS.learned[TASK_KINDS[0]].numbers)
SHOWN = {  # in the figure
    SERVICE: ("service", ADAPTED, "o"),
    "same elapsed time": ("same elapsed time", REFERENCE, "|"),
    "linear": ("linear", REFERENCE, "x"),
    "Gaussian process": ("Gaussian process", OTHER, "s"),
    "with 2 s of memory": ("Gaussian process with 2 s of memory", TOOL, "^"),
    "HMM over demonstrations": ("HMM over demonstrations", "#CC79A7", "D"),
}


class Part(NamedTuple):
    """What one process does at once: a set with what is left out of it; a group, or for a made kind
    nothing.
    """

    task: str
    out: str
    people: int
    data: Path | None


class Found(NamedTuple):
    """What each method's takes were judged, and what `learn` says of the skill, or why there is
    none.
    """

    judged: dict[str, list[Judged]]
    said: dict[str, dict[str, Any]]


@functools.lru_cache(maxsize=2)
def _takes(task: str, people: int, data: Path | None) -> tuple[list[LeftOut], list[LeftOut]]:
    """Takes to learn from, and those that are left out wherever they are not learned from."""
    if task in TASK_KINDS:
        groups = [
            [
                left_out(f"person {take.person} take {i % EACH}", "", take.demonstration)
                for i, take in enumerate(takes(task, people=stream.numbers[:people], each=EACH, seed=stream.seed))
            ]
            for stream in (SEEDS.learned[task], SEEDS.evaluation[task])
        ]
        return groups[0], groups[1]
    assert data is not None
    files = [path for path in sorted(data.glob("*.npz")) if path.name.startswith(RECORDED[task])]
    if len(files) < 2:
        raise ExperimentError(f"{len(files)} recordings of {task!r} in {data}: {RECORDED[task][0]}*.npz needed")
    found = [
        left_out(path.stem, group, read(path, named=task in NAMES_PLACES)._replace(person=group * (task in PEOPLE)))
        for path, group in ((path, _group(task, i, path.stem)) for i, path in enumerate(files))
    ]
    return found, found


def _group(task: str, number: int, name: str) -> str:
    if task == "give":
        return name.split("_")[1]
    return f"block {number // BLOCK}" if task == "walk" else name


def part(one: Part) -> Found:
    """What is found on one part."""
    shown, asked = _takes(one.task, one.people, one.data)
    if one.out:
        shown, asked = [t for t in shown if t.group != one.out], [t for t in asked if t.group == one.out]
    named = bool(shown[0].demonstration.places)
    found = Found({}, {})
    for told in [False] * (one.task not in TASK_KINDS) + [True] * named:
        ending = TOLD * told
        for name, rival in RIVALS.items():
            said = left_out_by(rival, shown, asked, told=told)
            found.judged[name + ending] = [judged(*pair) for pair in zip(asked, said, strict=True)]
        found.judged[SERVICE + ending], found.said[SERVICE + ending] = _service(shown, asked, told=told)
    return found


def _service(shown: Sequence[LeftOut], asked: Sequence[LeftOut], *, told: bool) -> tuple[list[Judged], dict[str, Any]]:
    """The service's skill of what is shown, which is told the places of each take or not."""
    demonstrations = [one.demonstration if told else one.demonstration._replace(places=()) for one in shown]
    try:
        skill = learn(demonstrations)
    except SkillError as error:
        return [], {"refused": [str(error)]}
    figures = msgspec.json.decode(skill.figures, type=Figures)
    said: dict[str, Any] = {
        "refused": [],
        "model": type(skill.model).__name__,
        "error_mm": figures.all.error_mm,
        "ambiguous": figures.ambiguous / 100,
        "unsafe": list(figures.unsafe),
        "warnings": list(figures.warnings),
    }
    out = []
    for take in asked:
        try:
            there = adapted(skill, take.demonstration.places, tolerance=TOLERANCE_M) if told else skill
        except SkillError as error:
            said["refused"].append(str(error))
            continue
        out.append(judged(take, predicted(there, take)))
    return out, said


def run(results: Results, options: Options) -> dict[str, Any]:
    """The numbers of all sets."""
    people = max(2, round(DEMONSTRATORS * options.share))
    parts = [Part(kind, "", people, None) for kind in TASK_KINDS[: max(2, round(len(TASK_KINDS) * options.share))]]
    if options.data is not None:
        for task in RECORDED:
            groups = sorted({take.group for take in _takes(task, 0, options.data)[0]})
            parts += [Part(task, out, 0, options.data) for out in groups[: max(2, round(len(groups) * options.share))]]
    else:
        results.say("made tasks alone: --data DIR adds recordings")
    by_task: dict[str, list[Found]] = {}
    for one, found in zip(parts, shared_out(part, parts, options.workers), strict=True):
        by_task.setdefault(one.task, []).append(found)
        ours = next(name for name in reversed(found.judged) if name.startswith(SERVICE))
        results.say(f"{one.task} {one.out}: {_line(found.judged[ours])}")
    numbers = {
        "judged_hz": JUDGED_HZ,
        "levels": LEVELS,
        "demonstrators": people,
        "takes_each": EACH,
        "tested_people": people,
        "recorded": {task: _numbers(by_task[task]) for task in RECORDED if task in by_task},
        "made": {kind: _numbers(by_task[kind]) for kind in TASK_KINDS if kind in by_task},
    }
    draw_numbers(results, numbers)
    return numbers


def _numbers(found: Sequence[Found]) -> dict[str, Any]:
    """The numbers of a set: of each method, and what `learn` says."""
    methods = list(found[0].judged)
    out: dict[str, Any] = {
        "folds": len(found),
        "methods": {name: summary([one for part in found for one in part.judged[name]]) for name in methods},
    }
    for name in (name for name in methods if name.startswith(SERVICE)):
        said = [part.said[name] for part in found]
        learned = [one for one in said if "model" in one]
        out["methods"][name] |= {
            "refuses": out["methods"]["mean" + name.removeprefix(SERVICE)]["takes"] - out["methods"][name]["takes"],
            "reasons": list(dict.fromkeys(reason for one in said for reason in one["refused"]))[:2],
            "model": learned[0]["model"] if learned else None,
            "learn_says_mm": float(np.mean([one["error_mm"] for one in learned])) if learned else None,
            "ambiguous": float(np.mean([one["ambiguous"] for one in learned])) if learned else None,
            "unsafe": sum(bool(one["unsafe"]) for one in learned),
            "says": [*learned[0]["unsafe"], *learned[0]["warnings"]] if learned else [],
        }
    return out


def summary(rows: Sequence[Judged]) -> dict[str, Any]:
    """Errors over all samples [mm], and shares of samples; none of no takes."""
    if not rows:
        return {"takes": 0}
    count = sum(one.samples for one in rows)
    inside = [one.inside for one in rows if one.inside is not None]
    held, unsure, told = (
        [x for x in column if x is not None] for column in zip(*((r.held, r.unsure, r.told) for r in rows), strict=True)
    )
    wrong = sum(one.wrong for one in rows)
    return {
        "takes": len(rows),
        "rms_mm": 1000 * float(np.sqrt(sum(one.squares for one in rows) / count)),
        "shifted_rms_mm": 1000 * float(np.sqrt(sum(one.shifted for one in rows) / count)),
        "shift_s": float(np.median([one.shift_s for one in rows])),
        "worst_mm": 1000 * max(one.worst_m for one in rows),
        "coverage": [float(x) / count for x in np.sum(inside, axis=0)] if inside else None,
        "held": sum(held) / count if held else None,
        "unsure": sum(unsure) / count if unsure else None,
        "wrong": wrong / count,
        "told": sum(told) / wrong if told and wrong else None,  # of the wrong ones, held or unsure
    }


def _line(rows: Sequence[Judged]) -> str:
    one = summary(rows)
    if not one["takes"]:
        return "refused"
    inside = [100 * one["coverage"][LEVELS.index(level)] for level in (0.5, 0.95)]
    return (
        f"{one['rms_mm']:.0f} mm, {one['shifted_rms_mm']:.0f} shifted, worst {one['worst_mm']:.0f}, "
        f"inside {inside[0]:.0f} {inside[1]:.0f} %, held {100 * one['held']:.0f} %, unsure {100 * one['unsure']:.0f} %"
        + ("" if one["told"] is None else f", told of {100 * one['told']:.0f} % of what is 10 cm wrong")
    )


def _label(name: str, methods: dict[str, Any], ending: str) -> str:
    """A set's name, and how often the service refuses."""
    ours = methods[SERVICE + ending]
    return name + f"\n(service refuses {ours['refuses']} of {ours['takes'] + ours['refuses']})" * bool(ours["refuses"])


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers."""
    plt = pyplot()
    panels = []
    for title, sets in (("recorded partners", numbers["recorded"]), ("made tasks, places told", numbers["made"])):
        rows = []
        for task, one in sets.items():
            endings = [ending for ending in ("", TOLD) if SERVICE + ending in one["methods"]]
            rows += [
                (task.replace("_", " ") + ending * (len(endings) > 1), one["methods"], ending) for ending in endings
            ]
        panels += [(title, rows)] if rows else []
    heights = [len(rows) for _, rows in panels]
    figure, axes = plt.subplots(
        len(panels), 1, figsize=(7.5, 1.6 + 0.36 * sum(heights)), height_ratios=heights, squeeze=False, sharex=True
    )
    for ax, (title, rows) in zip(axes[:, 0], panels, strict=True):
        for y, (_, methods, ending) in enumerate(rows):
            ax.axhline(y, color="#dddddd", lw=0.8, zorder=0)
            for name, (_, colour, marker) in SHOWN.items():
                ax.plot(methods[name + ending].get("rms_mm", np.nan), y, marker, color=colour, ms=5, ls="")
            ours = methods[SERVICE + ending]
            ax.plot(ours.get("shifted_rms_mm", np.nan), y, "o", mfc="none", color=ADAPTED, ms=6, ls="")
        ax.set_yticks(range(len(rows)), [_label(*row) for row in rows])
        ax.set(ylim=(len(rows) - 0.4, -0.6), xlim=(0, None))
        ax.set_title(title, loc="left", fontsize=9)
    for label, colour, marker in SHOWN.values():
        axes[0, 0].plot([], [], marker, color=colour, ms=5, ls="", label=label)
    axes[0, 0].plot([], [], "o", mfc="none", color=ADAPTED, ms=6, ls="", label="service, a time shift a take removed")
    axes[-1, 0].set_xlabel("tool's error on takes that were left out, rms [mm]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=8)
    results.figure(figure)
