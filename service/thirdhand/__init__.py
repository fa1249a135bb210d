"""A robot arm as a third hand. The names here are the client's: connect to a cell, publish hands,
watch, teach, request. See `thirdhand.client`.
"""

# for type checkers; this module imports nothing, as each command begins with it
TYPE_CHECKING = False
if TYPE_CHECKING:
    from thirdhand.arms.arm import Arm as Arm
    from thirdhand.client import *  # noqa: F403
    from thirdhand.client.hands import Hands as Hands
    from thirdhand.client.hands import Pose as Pose


def __getattr__(name: str) -> object:
    """A name of the client, which is imported when it is first needed."""
    import importlib

    if place := {"Arm": "arms.arm", "Hands": "client.hands", "Pose": "client.hands"}.get(name):
        return getattr(importlib.import_module(f"thirdhand.{place}"), name)
    client = importlib.import_module("thirdhand.client")
    if name not in client.__all__:
        raise AttributeError(f"module 'thirdhand' has no name {name!r}")
    return getattr(client, name)
