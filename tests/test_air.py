"""How the code reads: one statement a line, names that say something, few branches."""

from __future__ import annotations

import pytest

from support.air import FOLDERS, air_of

MAX_PARALLEL = 0.5  # [%]
MAX_VAGUE = 0.5  # [%]
MAX_BRANCHY = {"kmp": 1.5, "service": 5.4, "sim": 3.6, "tests": 1.0}  # [%]; these only fall


@pytest.mark.parametrize("folder", FOLDERS)
def test_code_has_air(folder: str) -> None:
    air = air_of(folder)
    parallel, vague, branchy = air.shares
    assert parallel <= MAX_PARALLEL, air.parallel
    assert vague <= MAX_VAGUE, air.vague
    assert branchy <= MAX_BRANCHY[folder], air.branchy
