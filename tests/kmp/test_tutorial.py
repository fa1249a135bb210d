"""The guide's blocks of code, run in order as they stand."""

import re

import pytest

from support.paths import ROOT

PAGE = ROOT / "kmp" / "docs" / "guide.md"
BLOCKS = [
    (PAGE.read_text(encoding="utf-8")[: match.start(1)].count("\n"), match.group(1))
    for match in re.finditer(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
]


def test_guide_runs_as_it_stands():
    """The output is the one on the page."""
    names: dict[str, object] = {}
    for line, block in BLOCKS:
        # a failure then names the page's line
        code = compile("\n" * line + block, str(PAGE), "exec")
        exec(code, names)


@pytest.mark.parametrize(
    "subject", ["learn", "predict", "adapt", "uncertainty", "OrientationKMP", "PeriodicKernel"]
)
def test_subjects_have_checked_blocks(subject):
    """Each subject has a block that checks itself."""
    assert any(subject in block for _, block in BLOCKS)
    assert sum("assert" in block for _, block in BLOCKS) > 0.8 * len(BLOCKS) - 2
