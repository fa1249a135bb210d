"""Verdicts on figures: warned of, a residual risk, or refused."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from thirdhand.workbench.learning.gate import Caught, Gate
from thirdhand.workbench.learning.records import Figures, Row
from thirdhand.workbench.learning.verdicts import Subject, verdicts

GOOD = Row(
    name="all",
    error_mm=20.0,
    worst_mm=60.0,
    predicted_mm=20.0,
    within_50=50.0,
    within_95=95.0,
    held=1.0,
)
FIGURES = Figures(
    demonstrations=(GOOD,) * 4,
    all=GOOD,
    gate_mm=50.0,
    swapped=100.0,
    beside=100.0,
    one_beside=99.0,
    ambiguous=0.0,
    beyond_reach=0.0,
    explained=98.0,
)
GATE = Gate(0.05, Caught(1.0, 1.0, 1.0), capped=False, floored=False)


def found(
    frames: tuple[str, ...] = ("base",), takes: int = 4, error_mm: float = 20.0, **change: Any
) -> dict[str, str]:
    """Texts and severities of good figures with these changes."""
    row = msgspec.structs.replace(GOOD, error_mm=error_mm, held=change.pop("held", 1.0))
    row = msgspec.structs.replace(row, predicted_mm=change.pop("expected_mm", row.predicted_mm))
    gate = GATE._replace(capped=change.pop("capped", False))
    figures = msgspec.structs.replace(FIGURES, demonstrations=(row,) * takes, all=row, **change)
    subject = Subject(figures, gate, frames, "a and b", row.error_mm, scatter_mm=250.0)
    return {verdict.text: verdict.severity for verdict in verdicts(subject)}


def test_good_figures_have_no_remarks() -> None:
    assert found() == {}


@pytest.mark.parametrize(
    ("change", "severity", "says"),
    [
        ({"error_mm": 60.0}, "warning", "missed by 60 mm"),
        ({"error_mm": 126.0, "explained": 78.0}, "residual", "missed by 126 mm"),
        ({"error_mm": 150.0, "explained": 15.0}, "unsafe", "15 % of its variance in held-out"),
        ({"capped": True}, "residual", "up to the largest deviation that is allowed, 50 mm"),
        (
            {"expected_mm": 260.0},
            "residual",
            "more than the tool moves about its mean position, 250 mm",
        ),
        ({"takes": 2, "error_mm": 93.0}, "unsafe", "as they miss each other by 93 mm: record more"),
        ({"ambiguous": 8.0}, "warning", "8 % of the samples contradict others"),
        ({"ambiguous": 12.0}, "residual", "12 % of the samples contradict others"),
        (
            {"ambiguous": 30.0},
            "unsafe",
            "30 % of the samples contradict others, up to 10 % accepted: a and b. Leave out",
        ),
        ({"beyond_reach": 10.0}, "warning", "10.0 % of the tool's path"),
        (
            {"beyond_reach": 30.0},
            "unsafe",
            "in frame base? If it is, demonstrate nearer to the arm",
        ),
        ({"held": 30.0}, "warning", "holds 30 % of what was demonstrated"),
        ({"beside": 80.0}, "warning", "the gate holds 80.0 % of hands 30 cm beside"),
        ({"beside": 3.0}, "warning", "the gate holds 3.0 % of hands 30 cm beside, 95 % wanted"),
        (
            {"frames": ("base", "camera")},
            "unsafe",
            "'base', 'camera'; one needed: record them again in one frame",
        ),
    ],
)
def test_verdict_of_each_figure(change: dict[str, Any], severity: str, says: str) -> None:
    """A poor figure is warned of, accepted by a person, or refused."""
    texts = (
        {text: kind for text, kind in found(**change).items() if says in text}
        if says
        else found(**change)
    )
    assert list(texts.values()) == [severity] * bool(says)
