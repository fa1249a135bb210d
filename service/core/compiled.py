"""Functions over arrays compiled by Numba: cached on disk, without `fastmath`, so that sums keep
their order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function, compiled at its first call; its plain Python stays at hand as `.py_func`.

    Where no folder can be written to, it is compiled anew at each start.
    """
    try:
        return cast(F, numba.njit(cache=True)(function))
    except RuntimeError:
        return cast(F, numba.njit(function))
