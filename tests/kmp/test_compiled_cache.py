"""Compiled code is kept for the same sources, wherever they are, and for no others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import LIBRARY

pytest.importorskip("numba")

MODULES = {
    "__init__.py": "",
    "numbers.py": "STEP = 1.0\n",
    "inner.py": "from kmp.compiled import compiled\nfrom steps.numbers import (\n    STEP,\n)\n\n"
    "@compiled\ndef inner(x):\n    return x + STEP\n",
    "outer.py": "from kmp.compiled import compiled\nfrom steps import inner as below\n\nmore = "
    "below.inner\n\n"
    "@compiled\ndef outer(x):\n    return 10.0 * more(x)\n",
    "apart.py": "",
    "length.py": """
from math import cos, exp, log, sin

from kmp.compiled import compiled

@compiled
def measured(records, depth):  # so large that it stays a function of its own
    values = records[0].values
    total = 0.0
    for i in range(len(values)):
        for j in range(depth):
            total += sin(values[i]) * log(1.0 + values[i]) + values[i] ** (j + 0.5)
            if total > 1e9:
                raise ValueError("too large")
        for j in range(i):
            total += exp(values[j]) * cos(values[j]) - 1.0
    return total + len(values)

@compiled
def length(records):
    return measured(records, 2) + 0.0 * measured(records, 3)
""",
}
CALLED = """
from numba.core import event

class Count(event.Listener):
    count = 0
    def on_start(self, event):
        self.count += event.data["dispatcher"].py_func.__module__.startswith("steps")
    def on_end(self, event): ...

event.register("numba:compile", counted := Count())
from steps.outer import outer
print(outer(1.0), counted.count)
"""


class Checkout:
    """A package with a compiled function that calls one of another module, and a cache."""

    def __init__(self, folder: Path, cache: Path) -> None:
        self.folder = folder / "steps"
        self.cache = cache
        self.folder.mkdir(parents=True)
        for name, text in MODULES.items():
            (self.folder / name).write_text(text)

    def change(self, name: str, before: str, after: str) -> None:
        """Replace a text in a module."""
        path = self.folder / name
        path.write_text(
            path.read_text().replace(before, after)
            + "# of another length, as bytecode is trusted by it\n"
        )

    def result(self) -> list[float]:
        """The outer function's result for 1, and the number of functions compiled for it."""
        return self.run(CALLED)

    def run(self, program: str, *arguments: str) -> list[float]:
        """The numbers that a program prints in a new process."""
        path = os.pathsep.join(map(str, (self.folder.parent, LIBRARY)))
        environment = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(self.cache)}
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return list(map(float, done.stdout.split()))


LENGTHS = """
import sys
import numpy as np
from steps.length import length

for size in map(int, sys.argv[1:]):
    record = np.zeros(1, [("values", np.float64, (size,))])
    print(length(record))
"""


FORKED = """
import os
import sys
import numpy as np
from steps.length import length

for size in map(int, sys.argv[1:]):
    if os.fork() == 0:
        length(np.zeros(1, [("values", np.float64, (size,))]))
        sys.exit()
    os.wait()
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path / "one", tmp_path / "cache")


def test_same_sources_elsewhere_are_served(checkout: Checkout, tmp_path: Path) -> None:
    assert checkout.result() == [20.0, 2]
    checkout.change("apart.py", "", "# imported by nobody")
    assert checkout.result() == [20.0, 0]
    assert Checkout(tmp_path / "another", checkout.cache).result() == [20.0, 0]


@pytest.mark.parametrize(
    ("module", "before", "after", "returned"),
    [
        ("inner.py", "x + STEP", "x - STEP", 0.0),
        ("numbers.py", "1.0", "2.0", 30.0),
        ("outer.py", "10.0", "5.0", 10.0),
    ],
    ids=["what it calls", "a constant of what it calls", "itself"],
)
def test_change_compiles_anew(
    checkout: Checkout, module: str, before: str, after: str, returned: float
) -> None:
    """A function is compiled anew after a change of what it calls."""
    assert checkout.result() == [20.0, 2]
    checkout.change(module, before, after)
    assert checkout.result() == [returned, 1 if module == "outer.py" else 2]


def test_processes_of_other_types_do_not_mix(checkout: Checkout) -> None:
    """Both processes give their first record type the same name; the last process loads the code of
    both.
    """
    assert checkout.run(LENGTHS, "6") == [6]
    assert checkout.run(LENGTHS, "7") == [7]
    assert checkout.run(LENGTHS, "7", "6") == [7, 6]


def test_forked_processes_do_not_mix(checkout: Checkout) -> None:
    """Forked processes continue from the counters of their parent."""
    checkout.run(FORKED, "6", "7")
    assert checkout.run(LENGTHS, "7", "6") == [7, 6]


def test_damaged_files_are_compiled_anew(checkout: Checkout) -> None:
    checkout.result()
    for path in checkout.cache.rglob("*.nbc"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    assert checkout.result() == [20.0, 2]
    assert checkout.result() == [20.0, 0]


def test_full_disk_leaves_no_partial_files(checkout: Checkout) -> None:
    full = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
    assert checkout.run(full + CALLED) == [20.0, 2]
    assert [path for path in checkout.cache.rglob("*") if path.is_file()] == []
