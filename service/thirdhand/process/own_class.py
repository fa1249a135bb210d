"""Classes of one's own that a command runs, by MODULE:CLASS or FILE.py:CLASS."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from numbers import Real
from pathlib import Path
from types import FrameType
from typing import Any, TypeAlias, TypeVar

from thirdhand.contract.explain import ExplainedError, NotAcceptedError

Kind = TypeVar("Kind")
Accepted: TypeAlias = tuple[Callable[[Any], bool], str]
"""True for the values that an attribute accepts, and these in words."""


def own_class(place: str, kind: type[Kind]) -> type[Kind]:
    """The class at a place, which must be one of this kind. Raises NotAcceptedError, or
    ExplainedError if its module fails.
    """
    module, _, name = place.rpartition(":")
    if not module:
        raise NotAcceptedError(f"{place}: MODULE:CLASS or FILE.py:CLASS needed")
    with explained(_module_name(module), place):
        found = getattr(_module(module), name)
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise NotAcceptedError(f"{place} is no class of thirdhand.{kind.__name__}")
    if missing := sorted(getattr(found, "__abstractmethods__", ())):
        raise NotAcceptedError(
            f"{place} has no {', '.join(missing)}, which a class of thirdhand.{kind.__name__} needs"
        )
    return found


def number(low: float, high: float, unit: str, *more: float) -> Accepted:
    """The numbers from `low` to `high`, and `more`."""
    words = (f"{low:g} to {high:g}{unit}", *(f"math.{value}" for value in more))
    return (
        lambda value: (
            isinstance(value, Real)
            and not isinstance(value, bool)
            and (low <= float(value) <= high or value in more)
        ),
        " or ".join(words),
    )


def check_attributes(instance: object, accepted: Mapping[str, Accepted]) -> None:
    """Raise ExplainedError for an attribute of one's own class with another value; properties may
    change, and are not read.
    """
    for name, (is_accepted, needed) in accepted.items():
        value = inspect.getattr_static(instance, name)
        if not (isinstance(value, property) or is_accepted(value)):
            raise ExplainedError(
                f"{type(instance).__name__}.{name}: {value!r} given; {needed} needed"
            )


@contextlib.contextmanager
def explained(own: type | str, name: str = "") -> Iterator[None]:
    """A context in which errors of one's own class, or of the module of this name, are
    ExplainedErrors, as in `failure`.
    """
    try:
        yield
    except ExplainedError:
        raise
    except Exception as error:
        raise ExplainedError(failure(error, own, name)) from error


def failure(error: Exception, own: type | str, name: str = "") -> str:
    """An error in words, with method and line of one's own class or module; `name` where it has
    none.
    """
    message = f"{type(error).__name__}: {error}".removesuffix(": ")
    method, line = own_lines(traceback.walk_tb(error.__traceback__), own)
    parts = (name or method or getattr(own, "__name__", ""), line, message)
    return ": ".join(part for part in parts if part)


def own_lines(frames: Iterable[tuple[FrameType, int]], own: type | str) -> tuple[str, str]:
    """The outermost method in the file of one's own class or module, and the innermost FILE:LINE
    there; empty if none of these frames is there.
    """
    modules = {own}
    if isinstance(own, type):
        modules = {kind.__module__ for kind in own.__mro__ if not inspect.isabstract(kind)}
    lines = [
        (frame.f_code, line) for frame, line in frames if frame.f_globals["__name__"] in modules
    ]
    if not lines:
        return "", ""
    innermost, line = lines[-1]
    return lines[0][0].co_qualname, f"{Path(innermost.co_filename).name}:{line}"


def _module_name(place: str) -> str:
    return Path(place).stem if place.endswith(".py") else place


def _module(place: str) -> Any:
    """The module of this name, or in this file; modules beside it are found too."""
    path = Path(place)
    sys.path.insert(0, str(path.parent if path.suffix == ".py" else Path.cwd()))
    if path.suffix != ".py":
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(_module_name(place), place)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
