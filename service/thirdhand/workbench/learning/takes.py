"""Takes: the demonstrations that are learned from, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kmp.criteria.cross_validation import rms
from thirdhand.contract.records import SIDES
from thirdhand.contract.requests import Hands
from thirdhand.core.frame import Vector
from thirdhand.core.skill.tuning import UNSURE_M
from thirdhand.skills.demonstration import (
    LEAST_M,
    Demonstration,
    NamedDemonstration,
    check,
    moved_m,
    persons,
)
from thirdhand.skills.skill_file import SkillError
from thirdhand.skills.via_points import of_one
from thirdhand.workbench.learning.ambiguity import same_hands_m
from thirdhand.workbench.learning.methods import Method, method_of
from thirdhand.workbench.learning.methods.segmented import Segmented
from thirdhand.workbench.learning.records import Fitted, HeldOut, Options, Take
from thirdhand.workbench.learning.regions import BLOCKS

LEAST_COMPARED = 4  # takes: among fewer, none counts as standing out
STANDS_OUT_TIMES = 4.0
COMPARED_TIMES = 100  # shares of the duration at which demonstrations are compared
REPEATED_M = 0.003  # demonstrations with a smaller root mean square distance are the same one


class Division(NamedTuple):
    """Takes, with the method to learn from them. Those of a skill that is refined are `earlier`."""

    takes: Sequence[Take]
    earlier: Sequence[Take]
    method: Method
    options: Options
    near_m: float  # hands up to this distance are the same for the tracker
    conductor: int | None  # the side of the hand that conducts alone; None if both do
    repeats: Sequence[str]  # remarks about demonstrations that repeat another
    remarks: Sequence[str]  # all remarks


def divided(
    demonstrations: Sequence[Demonstration],
    names: Sequence[str],
    options: Options,
    refined: Sequence[NamedDemonstration] = (),
) -> Division:
    """The takes of the demonstrations that repeat no other, by `names` or, if there are none, by
    numbers.

    `refined` are the demonstrations of a skill that is refined. Those by the persons of the new
    ones count as new ones. Raises SkillError if nothing can be learned from them.
    """
    if refined and (options.components is not None or options.ell is not None):
        raise SkillError(
            "a skill is refined with parameters that are chosen: neither a number of components "
            "nor ell"
        )
    if not demonstrations:
        raise SkillError("no demonstrations given, at least 1 needed")
    if options.components is None and options.penalty is not None:
        raise SkillError("a penalty goes with a number of components: without them it is chosen")
    names = list(names) or [f"demonstration {i + 1}" for i in range(len(demonstrations))]
    # In the order of recording, so that the order of the files makes no difference.
    in_order = sorted(
        zip(names, demonstrations, strict=True), key=lambda one: (int(one[1].stamps_ns[0]), one[0])
    )
    names = [name for name, _ in in_order]
    demonstrations = [demonstration for _, demonstration in in_order]
    for name, demonstration in zip(names, demonstrations, strict=True):
        try:
            check(demonstration)
        except SkillError as error:
            raise SkillError(f"{name}: {error}") from None
    named = [*refined, *map(NamedDemonstration, names, demonstrations)]
    repeats = _repeats([entry.demonstration for entry in named])
    repeated = [
        f"{named[i].name} repeats {named[j].name}, and is left out" for i, j in repeats.items()
    ]
    new_persons = {demonstration.person for demonstration in demonstrations if demonstration.person}
    of_others = [
        i for i, entry in enumerate(refined) if entry.demonstration.person not in new_persons
    ]
    earlier = [named[i] for i in of_others if i not in repeats]
    names, demonstrations = _columns(
        [entry for i, entry in enumerate(named) if i not in {*repeats, *of_others}]
    )
    if not demonstrations:
        raise SkillError(
            "all demonstrations repeat those of the skill that is refined: there is nothing new to "
            "learn"
        )
    if max(map(moved_m, demonstrations)) < LEAST_M:
        raise SkillError(
            f"demonstrations in which hands or tool move by less than {1000 * LEAST_M:.0f} mm "
            "teach nothing"
        )
    check_count(names, options.components, "".join(f"; {remark}" for remark in repeated))
    before_names, before = _columns(earlier)
    single = (
        "one demonstration: none was held out, so its error is of what was learned, and judges "
        "nothing"
    )
    remarks = [*repeated, *[single] * (len(names) == 1)]
    hand = _conducting([*demonstrations, *before], [*names, *before_names])
    conductor = None if hand == "both" else SIDES.index(hand)
    if conductor is not None:
        demonstrations, before = (
            [
                demonstration._replace(
                    via_points=tuple(of_one(point, conductor) for point in demonstration.via_points)
                )
                for demonstration in subset
            ]
            for subset in (demonstrations, before)
        )
    method = method_of([*demonstrations, *before], options)
    if options.delay_s is not None and not isinstance(method, Segmented):
        raise SkillError(
            "a delay goes with via-points that all demonstrations name; without them it is learned "
            "too"
        )
    if before:
        _check_alike(demonstrations, names, before)
    takes = takes_of(demonstrations, names)
    first = 1 + max(take.person for take in takes)
    before_takes = [
        take._replace(person=first + take.person) for take in takes_of(before, before_names)
    ]
    return Division(
        takes,
        before_takes,
        method,
        options,
        same_hands_m(demonstrations),
        conductor,
        repeated,
        remarks,
    )


def _columns(named: Sequence[NamedDemonstration]) -> tuple[list[str], list[Demonstration]]:
    return [entry.name for entry in named], [entry.demonstration for entry in named]


def _check_alike(
    demonstrations: Sequence[Demonstration], names: Sequence[str], earlier: Sequence[Demonstration]
) -> None:
    """Raise SkillError if new demonstrations name other via-points than the refined skill's."""
    needed = [point.name for point in earlier[0].via_points]
    if not needed:
        return
    for name, demonstration in zip(names, demonstrations, strict=True):
        own_names = [point.name for point in demonstration.via_points]
        if set(own_names) != set(needed):
            present = ", ".join(own_names) or "(none)"
            raise SkillError(
                f"{name} has the via-points {present}: {', '.join(needed)} needed, as in the skill "
                "that is refined; take them with the demonstration (record --via-points), or name "
                "them (--via-points)"
            )


