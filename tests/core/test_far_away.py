"""What is said of a position that is too far away: the unit that was meant."""

from __future__ import annotations

import pytest

from service.core.intake.far_away import too_far


@pytest.mark.parametrize(
    ("position", "unit"), [((98.0, -32.0, 6.0), "cm"), ((980.0, -320.0, 60.0), "mm"), ((40.0, 30.0, 20.0), "cm")]
)
def test_the_unit_that_fits_best_is_named(position: tuple[float, ...], unit: str) -> None:
    assert f"which looks like {unit};" in too_far(position, "m")


def test_no_unit_is_named_where_none_fits() -> None:
    assert "looks like" not in too_far((1e6, 0.0, 0.0), "m")
