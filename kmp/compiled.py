"""Functions over arrays compiled by Numba where that is installed: cached on disk, without
`fastmath`, so that sums keep their order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

try:
    from numba import config, njit
    from numba.core import event
except ImportError:
    njit = None

AVAILABLE = njit is not None
PLAIN = njit is None or bool(config.DISABLE_JIT)
"""Whether functions run as plain Python, as a debugger wants them."""
F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function, compiled at its first call; its plain Python stays at hand as `.py_func`.

    The first compilation of this package's own functions is announced by the logger `kmp`.

    Where no folder can be written to, it is compiled anew at each start. Without Numba it is the
    function itself.
    """
    if njit is None:
        return function
    try:
        return cast(F, njit(cache=True)(function))
    except RuntimeError:
        return cast(F, njit(function))


if njit is not None:

    class _Announcement(event.Listener):  # type: ignore[misc]
        """Says once that functions of this package are compiled, as the caller waits for that."""

        def on_start(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            if function.__module__.startswith("kmp.") and not self.made:
                self.made = True
                logging.getLogger("kmp").warning(
                    "kmp compiles its loops for this machine: some seconds, once; later runs load them from its cache."
                )

        def on_end(self, event: Any) -> None:
            """Nothing to say."""

        made = False

    event.register("numba:compile", _Announcement())
