"""The client of thirdhand: connect to a cell, publish hands, watch, teach, request.

Installed as `thirdhand`; its names are those of `service.client`.
"""

import os
import sys

_alone = os.path.join(os.path.dirname(__file__), "_thirdhand_client")  # in the wheel of the client alone
if os.path.isdir(_alone):
    sys.path.insert(0, _alone)

try:
    from service.client import *  # noqa: F403
    from service.client import __all__  # noqa: F401
except ModuleNotFoundError as error:
    if error.name not in ("service", "service.client"):
        raise
    _found = getattr(sys.modules.get("service"), "__file__", None)
    raise ImportError(
        f"`import thirdhand` found another package named `service` ({_found}): import thirdhand first, or rename it"
        if _found
        else "`import thirdhand` found no package `service` of thirdhand: install thirdhand, or thirdhand-client, again"
    ) from None