def _conducting(demonstrations: Sequence[Demonstration], names: Sequence[str]) -> Hands:
    """The hands that conduct all demonstrations. Raises SkillError if they differ."""
    by_hand: dict[str, list[str]] = {}
    for name, demonstration in zip(names, demonstrations, strict=True):
        by_hand.setdefault(demonstration.conducts, []).append(name)
    if len(by_hand) > 1:
        groups = "; ".join(f"{hand}: {', '.join(by_hand[hand])}" for hand in sorted(by_hand))
        raise SkillError(
            f"demonstrations that are conducted by different hands: {', '.join(sorted(by_hand))}; "
            f"take them alike, or leave out those of one kind ({groups})"
        )
    return demonstrations[0].conducts


def conductor_of(division: Division, fitted: Fitted) -> int | None:
    """The side of the only hand that the tool depends on; None if it depends on both."""
    return division.conductor if fitted.conductor is None else fitted.conductor


def check_count(names: Sequence[str], components: int | None = None, remark: str = "") -> None:
    """Raise SkillError if the demonstrations of these names are too few to hold one out."""
    if len(names) == 1 and components is None:
        raise SkillError(
            f"1 demonstration given ({names[0]}): at least 2 needed, as what is learned from the "
            f"others must predict each; record another{remark}"
        )


def takes_of(demonstrations: Sequence[Demonstration], names: Sequence[str]) -> list[Take]:
    """The takes of demonstrations.

    Persons are numbered so that consecutive numbers, which are held out at once, have tools all
    along the path of the task: in the order of their mean tool along the axis on which these vary
    most, dealt to BLOCKS blocks in turn.
    """
    person_of = persons(demonstrations)
    count = max(person_of, default=-1) + 1
    number_of = list(range(count))
    if count > BLOCKS:
        means_m = np.zeros((count, 3))
        for person in range(count):
            theirs = [
                demonstration
                for demonstration, number in zip(demonstrations, person_of, strict=True)
                if number == person
            ]
            means_m[person] = np.mean(
                [demonstration.tool[:, :3].mean(axis=0) for demonstration in theirs], axis=0
            )
        along = np.argsort(means_m[:, means_m.var(axis=0).argmax()], kind="stable").tolist()
        dealt = sorted(range(count), key=lambda rank: (rank % BLOCKS, rank))
        for number, rank in enumerate(dealt):
            number_of[along[rank]] = number
    return [
        Take(
            name,
            number_of[person],
            demonstration,
            demonstration.hands,
            demonstration.tool,
            demonstration.gripper,
        )
        for name, person, demonstration in zip(names, person_of, demonstrations, strict=True)
    ]


def standing_out(held_out: Sequence[HeldOut]) -> dict[str, float]:
    """The held-out errors [m] of the takes that stand out, by name: above STANDS_OUT_TIMES the
    median, and above UNSURE_M; none of fewer than LEAST_COMPARED takes, or of more than a third.
    """
    errors_m = {result.take.name: rms(result.errors) for result in held_out}
    limit_m = max(UNSURE_M, STANDS_OUT_TIMES * float(np.median(list(errors_m.values()))))
    out = {name: error_m for name, error_m in errors_m.items() if error_m > limit_m}
    return out if len(errors_m) >= LEAST_COMPARED and 3 * len(out) <= len(errors_m) else {}


def _repeats(demonstrations: Sequence[Demonstration]) -> dict[int, int]:
    """The demonstrations that repeat an earlier one, at any sampling rate, and which one."""
    paths: list[Vector] = []
    out: dict[int, int] = {}
    for i, demonstration in enumerate(demonstrations):
        motion = np.hstack([demonstration.hands, demonstration.tool[:, :3]])
        grid = np.linspace(0.0, 1.0, COMPARED_TIMES)
        shares = np.linspace(0.0, 1.0, len(motion))
        paths.append(np.stack([np.interp(grid, shares, column) for column in motion.T], axis=1))
        twins = (j for j in range(i) if j not in out and rms(paths[i] - paths[j]) < REPEATED_M)
        if (twin := next(twins, None)) is not None:
            out[i] = twin
    return out
