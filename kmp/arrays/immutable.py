"""Immutable values, which threads may share: their arrays are read-only, in copies as well."""

from __future__ import annotations

import copy
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

_SHOWN = 3  # `repr` shows the items of tuples up to this length
_Some = TypeVar("_Some", bound=NDArray[Any])


def frozen(array: _Some) -> _Some:
    """The same array, read-only."""
    array.setflags(write=False)
    return array


class Immutable:
    """A value whose arrays stay read-only after copying and unpickling; NumPy's own do not."""

    _not_pickled: ClassVar[frozenset[str]] = frozenset()
    """Cached properties that a pickle leaves out: they are large and can be computed again."""

    def __repr__(self) -> str:
        """The fields in one line, arrays as their shapes."""
        fields = (
            f"{name}={_short(value)}"
            for name, value in self.__dict__.items()
            if name in self._fields()
        )
        return f"{type(self).__name__}({', '.join(fields)})"

    @classmethod
    def _fields(cls) -> tuple[str, ...]:
        return tuple(getattr(cls, "__dataclass_fields__", ()))

    def __getstate__(self) -> dict[str, Any]:
        return {
            name: value for name, value in self.__dict__.items() if name not in self._not_pickled
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        _freeze(tuple(state.values()))
        self.__dict__.update(state)

    def _with_cached(self, **known: object) -> Self:
        """A copy of this value in which these cached properties are already set."""
        other = copy.copy(self)
        other.__dict__.update(known)
        return other


def _short(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if isinstance(value, tuple) and len(value) > _SHOWN:
        return f"({len(value)} of {type(value[0]).__name__})"
    return repr(value)


def _freeze(value: object) -> None:
    if isinstance(value, np.ndarray):
        frozen(value)
    elif isinstance(value, tuple):
        for part in value:
            _freeze(part)
