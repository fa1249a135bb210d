"""Classes of one's own that a command runs, by MODULE:CLASS or FILE.py:CLASS."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from thirdhand.contract.explain import ExplainedError

Kind = TypeVar("Kind")


def own_class(place: str, kind: type[Kind]) -> type[Kind]:
    """The class at a place, which must be one of this kind. Raises ExplainedError."""
    module, _, name = place.rpartition(":")
    if not module:
        raise ExplainedError(f"{place}: MODULE:CLASS or FILE.py:CLASS needed")
    with explained(place):
        found = getattr(_module(module), name)
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ExplainedError(f"{place} is no class of thirdhand.{kind.__name__}")
    return found


@contextlib.contextmanager
def explained(name: str) -> Iterator[None]:
    """A context in which errors of somebody's own code are ExplainedErrors that name it."""
    try:
        yield
    except ExplainedError:
        raise
    except Exception as error:
        raise ExplainedError(f"{name}: {type(error).__name__}: {error}") from error


def _module(place: str) -> Any:
    """The module of this name, or in this file; modules beside it are found too."""
    path = Path(place)
    sys.path.insert(0, str(path.parent if path.suffix == ".py" else Path.cwd()))
    if path.suffix != ".py":
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(path.stem, place)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module
