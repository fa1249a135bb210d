"""Verdicts on a skill: a table of rules with predicates, severities, texts and remedies.

A skill is unsafe if the service cannot make it safe: its tool is out of reach, or the hands do not
determine the tool. A residual risk remains after all measures of the service, such as errors that
the skill does not tell: a person may accept it (ISO 12100). A skill that holds often is a nuisance
and no danger, so this is a warning; so is a gate through which hands pass that are far beside those
of the task, because no gate on positions can hold what demonstrations show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from thirdhand.contract.messages import BASE
from thirdhand.workbench.learning.baselines import SAME_TIME
from thirdhand.workbench.learning.choice import ADVISED, NOISE_M
from thirdhand.workbench.learning.gate import Gate
from thirdhand.workbench.learning.records import Figures, Row, Severity, Verdict

# an outlier's error is above this multiple of the median, and above this error
OUTLIER_TIMES = 2.5
OUTLIER_MM = 25.0
# limits of the held-out error
NOTED_MM = 50.0
RESIDUAL_MM = 100.0
WELL_EXPLAINED = 80.0  # [%] of the tool's variance: below, the hands leave much of it open
PEOPLE_TIMES = 2.0  # people differ if the largest error of one is this multiple of the least
# [%] of the tool's variance: if the hands explain less, the mean position predicts nearly as well
EXPLAINED = 50.0
# [%] limits of the samples that contradict others
MAX_AMBIGUOUS = 1.0
AMBIGUOUS_RESIDUAL = 10.0
AMBIGUOUS_UNSAFE = 20.0
BEYOND_UNSAFE = 20.0  # [%] limit of the tool's path that is out of reach
MAX_HELD = 5.0  # [%] limit of the time that the gate holds in demonstrations
CAUGHT = 95.0  # [%] of the wrong samples that the gate must hold
# [%] ranges of the samples inside the regions of 50 and 95 %
COVERAGE = {
    "50": (30.0, 80.0),
    "95": (88.0, 100.0),
}


# [%] from this share of wrong samples on, the skill must be unsure at this share of them
WRONG = 0.5
LEAST_TOLD = 80.0
UNTOLD_RESIDUAL = 1.0  # [%] limit of the samples at which the skill is wrong and not unsure


class Subject(NamedTuple):
    """A skill's figures and other data for the rules, and the part that a rule judges."""

    figures: Figures
    gate: Gate
    frames: Sequence[str]  # all frames of the demonstrations, sorted
    contradiction: str  # the worst pair of samples, in words
    median_mm: float  # of the demonstrations' errors
    scatter_mm: float  # of the tool around its mean position, root mean square
    part: str = ""  # name of a demonstration, baseline, kind of wrong samples or region
    value: float = 0.0  # figure of the part

    @property
    def all(self) -> Row:
        """The figures of all demonstrations."""
        return self.figures.all

    def parts(self, of: str) -> Mapping[str, float]:
        """The names and figures of the parts of a kind; of the kind "" there is one."""
        figures = self.figures
        if of == "demonstrations":
            return {row.name: row.error_mm for row in figures.demonstrations}
        if of == "baselines":
            return figures.all.other_mm
        if of == "regions":
            return {"50": figures.all.within_50, "95": figures.all.within_95}
        if of == "wrong samples" and figures.alone is True:
            return {"the hand 30 cm beside": figures.beside}
        return (
            {"hands swapped": figures.swapped, "hands 30 cm beside": figures.beside}
            if of
            else {"": 0.0}
        )


MORE = "; more demonstrations along the same paths, or named via-points (record --via-points), help"


class Rule(NamedTuple):
    """A rule: the predicate of broken parts, the text with the fields of Subject as `s`, the
    severity of a broken part, the remedy, and the kind of parts that the rule looks at.
    """

    is_broken: Callable[[Subject], bool]
    text: str
    severity: Callable[[Subject], Severity] = lambda s: "warning"
    remedy: str = MORE
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


def _is_unexplained(s: Subject) -> bool:
    """Return whether the hands explain too little of the tool's motion."""
    explained = s.figures.explained
    return s.all.error_mm > NOTED_MM and explained is not None and explained < EXPLAINED


def _untold(s: Subject) -> float:
    """The share [%] of the samples at which the skill is wrong and not unsure."""
    return s.all.wrong * (1.0 - (s.all.told or 0.0) / 100.0)


