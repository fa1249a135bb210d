"""Compiled functions calculate as plain Python does, operation by operation, on every CPU."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import numpy as np
import pytest

from kmp.compiled import compiled
from kmp.loops.mean import exponentials
from support.paths import LIBRARY, ROOT

numba = pytest.importorskip("numba")


def total(left, right):
    """A sum of products, which vector units would reorder or fuse."""
    out = 0.0
    for k in range(len(left)):
        out += left[k] * right[k]
    return out


@pytest.mark.parametrize("seed", range(5))
def test_sums_keep_order_and_products_are_rounded(seed):
    """The terms differ by 1e16, so that another order or an unrounded product gives other bits."""
    random = np.random.default_rng(seed)
    left, right = random.normal(size=(2, 1001)) * 10.0 ** random.integers(-8, 9, (2, 1001))
    assert compiled(total)(left, right) == total(left, right)
    assert numba.njit(fastmath=True)(total)(left, right) != total(left, right)


OPERATIONS = """
import math
from dataclasses import replace
import numpy as np
from kmp import KMP, GaussianKernel, Gaussians
from kmp.compiled import compiled

def operations(a, b, m, out):
    for k in range(len(a)):
        x, y = a[k], b[k]
        out[k] = math.exp(-x * x) + math.sqrt(x * x + y * y) * math.sin(x)
        out[k] -= math.atan2(y, x) * math.cos(y)
        out[k] += x**3 * math.log(1.0 + abs(y)) + abs(x) ** 1.7 + math.acos(abs(x) / (1.0 + abs(x)))
    for i in range(len(m)):
        for j in range(len(m)):
            out[0] += m[i, j] * a[i] * b[j]
    out[1] += np.sum(a * b) + np.dot(a, b) + (m @ m).sum() + a.max()

random = np.random.default_rng(1)
a, b = random.normal(size=(2, 1000))
out = np.zeros(1000)
compiled(operations)(a, b, random.normal(size=(20, 20)), out)
print(out.tobytes().hex())
s = random.normal(size=(37, 3))
reference = Gaussians(s, [np.eye(3)] * 37)
query = KMP.fit(s, reference, kernel=GaussianKernel(0.5), lambda_mean=1.0).inner.query
from kmp.loops.query import CompiledQuery
rounded = np.round(query.weights, 6)  # solved by LAPACK, which is another on such a CPU
loops = CompiledQuery.of(replace(query, weights=rounded))
motion = loops.motion(*s[:3], covariance=False)
print(loops.mean(s + 0.1)[0].tobytes().hex(), motion.jacobian.tobytes().hex())
"""


@pytest.mark.thorough
def test_bits_are_those_of_a_plain_cpu():
    """Results are not rounded here. The golden session, whose states are rounded, is replayed on
    such a CPU too.
    """
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("NUMBA_CPU")
    }
    command = [sys.executable, "-c", OPERATIONS]
    native, generic = (
        subprocess.run(
            command, env=environment | more, cwd=LIBRARY, capture_output=True, text=True, check=True
        ).stdout
        for more in ({}, {"NUMBA_CPU_NAME": "generic"})
    )
    assert len(native) > 1000
    assert native == generic


FIRST = """
import numpy as np
from kmp import KMP, GaussianKernel, Gaussians
reference = Gaussians.of([[0.0], [1.0]], deviation=0.1)
skill = KMP.fit([[0.0], [1.0]], reference, kernel=GaussianKernel(1.0), lambda_mean=1)
print(skill.mean([[0.5]]), skill.jacobian([0.5]))
"""


def test_first_compilation_is_announced_once(tmp_path):
    """Loading from the cache is not announced."""
    command = [sys.executable, "-c", FIRST]
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(command, env=env, cwd=LIBRARY, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert first.stderr.splitlines() == [
        "kmp compiles its loops for this machine: some seconds, once; later runs load them from "
        "its cache."
    ]
    assert (second.stdout, second.stderr) == (first.stdout, "")


def test_exponentials_are_exact_to_one_unit():
    """Exponentials are right to a unit in the last place."""
    values = np.concatenate(
        [np.linspace(0, 3, 100_000), np.geomspace(1e-300, 1400, 100_000), [0.0, 1417.0, np.inf]]
    )
    result = values.copy()
    exponentials(result, 0.5, np.empty_like(values))
    expected = np.exp(np.longdouble(-0.5) * values).astype(np.float64)
    assert np.all(np.abs(result - expected)[:-2] <= np.spacing(expected)[:-2])
    assert result[-3:].tolist() == [1.0, 0.0, 0.0]


# code that listens to compilations, to report them during a start
LISTENS = r"from numba.core import (dispatcher, )?event"


def test_nothing_is_compiled_otherwise():
    for room in ("kmp", "service", "sim"):
        for path in sorted((ROOT / room).rglob("*.py")):
            text = re.sub(LISTENS, "", path.read_text(encoding="utf-8"))
            lines = re.findall(r"^.*\b(?:numba|njit)\b.*$", text, re.MULTILINE)
            assert (
                not lines
                or path.name in {"compiled.py", "compiled_cache.py"}
                or not any("import" in line for line in lines)
            ), path
