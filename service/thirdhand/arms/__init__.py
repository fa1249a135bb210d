"""The arm's side: playback of commands, the loop around an arm, and one small file an arm."""

from __future__ import annotations

from thirdhand.contract.explain import ExplainedError, NotAcceptedError

DRIVE_PERIOD_S = (0.0005, 0.02)
LAG_S = (0.0, 0.5)
GAIN = (1.0, 1e6)  # [1/s²]
GROUP = "thirdhand.arms"  # of the entry points with which other distributions name their arms
SHIPPED = {
    "franka": "thirdhand.arms.franka:FrankaArm",
    "simulated": "thirdhand.arms.simulated:SimulatedArm",
    "ur": "thirdhand.arms.universal_robots:UniversalRobotsArm",
    "wam": "thirdhand.arms.barrett_wam:BarrettWAM",
    "xarm": "thirdhand.arms.ufactory:UfactoryArm",
}


class DriveError(ExplainedError, RuntimeError):
    """A drive cannot be reached, belongs to another arm, or stopped; the message has the remedy."""


def place_of(name: str) -> str:
    """The place, MODULE:CLASS or FILE.py:CLASS, of an arm of this name, or which is this place.
    Raises NotAcceptedError.
    """
    from importlib.metadata import entry_points  # slow to import

    known = SHIPPED | {entry.name: entry.value for entry in entry_points(group=GROUP)}
    place = known.get(name, name)
    if ":" not in place:
        raise NotAcceptedError(
            f"no arm {name!r}; {', '.join(known)} accepted, or one of your own as MODULE:CLASS or "
            "FILE.py:CLASS"
        )
    return place
