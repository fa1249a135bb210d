"""The example of a motion-capture system: what it makes of synthetic rigid bodies."""

from __future__ import annotations

import importlib.util
from types import ModuleType, SimpleNamespace

from service.contract.messages import PoseStamped
from support.paths import ROOT


def example(name: str) -> ModuleType:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_rigid_bodies_that_are_tracked_are_hands() -> None:
    def body(number: int, *, tracked: bool = True) -> SimpleNamespace:
        return SimpleNamespace(id_num=number, pos=(0.1, 1.0, 0.2), rot=(0.0, 0.6, 0.0, 0.8), tracking_valid=tracked)

    keys = {1: "hands/left", 2: "hands/right", None: "tool/pose"}
    found = dict(example("optitrack_hands").poses([body(2), body(1, tracked=False), body(7)], keys, 9))
    assert found == {"hands/right": PoseStamped(9, "optitrack", (0.1, 1.0, 0.2), (0.0, 0.6, 0.0, 0.8))}


def test_the_example_is_short() -> None:
    assert len((ROOT / "examples" / "optitrack_hands.py").read_text(encoding="utf-8").splitlines()) < 80
