"""The house rules that a machine can check: who imports whom, names, lengths, first lines."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests_paths import ROOT

import kmp

PACKAGES = ("kmp", "service", "sim")
CORE = ("frame", "intake", "skill", "smoother", "arm", "limiter", "controller")
SHELL_ONLY = {
    *("time", "threading", "os", "socket", "subprocess", "datetime", "random", "asyncio", "multiprocessing", "signal", "logging", "sched", "queue"),
    *("zenoh", "mcap", "rerun", "pybullet"),
}
VAGUE = {"utils", "util", "common", "base", "manager", "helper", "helpers", "node", "interface", "misc", "core"}
MOST_LINES = 440
MODULES = sorted(path for package in (*PACKAGES, "tests") for path in (ROOT / package).rglob("*.py"))


def named(path: Path) -> str:
    """The path below the root."""
    return str(path.relative_to(ROOT))


def imported(path: Path) -> set[str]:
    """The first parts of the names of all modules that a file imports, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found


def test_import_contracts_hold() -> None:
    command = [sys.executable, "-c", "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())", "--no-cache"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


@pytest.mark.parametrize("name", CORE)
def test_the_core_imports_neither_a_clock_nor_the_outside(name: str) -> None:
    assert imported(ROOT / "service" / f"{name}.py") & SHELL_ONLY == set()


@pytest.mark.parametrize("name", CORE)
def test_the_core_imports_no_module_of_the_shell(name: str) -> None:
    tree = ast.parse((ROOT / "service" / f"{name}.py").read_text(encoding="utf-8"))
    found = {node.module.split(".")[1] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("service.")}
    assert found <= {*CORE, "config", "wire", "cdr"}


def test_the_mathematics_imports_nothing_but_mathematics() -> None:
    allowed = {"numpy", "scipy", "sklearn", "threadpoolctl", "kmp", *sys.stdlib_module_names}
    for path in (ROOT / "kmp").rglob("*.py"):
        assert imported(path) <= allowed, named(path)


@pytest.mark.parametrize("path", MODULES, ids=named)
def test_a_module_begins_with_what_it_is(path: Path) -> None:
    first = path.read_text(encoding="utf-8").split("\n", 1)[0]
    assert re.match(r'"""\S', first), first
    assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", MODULES, ids=named)
def test_a_module_is_short_enough_to_be_read(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_no_module_has_a_name_that_says_nothing() -> None:
    assert [named(path) for path in MODULES if path.stem in VAGUE or path.parent.name in VAGUE] == []


def test_everything_that_the_mathematics_offers_is_there_and_sorted() -> None:
    assert [name for name in kmp.__all__ if not hasattr(kmp, name)] == []
    assert {"KMP", "GaussianKernel", "GaussianMixture", "Gaussians"} <= set(kmp.__all__)
    assert len(kmp.__all__) == len(set(kmp.__all__))


def test_constraints_name_versions_and_no_places() -> None:
    lines = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line.strip() and not line.startswith("#")]
    assert pins
    assert [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+_-]+", pin)] == []
    assert [line for line in lines if re.search(r"://|--(extra-)?index|--find-links|@", line)] == []
