"""Takes: the demonstrations that are learned from, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kmp.criteria.cross_validation import rms
from service.contract.records import SIDES
from service.contract.requests import Hands
from service.core.frame import Vector
from service.learning.ambiguity import same_hands_m
from service.learning.demonstration import LEAST_M, Demonstration, check, moved_m, persons
from service.learning.methods import Method, method_of
from service.learning.records import Fitted, Options, Take
from service.learning.skill_file import SkillError
from service.learning.via_points import of_one

COMPARED_TIMES = 100  # shares of the duration at which demonstrations are compared
REPEATED_M = 0.003  # demonstrations with a smaller root mean square distance are the same one


class Division(NamedTuple):
    """Takes, with the method to learn from them."""

    takes: Sequence[Take]
    method: Method
    options: Options
    near_m: float  # hands up to this distance are the same for the tracker
    conductor: int | None  # the side of the hand that conducts alone; None if both do
    repeats: Sequence[str]  # remarks about demonstrations that repeat another
    remarks: Sequence[str]  # all remarks


def divided(demonstrations: Sequence[Demonstration], names: Sequence[str], options: Options) -> Division:
    """The takes of the demonstrations that repeat no other, by `names` or, if there are none, by
    numbers.

    Raises SkillError if nothing can be learned from them.
    """
    if not demonstrations:
        raise SkillError("no demonstrations given, at least 1 needed")
    if options.components is None and options.penalty is not None:
        raise SkillError("a penalty goes with a number of components: without them it is chosen")
    names = list(names) or [f"demonstration {i + 1}" for i in range(len(demonstrations))]
    for name, one in zip(names, demonstrations, strict=True):
        try:
            check(one)
        except SkillError as error:
            raise SkillError(f"{name}: {error}") from None
    repeats = _repeats(demonstrations)
    kept = [i for i in range(len(demonstrations)) if i not in repeats]
    repeated = [f"{names[i]} repeats {names[j]}, and is left out" for i, j in repeats.items()]
    demonstrations, names = [demonstrations[i] for i in kept], [names[i] for i in kept]
    if max(map(moved_m, demonstrations)) < LEAST_M:
        raise SkillError(
            f"demonstrations in which hands or tool move by less than {1000 * LEAST_M:.0f} mm teach nothing"
        )
    check_count(names, options.components, "".join(f"; {remark}" for remark in repeated))
    single = "one demonstration: none was held out, so its error is of what was learned, and judges nothing"
    remarks = [*repeated, *[single] * (len(names) == 1)]
    hand = _conducting(demonstrations, names)
    conductor = None if hand == "both" else SIDES.index(hand)
    if conductor is not None:
        demonstrations = [
            one._replace(places=tuple(of_one(point, conductor) for point in one.places)) for one in demonstrations
        ]
    method = method_of(demonstrations, options)
    takes = takes_of(demonstrations, names)
    return Division(takes, method, options, same_hands_m(demonstrations), conductor, repeated, remarks)


def _conducting(demonstrations: Sequence[Demonstration], names: Sequence[str]) -> Hands:
    """The hands that conduct all demonstrations. Raises SkillError if they differ."""
    by_hand: dict[str, list[str]] = {}
    for name, one in zip(names, demonstrations, strict=True):
        by_hand.setdefault(one.conducts, []).append(name)
    if len(by_hand) > 1:
        which = "; ".join(f"{hand}: {', '.join(by_hand[hand])}" for hand in sorted(by_hand))
        raise SkillError(
            f"demonstrations that are conducted by different hands: {', '.join(sorted(by_hand))}; take them alike, or "
            f"leave out those of one kind ({which})"
        )
    return demonstrations[0].conducts


def conductor_of(division: Division, fitted: Fitted) -> int | None:
    """The side of the only hand that the tool depends on; None if it depends on both."""
    return division.conductor if fitted.conductor is None else fitted.conductor


def check_count(names: Sequence[str], components: int | None, remark: str = "") -> None:
    """Raise SkillError if the demonstrations of these names are too few to hold one out."""
    if len(names) == 1 and components is None:
        raise SkillError(
            f"1 demonstration given ({names[0]}): at least 2 needed, as what is learned from the others must predict "
            "each; record another. Only the paper's method, --components 10, learns from a single one, and its error "
            f"stays unknown{remark}"
        )


def takes_of(demonstrations: Sequence[Demonstration], names: Sequence[str]) -> list[Take]:
    """The takes of demonstrations."""
    return [
        Take(name, person, one, one.hands, one.tool, one.gripper)
        for name, person, one in zip(names, persons(demonstrations), demonstrations, strict=True)
    ]


def _repeats(demonstrations: Sequence[Demonstration]) -> dict[int, int]:
    """The demonstrations that repeat an earlier one, at any sampling rate, and which one."""
    paths: list[Vector] = []
    out: dict[int, int] = {}
    for i, one in enumerate(demonstrations):
        both = np.hstack([one.hands, one.tool[:, :3]])
        at, known = np.linspace(0.0, 1.0, COMPARED_TIMES), np.linspace(0.0, 1.0, len(both))
        paths.append(np.stack([np.interp(at, known, column) for column in both.T], axis=1))
        twins = (j for j in range(i) if j not in out and rms(paths[i] - paths[j]) < REPEATED_M)
        if (twin := next(twins, None)) is not None:
            out[i] = twin
    return out
