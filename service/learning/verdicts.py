"""Verdicts on a skill: a table of rules with predicates, severities, texts and remedies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from service.contract.messages import BASE
from service.learning.baselines import SAME_TIME
from service.learning.choice import NOISE_M
from service.learning.gate import Gate
from service.learning.records import Figures, Row, Verdict

ADVISED = 5  # demonstrations
OUTLIER_TIMES, OUTLIER_MM = 2.5, 25.0  # an outlier's error is above this multiple of the median, and above this error
NOTED_MM, UNSAFE_MM = 50.0, 100.0  # limits of the held-out error
AMBIGUOUS, AMBIGUOUS_UNSAFE = 1.0, 10.0  # [%] limits of the samples that contradict others
BEYOND_UNSAFE = 20.0  # [%] limit of the tool's path that is out of reach
HELD, HELD_UNSAFE = 5.0, 20.0  # [%] limits of the time that the gate holds in demonstrations
CAUGHT, CAUGHT_UNSAFE = 95.0, 50.0  # [%] limits of the wrong samples that the gate must hold
COVERAGE = {"50": (30.0, 80.0), "95": (88.0, 100.0)}  # [%] ranges of the samples inside the regions of 50 and 95 %


WRONG, LEAST_TOLD = 0.5, 80.0  # [%] from this share of wrong samples on, the skill must be unsure at this share of them


class Subject(NamedTuple):
    """A skill's figures with what else is judged, and the part of it that a rule looks at."""

    figures: Figures
    gate: Gate
    frames: Sequence[str]  # all frames of the demonstrations, sorted
    contradiction: str  # the worst pair of samples, in words
    median_mm: float  # of the demonstrations' errors
    part: str = ""  # name of a demonstration, baseline, kind of wrong samples or region
    value: float = 0.0  # figure of the part

    @property
    def all(self) -> Row:
        """The figures of all demonstrations."""
        return self.figures.all

    def parts(self, of: str) -> Mapping[str, float]:
        """The names and figures of the parts of a kind; of the kind "" there is one."""
        found = self.figures
        if of == "demonstrations":
            return {row.name: row.error_mm for row in found.demonstrations}
        if of == "baselines":
            return found.all.other_mm
        if of == "regions":
            return {"50": found.all.within_50, "95": found.all.within_95}
        if of == "wrong samples" and found.alone is True:
            return {"the hand 30 cm beside": found.beside}
        return {"hands swapped": found.swapped, "hands 30 cm beside": found.beside} if of else {"": 0.0}


class Rule(NamedTuple):
    """A rule: the predicate of broken parts, the text with the fields of Subject as `s`, the
    predicate of unsafe parts, their remedy, and the kind of parts that the rule looks at.
    """

    is_broken: Callable[[Subject], bool]
    text: str
    is_unsafe: Callable[[Subject], bool] = lambda s: False
    remedy: str = ""
    of: str = ""


def _is_better(s: Subject) -> bool:
    """Return whether a baseline's error is smaller than the skill's, in whole millimetres."""
    return round(s.value) < round(s.all.error_mm)


def _is_timetable(s: Subject) -> bool:
    """Return whether elapsed time predicts the tool better than the hands, and best of all."""
    return (
        _is_better(s)
        and s.part == SAME_TIME
        and s.value <= min([*s.all.other_mm.values(), *s.figures.tried_mm.values()])
    )


