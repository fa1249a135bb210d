"""Packages without bytecode are named, with the command that compiles them."""

from __future__ import annotations

import re
import sys

import pytest

import thirdhand
from support.cell import told
from support.paths import ROOT
from thirdhand.process import bytecode


def test_a_package_without_bytecode_is_named_with_its_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(thirdhand, "__cached__", str(ROOT / "missing.pyc"))
    command = f"`{sys.executable} -m compileall -q {ROOT / 'service' / 'thirdhand'}`"
    assert (
        bytecode.missing() == f"each start compiles thirdhand again; {command} compiles them once"
    )
    checked = told("serve", "--check")
    assert re.search(
        r"^note +bytecode +each start compiles thirdhand again; ", checked.stdout, re.MULTILINE
    )


def test_nothing_is_named_where_all_have_bytecode() -> None:
    assert bytecode.missing() == ""
    assert "bytecode" not in told("serve", "--check").stdout