def _of_contradictions(s: Subject) -> Severity:
    """The severity of samples that contradict others, by their share."""
    if s.figures.ambiguous > AMBIGUOUS_UNSAFE:
        return "unsafe"
    return "residual" if s.figures.ambiguous > AMBIGUOUS_RESIDUAL else "warning"


RULES = (
    Rule(
        lambda s: len(s.frames) > 1,
        "the demonstrations are in different frames: {frames}; one needed",
        severity=lambda s: "unsafe",
        remedy=": record them again in one frame, or learn from those of one frame",
    ),
    Rule(
        lambda s: len(s.frames) == 1 and s.frames[0] not in ("", BASE),
        f"the demonstrations are in frame {{frames}}: it is taken to be {BASE!r}, the arm's base "
        "plate",
        remedy=". If it is not, name the cell that maps this frame (--config)",
    ),
    Rule(
        lambda s: len(s.figures.demonstrations) < 3,
        f"{{count}} demonstration(s) are too few to estimate the skill's errors; {ADVISED} or more "
        "advised",
        severity=lambda s: (
            "unsafe"
            if len(s.figures.demonstrations) > 1 and s.all.error_mm > NOTED_MM
            else "warning"
        ),
        remedy=", as they miss each other by {s.all.error_mm:.0f} mm: record more",
    ),
    Rule(
        lambda s: s.gate.floored or s.all.error_mm < 1000 * NOISE_M,
        "the demonstrations have less noise than any tracker: were they computed? The gate allows "
        "for a tracker's noise, and is {s.figures.gate_mm:.1f} mm",
        remedy=(
            ". If they were recorded, nothing is wrong; learn what is to be served from recordings "
            "of the tracker"
        ),
    ),
    Rule(
        _is_unexplained,
        "the hands explain too little of the tool's motion: {s.figures.explained:.0f} % of its "
        f"variance in held-out demonstrations, at least {EXPLAINED:.0f} % needed; the error is "
        "{s.all.error_mm:.0f} mm",
        severity=lambda s: "unsafe",
        remedy=": name the via-points of the task (record --via-points, learn --via-points), let "
        "the hands lead the tool in each demonstration, or record more that are alike",
    ),
    Rule(
        lambda s: s.all.error_mm > NOTED_MM and not _is_unexplained(s),
        f"held-out demonstrations are missed by {{s.all.error_mm:.0f}} mm, up to {RESIDUAL_MM:.0f} "
        "mm accepted",
        severity=lambda s: "residual" if s.all.error_mm > RESIDUAL_MM else "warning",
    ),
    Rule(
        lambda s: _is_better(s) and not _is_timetable(s),
        "a simpler prediction is better: the error of {s.part!r} is {s.value:.0f} mm, not "
        "{s.all.error_mm:.0f}",
        remedy=". The hands say less about the tool than it seems, or the demonstrations are too "
        "few: name the via-points of the task (record --via-points), or record more",
        of="baselines",
    ),
    Rule(
        _is_timetable,
        "the task is a timetable: the elapsed time predicts the tool with an error of "
        "{s.value:.0f} mm, the hands with {s.all.error_mm:.0f} mm",
        remedy=". Keep to the pace of the demonstrations, or let the hands lead the tool in each "
        "of them",
        of="baselines",
    ),
    Rule(
        lambda s: (
            len(s.figures.demonstrations) > 2
            and s.value > max(OUTLIER_TIMES * s.median_mm, OUTLIER_MM)
        ),
        "{s.part} differs from the others: its error is {s.value:.0f} mm, the median "
        "{s.median_mm:.0f} mm",
        remedy=": look at it (record NAME --show), and leave it out or record it again if it is "
        "wrong",
        of="demonstrations",
    ),
    Rule(
        lambda s: s.figures.ambiguous > MAX_AMBIGUOUS,
        "{s.figures.ambiguous:.0f} % of the samples contradict others, up to "
        f"{AMBIGUOUS_RESIDUAL:.0f} % accepted: {{s.contradiction}}",
        severity=_of_contradictions,
        remedy=". Leave out the demonstration that differs, or name the via-points between which "
        "the hands come by the same position twice (record --via-points, learn --via-points)",
    ),
    Rule(
        lambda s: s.figures.beyond_reach > 0,
        "{s.figures.beyond_reach:.1f} % of the tool's path is out of the arm's reach, up to "
        f"{BEYOND_UNSAFE:.0f} % accepted: is it in metres, in frame base?",
        severity=lambda s: "unsafe" if s.figures.beyond_reach > BEYOND_UNSAFE else "warning",
        remedy=" If it is, demonstrate nearer to the arm, move the arm, or name the cell of a "
        "longer one (--config)",
    ),
    Rule(
        lambda s: s.all.held > MAX_HELD,
        "the gate holds {s.all.held:.0f} % of what was demonstrated, and cannot be higher: {cause}",
    ),
    Rule(
        lambda s: s.gate.capped,
        "hands are followed up to the largest deviation that is allowed, {s.figures.gate_mm:.0f} "
        "mm: the demonstrations differ too much for a smaller one",
        severity=lambda s: "residual",
    ),
    Rule(
        lambda s: s.all.predicted_mm > s.scatter_mm > 0.0,
        "the skill expects an error of {s.all.predicted_mm:.0f} mm, more than the tool moves about "
        "its mean position, {s.scatter_mm:.0f} mm",
        severity=lambda s: "residual",
        remedy=": a demonstration may be wrong, look at those with the largest errors (record NAME "
        "--show)",
    ),
    Rule(
        lambda s: s.value < CAUGHT,
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
        "{s.all.wrong:.1f} % of held-out samples are missed by more than 10 cm, and the skill "
        f"is unsure at {{s.all.told:.0f}} % of these, {LEAST_TOLD:.0f} % wanted",
        severity=lambda s: "residual" if _untold(s) > UNTOLD_RESIDUAL else "warning",
    ),
)


