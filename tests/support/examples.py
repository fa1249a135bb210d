"""Import of programs that are no part of a package."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

from support.paths import ROOT


def program(path: Path) -> ModuleType:
    """The module of a program."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def example(name: str) -> ModuleType:
    """The module of an example."""
    return program(ROOT / "examples" / f"{name}.py")
