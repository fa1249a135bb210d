"""Table of a skill's figures for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from thirdhand.workbench.learning.records import Figures, Row

LEAST_DELAY_S = 0.005  # a shorter delay is none
OTHER_MM = 1.0  # the error at the moment has a column if it differs from the error by this much


def table(found: Figures) -> str:
    """The figures as a table of demonstrations, an explanation of its columns, and the verdicts."""
    rows = (*found.demonstrations, found.all)
    has_moments = any(abs(row.moment_mm - row.error_mm) >= OTHER_MM for row in rows)
    lines = [
        *_rows(found, has_moments=has_moments),
        "",
        *_explanation(found, has_moments=has_moments),
        "",
        *_gate(found),
        *_told(found),
        *_spread(found),
        f"{found.ambiguous:.1f} % of the samples contradict others: the same hands with the tool "
        f"elsewhere; {found.beyond_reach:.1f} % of the tool's path is out of the arm's reach",
        *_pose(found),
        *_delay(found),
        *_candidates(
            f"inputs that were tried, with their held-out errors; {found.taken} is taken:",
            found.tried_mm,
        ),
        *_candidates(
            "the weight of your demonstrations against the skill's, with errors; "
            f"{found.weight} is taken:",
            found.weights_mm,
        ),
        *(f"warning: {text}" for text in found.warnings),
        *(f"residual risk: {text}" for text in found.residual),
        *(f"unsafe: {text}" for text in found.unsafe),
        found.conclusion,
    ]
    return "\n".join(lines)


def _rows(found: Figures, *, has_moments: bool) -> list[str]:
    """The heads of the columns, and a row for each demonstration and for all."""
    basis = "held out" if len(found.demonstrations) > 1 else "learned from"
    basis += " by person" if found.by_person else ""
    rows = (*found.demonstrations, found.all)
    width = max(len(basis), *(len(row.name) for row in rows))
    baselines = "".join(f"   {baseline}" for baseline in found.all.other_mm)
    moment = "  of blocks" if has_moments else ""
    return [
        f"{basis:<{width}}   error   worst{moment}   expected   in 50 %  in 95 %   held{baselines}",
        *(_row(row, width, has_moments=has_moments) for row in rows),
    ]


def _row(row: Row, width: int, *, has_moments: bool) -> str:
    """The figures of a demonstration, with a name of `width` characters."""
    moment = f"    {row.moment_mm:4.0f} mm" if has_moments else ""
    others = "".join(
        f"   {f'{error_mm:.0f} mm':>{len(baseline)}}" for baseline, error_mm in row.other_mm.items()
    )
    return (
        f"{row.name:<{width}}  {row.error_mm:4.0f} mm {row.worst_mm:4.0f} mm{moment}"
        f"    {row.predicted_mm:4.0f} mm   {row.within_50:5.0f} %  {row.within_95:5.0f} %  "
        f"{row.held:4.1f} %{others}"
    )


def _explanation(found: Figures, *, has_moments: bool) -> Iterator[str]:
    """The meaning of rows and columns."""
    yield (
        "Each row is a demonstration that was left out and predicted from the others. The columns:"
        if len(found.demonstrations) > 1
        else "The row is the demonstration that was learned from, as none could be left out. The "
        "columns:"
    )
    yield (
        "  error, worst   distance of the predicted tool from the demonstrated one: root mean "
        "square, and largest"
    )
    if has_moments:
        yield (
            "  of blocks      error if whole blocks of demonstrations are held out, also from the "
            "parameters' choice"
        )
    yield (
        "  expected       root mean square error that the skill expects, by its calibrated "
        "covariance"
    )
    yield (
        "  in 50 %, 95 %  share of the samples in the regions that should contain 50 % and 95 % of "
        "them"
    )
    yield (
        "  held           share of the time in which the arm would hold, because the hands are "
        "beyond the gate"
    )
    if found.all.other_mm:
        yield f"  {', '.join(found.all.other_mm)}: errors of simpler predictions"
    yield "docs/learning.md, section Judged, explains each of them."


def _gate(found: Figures) -> Iterator[str]:
    """The time for which the gate would hold the arm, and the wrong samples that it catches."""
    shares = [row.held for row in found.demonstrations]
    yield (
        f"the gate would hold the arm for {found.all.held:.1f} % of the time, {min(shares):.1f} to "
        f"{max(shares):.1f} % of a demonstration, standard deviation {found.held_std:.1f} %"
    )
    yield f"the gate, at {found.gate_mm:.0f} mm, would hold it in wrong samples: {_caught(found)}"


def _pose(found: Figures) -> Iterator[str]:
    """The explained variance, and the errors of orientation and gripper, if there are any."""
    if found.explained is not None:
        yield f"the hands explain {max(found.explained, 0.0):.0f} % of the tool's variance"
    if found.orientation_error_deg is not None:
        yield f"the error of the tool's orientation is {found.orientation_error_deg:.1f}° rms"
    if found.gripper_right is not None:
        yield f"the gripper is right in {found.gripper_right:.0f} % of the samples"


def _delay(found: Figures) -> Iterator[str]:
    """The teacher's delay, if it was searched."""
    if found.delay_s is None:
        return
    late = "not"
    advice = ""
    if found.delay_s >= LEAST_DELAY_S:
        late = f"{found.delay_s:.2f} s"
        advice = ": the tool is as late; [skill] lead_s makes it earlier"
    yield (
        f"the teacher was {late} late, which predicts held-out demonstrations best (standard "
        f"deviation {found.delay_std_s:.2f} s over demonstrations){advice}"
    )


def _candidates(title: str, errors_mm: Mapping[str, float]) -> Iterator[str]:
    """The errors of candidates below a title; nothing without candidates."""
    if errors_mm:
        yield title
    width = max(map(len, errors_mm), default=0)
    for name, error_mm in errors_mm.items():
        yield f"  {name:<{width}}  {error_mm:4.0f} mm"


def _told(found: Figures) -> list[str]:
    """A line on the samples at which the skill is unsure; none if there are none."""
    if not (found.all.wrong or found.all.falsely_told):
        return []
    wrong = f"{found.all.wrong:.1f} % of the samples are missed by more than 10 cm"
    unsure_text = (
        ""
        if found.all.told is None
        else f"; the skill is unsure at {found.all.told:.0f} % of these"
    )
    return [f"{wrong}{unsure_text}, and at {found.all.falsely_told:.0f} % of the others"]


def _spread(found: Figures) -> Iterator[str]:
    """The spread of the error over people, or over demonstrations if each is by another one."""
    if (spread := found.spread) is not None:
        of = "people" if found.by_person else "demonstrations"
        yield (
            f"over {spread.people} {of} the error is {spread.least_mm:.0f} to "
            f"{spread.most_mm:.0f} mm, standard deviation {spread.std_mm:.0f} mm; "
            f"{spread.as_said} of {spread.people} are within the error that the skill expects"
        )


def _caught(found: Figures) -> str:
    """The shares of wrong samples that the gate holds, in words."""
    if found.alone is True:
        return f"{found.beside:.0f} % of the hand 30 cm beside"
    return (
        f"{found.swapped:.0f} % of hands swapped, {found.beside:.0f} % of both 30 cm beside, "
        f"{found.one_beside:.0f} % of one hand 30 cm beside"
    )