def conclusion(s: Subject) -> str:
    """One sentence on whether the task suits the method, and what would help."""
    said = f"held-out demonstrations are predicted within {s.all.error_mm:.0f} mm"
    if s.figures.unsafe:
        return f"conclusion: this is not learned, because {s.figures.unsafe[0]}"
    better = {
        name: error for name, error in s.all.other_mm.items() if _is_better(s._replace(value=error))
    }
    if better:
        name = min(better, key=better.__getitem__)
        advice = "record more demonstrations, or let the hands lead the tool in each"
        if name == SAME_TIME:
            advice = "keep to their pace, or let the hands lead the tool in each"
        return (
            f"conclusion: {said}, and by a simpler prediction, {name}, within "
            f"{better[name]:.0f} mm: {advice}"
        )
    if s.all.error_mm <= NOTED_MM:
        return f"conclusion: learned well, {said}"
    if s.all.told is not None and s.all.told >= LEAST_TOLD:
        return (
            f"conclusion: learned, {said}, and the skill tells when it is wrong: it is unsure at "
            f"{s.all.told:.0f} % of the samples that are missed by more than 10 cm"
        )
    return f"conclusion: learned in part, {said}: {_what_helps(s)}"


def _what_helps(s: Subject) -> str:
    """The advice that should reduce the error most, judged by the skill's figures."""
    spread = s.figures.spread
    if len(s.figures.demonstrations) < ADVISED:
        return f"record at least {ADVISED} demonstrations"
    if (
        s.figures.by_person
        and spread is not None
        and spread.most_mm > PEOPLE_TIMES * spread.least_mm
    ):
        return "people differ, so add takes of whoever will use it (learn --from)"
    if s.figures.explained is not None and s.figures.explained < WELL_EXPLAINED:
        return "the hands do not determine the tool, so let them lead it, or name via-points"
    return "more demonstrations along the same paths help"


def verdicts(subject: Subject) -> Iterator[Verdict]:
    """The verdicts of all rules, in their order."""
    words = {
        "count": len(subject.figures.demonstrations),
        "frames": ", ".join(map(repr, subject.frames)),
        "cause": "it is at its upper limit" if subject.gate.capped else "wrong hands would pass",
    }
    for rule in RULES:
        for part, value in subject.parts(rule.of).items():
            s = subject._replace(part=part, value=value)
            if rule.is_broken(s):
                severity = rule.severity(s)
                text = (rule.text + rule.remedy).format(s=s, **words)
                yield Verdict(severity, text)
