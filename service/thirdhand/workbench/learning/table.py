"""Table of a skill's figures for a terminal."""

from __future__ import annotations

from thirdhand.workbench.learning.records import Figures

LEAST_DELAY_S = 0.005  # a shorter delay is none
OTHER_MM = 1.0  # the error at the moment has a column if it differs from the error by this much


def table(found: Figures) -> str:
    """The figures as a table of demonstrations, an explanation of its columns, and the verdicts."""
    basis = "held out" if len(found.demonstrations) > 1 else "learned from"
    basis += " by person" if found.by_person else ""
    width = max(
        len(text) for text in (basis, *(row.name for row in (*found.demonstrations, found.all)))
    )
    ways = "".join(f"   {baseline}" for baseline in found.all.other_mm)
    rows = (*found.demonstrations, found.all)
    is_other = any(abs(row.moment_mm - row.error_mm) >= OTHER_MM for row in rows)
    moment = "  of blocks" if is_other else ""
    lines = [f"{basis:<{width}}   error   worst{moment}   expected   in 50 %  in 95 %   held{ways}"]
    for row in rows:
        moment = f"    {row.moment_mm:4.0f} mm" if is_other else ""
        lines.append(
            f"{row.name:<{width}}  {row.error_mm:4.0f} mm {row.worst_mm:4.0f} mm{moment}"
            f"    {row.predicted_mm:4.0f} mm   {row.within_50:5.0f} %  {row.within_95:5.0f} %  "
            f"{row.held:4.1f} %"
            + "".join(
                f"   {f'{mm:.0f} mm':>{len(baseline)}}" for baseline, mm in row.other_mm.items()
            )
        )
    helds = [row.held for row in found.demonstrations]
    lines += [
        "",
        "Each row is a demonstration that was left out and predicted from the others. The columns:"
        if len(found.demonstrations) > 1
        else "The row is the demonstration that was learned from, as none could be left out. The "
        "columns:",
        "  error, worst   distance of the predicted tool from the demonstrated one: root mean "
        "square, and largest",
        *[
            "  of blocks      error if whole blocks of demonstrations are held out, also from the "
            "parameters' choice"
        ]
        * is_other,
        "  expected       root mean square error that the skill expects, by its calibrated "
        "covariance",
        "  in 50 %, 95 %  share of the samples in the regions that should contain 50 % and 95 % of "
        "them",
        "  held           share of the time in which the arm would hold, because the hands are "
        "beyond the gate",
        *[f"  {', '.join(found.all.other_mm)}: errors of simpler predictions"]
        * bool(found.all.other_mm),
        "docs/learning.md, section Judged, explains each of them.",
        "",
        f"the gate would hold the arm for {found.all.held:.1f} % of the time, {min(helds):.1f} to "
        f"{max(helds):.1f} % of a demonstration, standard deviation {found.held_std:.1f} %",
        f"the gate, at {found.gate_mm:.0f} mm, would hold it in wrong samples: {_caught(found)}",
        *_told(found),
        f"{found.ambiguous:.1f} % of the samples contradict others: the same hands with the tool "
        f"elsewhere; {found.beyond_reach:.1f} % of the tool's path is out of the arm's reach",
    ]
    if found.explained is not None:
        lines.append(f"the hands explain {max(found.explained, 0.0):.0f} % of the tool's variance")
    if found.orientation_error_deg is not None:
        lines.append(
            f"the error of the tool's orientation is {found.orientation_error_deg:.1f}° rms"
        )
    if found.gripper_right is not None:
        lines.append(f"the gripper is right in {found.gripper_right:.0f} % of the samples")
    if found.delay_s is not None:
        late = f"{found.delay_s:.2f} s" if found.delay_s >= LEAST_DELAY_S else "not"
        advice = (
            ": the tool is as late; [skill] lead_s makes it earlier"
            if found.delay_s >= LEAST_DELAY_S
            else ""
        )
        lines.append(
            f"the teacher was {late} late, which predicts held-out demonstrations best (standard "
            f"deviation {found.delay_std_s:.2f} s over demonstrations){advice}"
        )
    if found.tried_mm:
        wide = max(map(len, found.tried_mm))
        lines.append(f"inputs that were tried, with their held-out errors; {found.taken} is taken:")
        lines += (f"  {name:<{wide}}  {mm:4.0f} mm" for name, mm in found.tried_mm.items())
    if found.weights_mm:
        wide = max(map(len, found.weights_mm))
        lines.append(
            f"the weight of your demonstrations against the skill's, with errors; {found.weight} "
            "is taken:"
        )
        lines += (f"  {name:<{wide}}  {mm:4.0f} mm" for name, mm in found.weights_mm.items())
    lines += (f"warning: {text}" for text in found.warnings)
    lines += (f"residual risk: {text}" for text in found.residual)
    return "\n".join([*lines, *(f"unsafe: {text}" for text in found.unsafe)])


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


def _caught(found: Figures) -> str:
    """The shares of wrong samples that the gate holds, in words."""
    if found.alone is True:
        return f"{found.beside:.0f} % of the hand 30 cm beside"
    return (
        f"{found.swapped:.0f} % of hands swapped, {found.beside:.0f} % of both 30 cm beside, "
        f"{found.one_beside:.0f} % of one hand 30 cm beside"
    )
