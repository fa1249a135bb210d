"""What is compiled calculates as plain Python does, operation by operation, on every CPU."""

from __future__ import annotations

import re

import numpy as np
import pytest

from kmp.compiled import compiled
from support.paths import ROOT

numba = pytest.importorskip("numba")


def total(left, right):
    """A sum of products, as vector units would add it up in another order, or fuse it."""
    out = 0.0
    for k in range(len(left)):
        out += left[k] * right[k]
    return out


@pytest.mark.parametrize("seed", range(5))
def test_sums_keep_their_order_and_products_are_rounded(seed):
    """1e16 apart, so that any other order and any product that is not rounded gives other bits."""
    random = np.random.default_rng(seed)
    left, right = random.normal(size=(2, 1001)) * 10.0 ** random.integers(-8, 9, (2, 1001))
    assert compiled(total)(left, right) == total(left, right)
    assert numba.njit(fastmath=True)(total)(left, right) != total(left, right)


def test_nothing_is_compiled_otherwise():
    for room in ("kmp", "service", "sim"):
        for path in sorted((ROOT / room).rglob("*.py")):
            found = re.findall(r"^.*\b(?:numba|njit)\b.*$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert not found or path.name == "compiled.py" or not any("import" in line for line in found), path
