"""Packages without compiled bytecode, with which a daemon's start takes twice as long."""

from __future__ import annotations

import os
import sys

STARTED = ("kmp", "thirdhand", "numpy", "numba", "pinocchio", "zenoh")


def missing() -> str:
    """The packages that each start compiles again, and the remedy; empty if there are none."""
    folders = set()
    for name, module in sys.modules.copy().items():
        package = name.partition(".")[0]
        cached = getattr(module, "__cached__", None)
        if package in STARTED and cached and not os.path.exists(cached):
            folders.add(os.path.dirname(sys.modules[package].__file__ or ""))
    if not folders:
        return ""
    packages = ", ".join(sorted(os.path.basename(folder) for folder in folders))
    command = f"{sys.executable} -m compileall -q {' '.join(sorted(folders))}"
    return f"each start compiles {packages} again; `{command}` compiles them once"
