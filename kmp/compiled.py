"""Compilation of functions over arrays by Numba, where Numba is installed.

Compiled code is cached on disk. `fastmath` is off, so that sums keep their order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

try:
    from numba import config, njit
    from numba.core import event

    from kmp.compiled_cache import CompiledCache
except ImportError:
    njit = None

AVAILABLE = njit is not None
PLAIN = njit is None or bool(config.DISABLE_JIT)
"""True if functions run as plain Python, as a debugger needs."""
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function, compiled at its first call; `.py_func` is the function as written.

    The first compilation of this package's own functions is announced by the logger `kmp`.

    If no cache folder can be written, each start compiles again. Without Numba the function is
    returned unchanged.
    """
    if njit is None:
        return function
    dispatcher = njit(function)
    if not PLAIN and (cache := CompiledCache.of(function)) is not None:
        dispatcher._cache = cache  # noqa: SLF001  # Numba's own cache misses changes of what a function calls
    return cast(F, dispatcher)


if njit is not None:

    class _Announcement(event.Listener):  # type: ignore[misc]
        """One message, before the first compilation, because the caller waits for it."""

        def on_start(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            if function.__module__.startswith("kmp.") and not self.made:
                self.made = True
                logging.getLogger("kmp").warning(
                    "kmp compiles its loops for this machine: some seconds, once; later runs load "
                    "them from its cache."
                )

        def on_end(self, event: Any) -> None:
            """Ignore the end of a compilation."""

        made = False

    event.register("numba:compile", _Announcement())
