"""Functions over arrays compiled by Numba where that is installed: cached on disk, without
`fastmath`, so that sums keep their order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

try:
    from numba import config, njit
except ImportError:
    njit = None

AVAILABLE = njit is not None
PLAIN = njit is None or bool(config.DISABLE_JIT)
"""Whether functions run as plain Python, as a debugger wants them."""
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function, compiled at its first call; its plain Python stays at hand as `.py_func`.

    Where no folder can be written to, it is compiled anew at each start. Without Numba it is the
    function itself.
    """
    if njit is None:
        return function
    try:
        return cast(F, njit(cache=True)(function))
    except RuntimeError:
        return cast(F, njit(function))
