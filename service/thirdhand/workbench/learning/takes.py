"""Takes: the demonstrations that are learned from, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kmp.criteria.errors import rms
from thirdhand.contract.records import SIDES
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
from thirdhand.workbench.learning.regions import REGION_BLOCKS

LEAST_COMPARED = 4  # among fewer takes, none counts as standing out
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
    _check_options(demonstrations, options, is_refined=bool(refined))
    in_order = _in_order(demonstrations, names)
    for entry in in_order:
        _check(entry)

    new, earlier, repeats = _without_repeats(in_order, refined)
    _check_new(new, options, repeats)
    conductor = _conductor([*new, *earlier])
    if conductor is not None:
        new, earlier = ([_of_one(entry, conductor) for entry in part] for part in (new, earlier))
    new_demonstrations, new_names = _columns(new)
    earlier_demonstrations, earlier_names = _columns(earlier)
    method = method_of([*new_demonstrations, *earlier_demonstrations], options)
    if options.delay_s is not None and not isinstance(method, Segmented):
        raise SkillError(
            "a delay goes with via-points that all demonstrations name; without them it is learned "
            "too"
        )
    if earlier:
        _check_alike(new, [point.name for point in earlier_demonstrations[0].via_points])

    takes = takes_of(new_demonstrations, new_names)
    first_earlier = 1 + max(take.person for take in takes)
    single = (
        "one demonstration: none was held out, so its error is of what was learned, and judges "
        "nothing"
    )
    return Division(
        takes,
        [
            take._replace(person=first_earlier + take.person)
            for take in takes_of(earlier_demonstrations, earlier_names)
        ],
        method,
        options,
        same_hands_m(new_demonstrations),
        conductor,
        repeats,
        [*repeats, *[single] * (len(new) == 1)],
    )


def _check_options(
    demonstrations: Sequence[Demonstration], options: Options, *, is_refined: bool
) -> None:
    """Raise SkillError for options that exclude each other, or without demonstrations."""
    if is_refined and (options.components is not None or options.ell is not None):
        raise SkillError(
            "a skill is refined with parameters that are chosen: neither a number of components "
            "nor ell"
        )
    if not demonstrations:
        raise SkillError("no demonstrations given, at least 1 needed")
    if options.components is None and options.penalty is not None:
        raise SkillError("a penalty goes with a number of components: without them it is chosen")


def _in_order(
    demonstrations: Sequence[Demonstration], names: Sequence[str]
) -> list[NamedDemonstration]:
    """The demonstrations in the order of recording, so that the order of the files makes no
    difference.
    """
    names = names or [f"demonstration {i + 1}" for i in range(len(demonstrations))]
    return sorted(
        [NamedDemonstration(*pair) for pair in zip(names, demonstrations, strict=True)],
        key=lambda entry: (int(entry.demonstration.stamps_ns[0]), entry.name),
    )


def _check(entry: NamedDemonstration) -> None:
    """Raise SkillError, with the name, for a demonstration that cannot be learned from."""
    try:
        check(entry.demonstration)
    except SkillError as error:
        raise SkillError(f"{entry.name}: {error}") from None


def _without_repeats(
    demonstrations: Sequence[NamedDemonstration], refined: Sequence[NamedDemonstration]
) -> tuple[list[NamedDemonstration], list[NamedDemonstration], list[str]]:
    """The new demonstrations and the earlier ones, which are by other persons, without those that
    repeat another; and remarks on these.
    """
    named = [*refined, *demonstrations]
    repeats = _repeats([entry.demonstration for entry in named])
    remarks = [
        f"{named[i].name} repeats {named[j].name}, and is left out" for i, j in repeats.items()
    ]
    new_persons = {entry.demonstration.person for entry in demonstrations} - {""}
    new = list[NamedDemonstration]()
    earlier = list[NamedDemonstration]()
    for i, entry in enumerate(named):
        is_earlier = i < len(refined) and entry.demonstration.person not in new_persons
        if i not in repeats:
            (earlier if is_earlier else new).append(entry)
    return new, earlier, remarks


def _check_new(
    demonstrations: Sequence[NamedDemonstration], options: Options, repeats: Sequence[str]
) -> None:
    """Raise SkillError if the new demonstrations that repeat no other are too few, or show no
    motion.
    """
    if not demonstrations:
        raise SkillError(
            "all demonstrations repeat those of the skill that is refined: there is nothing new to "
            "learn"
        )
    if max(moved_m(entry.demonstration) for entry in demonstrations) < LEAST_M:
        raise SkillError(
            f"demonstrations in which hands or tool move by less than {1000 * LEAST_M:.0f} mm "
            "teach nothing"
        )
    names = [entry.name for entry in demonstrations]
    check_count(names, options.components, "".join(f"; {remark}" for remark in repeats))


def _columns(named: Sequence[NamedDemonstration]) -> tuple[list[Demonstration], list[str]]:
    return [entry.demonstration for entry in named], [entry.name for entry in named]


def _check_alike(demonstrations: Sequence[NamedDemonstration], needed: Sequence[str]) -> None:
    """Raise SkillError if new demonstrations name other via-points than the refined skill's, which
    are needed.
    """
    for name, demonstration in demonstrations if needed else ():
        own_names = [point.name for point in demonstration.via_points]
        if set(own_names) != set(needed):
            present = ", ".join(own_names) or "(none)"
            raise SkillError(
                f"{name} has the via-points {present}: {', '.join(needed)} needed, as in the skill "
                "that is refined; take them with the demonstration (record --via-points), or name "
                "them (--via-points)"
            )


def _conductor(demonstrations: Sequence[NamedDemonstration]) -> int | None:
    """The side of the hand that conducts all demonstrations alone; None if both hands do. Raises
    SkillError if they differ.
    """
    by_hand: dict[str, list[str]] = {}
    for name, demonstration in demonstrations:
        by_hand.setdefault(demonstration.conducts, []).append(name)
    if len(by_hand) > 1:
        groups = "; ".join(f"{hand}: {', '.join(by_hand[hand])}" for hand in sorted(by_hand))
        raise SkillError(
            f"demonstrations that are conducted by different hands: {', '.join(sorted(by_hand))}; "
            f"take them alike, or leave out those of one kind ({groups})"
        )
    (hand,) = by_hand
    return None if hand == "both" else SIDES.index(hand)


def _of_one(entry: NamedDemonstration, conductor: int) -> NamedDemonstration:
    """The demonstration with via-points of the hand that conducts alone."""
    via_points = tuple(of_one(point, conductor) for point in entry.demonstration.via_points)
    return entry._replace(demonstration=entry.demonstration._replace(via_points=via_points))


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
    if count > REGION_BLOCKS:
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
        dealt = sorted(range(count), key=lambda rank: (rank % REGION_BLOCKS, rank))
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
    median, and above UNSURE_M. None stands out among fewer than LEAST_COMPARED takes, or if more
    than a third would.
    """
    errors_m = {result.take.name: rms(result.errors) for result in held_out}
    limit_m = max(UNSURE_M, STANDS_OUT_TIMES * float(np.median(list(errors_m.values()))))
    out = {name: error_m for name, error_m in errors_m.items() if error_m > limit_m}
    return out if len(errors_m) >= LEAST_COMPARED and 3 * len(out) <= len(errors_m) else {}


def _repeats(demonstrations: Sequence[Demonstration]) -> dict[int, int]:
    """The demonstrations that repeat an earlier one, at any sampling rate, and which one."""
    paths = np.empty((len(demonstrations), COMPARED_TIMES, 9))
    out: dict[int, int] = {}
    for i, demonstration in enumerate(demonstrations):
        motion = np.hstack([demonstration.hands, demonstration.tool[:, :3]])
        grid = np.linspace(0.0, 1.0, COMPARED_TIMES)
        shares = np.linspace(0.0, 1.0, len(motion))
        paths[i] = np.stack([np.interp(grid, shares, column) for column in motion.T], axis=1)
        squares = ((paths[:i] - paths[i]) ** 2).sum(axis=2).mean(axis=1)
        twins = [j for j in np.flatnonzero(squares < REPEATED_M**2).tolist() if j not in out]
        if twins:
            out[i] = twins[0]
    return out
