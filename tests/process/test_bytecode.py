"""Packages without bytecode are named, with the command that compiles them."""

from __future__ import annotations

import re
import sys

import pytest

import service
from service.process import bytecode
from support.cell import told
from support.paths import ROOT


def test_a_package_without_bytecode_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "__cached__", str(ROOT / "missing.pyc"))
    command = f"`{sys.executable} -m compileall -q {ROOT / 'service'}`"
    assert bytecode.missing() == f"each start compiles service again; {command} compiles them once"
    checked = told("serve", "--check")
    assert re.search(r"^note +bytecode +each start compiles service again; ", checked.stdout, re.MULTILINE)


def test_nothing_is_named_where_all_have_bytecode() -> None:
    assert bytecode.missing() == ""
    assert "bytecode" not in told("serve", "--check").stdout
