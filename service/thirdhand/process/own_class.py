"""Classes of one's own that a command runs, by MODULE:CLASS or FILE.py:CLASS."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from typing import Any, TypeVar

from thirdhand.contract.explain import ExplainedError

Kind = TypeVar("Kind")


def own_class(place: str, kind: type[Kind]) -> type[Kind]:
    """The class at a place, which must be one of this kind. Raises ExplainedError."""
    module, _, name = place.rpartition(":")
    try:
        found = getattr(_module(module), name)
    except (ImportError, OSError, SyntaxError, AttributeError, ValueError) as error:
        raise ExplainedError(f"{place}: {error}; MODULE:CLASS or FILE.py:CLASS needed") from None
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ExplainedError(f"{place} is no class of thirdhand.{kind.__name__}")
    return found


def _module(place: str) -> Any:
    """The module of this name, or in this file."""
    if not place.endswith(".py"):
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(Path(place).stem, place)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