RULES = (
    Rule(
        lambda s: len(s.frames) > 1,
        "the demonstrations are in different frames: {frames}; one needed",
        is_unsafe=lambda s: True,
    ),
    Rule(
        lambda s: len(s.frames) == 1 and s.frames[0] not in ("", BASE),
        f"the demonstrations are in frame {{frames}}: it is taken to be {BASE!r}, the arm's base plate",
    ),
    Rule(
        lambda s: len(s.figures.demonstrations) < 3,
        f"{{count}} demonstration(s) tell little of how sure the skill may be; {ADVISED} advised",
    ),
    Rule(
        lambda s: s.gate.floored or s.all.error_mm < 1000 * NOISE_M,
        "the demonstrations are more exact than any tracker: were they made, not taken? The gate allows for a "
        "tracker's noise, and is {s.figures.gate_mm:.1f} mm",
    ),
    Rule(
        lambda s: s.all.error_mm > NOTED_MM,
        "held-out demonstrations are missed by {s.all.error_mm:.0f} mm: where the hands are tells little of where the "
        f"tool is; up to {UNSAFE_MM:.0f} mm accepted",
        is_unsafe=lambda s: s.all.error_mm > UNSAFE_MM,
    ),
    Rule(
        lambda s: _is_better(s) and not _is_timetable(s),
        "{s.part}, held-out demonstrations are missed by less: {s.value:.0f} mm, not {s.all.error_mm:.0f}",
        of="baselines",
    ),
    Rule(
        _is_timetable,
        "the task is a timetable: where the tool was after as much time misses it by {s.value:.0f} mm, by the hands "
        "it is missed by {s.all.error_mm:.0f}",
        of="baselines",
    ),
    Rule(
        lambda s: len(s.figures.demonstrations) > 2 and s.value > max(OUTLIER_TIMES * s.median_mm, OUTLIER_MM),
        "{s.part} is unlike the others: missed by {s.value:.0f} mm, they by {s.median_mm:.0f}",
        of="demonstrations",
    ),
    Rule(
        lambda s: s.figures.ambiguous > AMBIGUOUS,
        f"{{s.figures.ambiguous:.0f}} % of the samples contradict others, up to {AMBIGUOUS_UNSAFE:.0f} % accepted: "
        "{s.contradiction}",
        is_unsafe=lambda s: s.figures.ambiguous > AMBIGUOUS_UNSAFE,
    ),
    Rule(
        lambda s: s.figures.beyond_reach > 0,
        f"{{s.figures.beyond_reach:.1f}} % of the tool's path is out of the arm's reach, up to {BEYOND_UNSAFE:.0f} % "
        "accepted: is it in metres, in frame base?",
        is_unsafe=lambda s: s.figures.beyond_reach > BEYOND_UNSAFE,
    ),
    Rule(
        lambda s: s.all.held > HELD,
        "the gate, kept low by {cause}, holds {s.all.held:.0f} % of what was demonstrated, up to "
        f"{HELD_UNSAFE:.0f} % accepted",
        is_unsafe=lambda s: s.all.held > HELD_UNSAFE,
    ),
    Rule(
        lambda s: s.value < CAUGHT_UNSAFE,
        f"the gate holds {{s.value:.1f}} % of {{s.part}}, at least {CAUGHT_UNSAFE:.0f} % needed",
        is_unsafe=lambda s: True,
        remedy=": take more demonstrations along the same paths, or name the places of the task (--places)",
        of="wrong samples",
    ),
    Rule(
        lambda s: CAUGHT_UNSAFE <= s.value < CAUGHT,
        f"the gate holds {{s.value:.1f}} % of {{s.part}}, {CAUGHT:.0f} % wanted",
        of="wrong samples",
    ),
    Rule(
        lambda s: not COVERAGE[s.part][0] <= s.value <= COVERAGE[s.part][1],
        "the {s.part} % regions hold {s.value:.0f} % of held-out samples",
        of="regions",
    ),
    Rule(
        lambda s: s.all.wrong > WRONG and s.all.told is not None and s.all.told < LEAST_TOLD,
        "{s.all.wrong:.1f} % of held-out samples are missed by more than 10 cm, and the skill is unsure at "
        f"{{s.all.told:.0f}} % of these, {LEAST_TOLD:.0f} % wanted",
    ),
)


def verdicts(subject: Subject) -> Iterator[Verdict]:
    """The verdicts of all rules, in their order."""
    words = {
        "count": len(subject.figures.demonstrations),
        "frames": ", ".join(map(repr, subject.frames)),
        "cause": "its ceiling" if subject.gate.capped else "nonsense beyond it",
    }
    for rule in RULES:
        for part, value in subject.parts(rule.of).items():
            s = subject._replace(part=part, value=value)
            if rule.is_broken(s):
                is_unsafe = rule.is_unsafe(s)
                text = rule.text.format(s=s, **words) + rule.remedy * is_unsafe
                yield Verdict("unsafe" if is_unsafe else "warning", text)
