"""The seeds and people of each experiment, tuning and evaluation apart.

`python -m sim.experiments` writes an experiment's row of `BY_EXPERIMENT` into its result. No number
of the service or of a rival may be chosen on what an experiment is evaluated on.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from sim.made_tasks import TASK_KINDS
from sim.people import GROUP_SEEDS as PERSON_SEEDS
from sim.scene import Scene

DRAWING = 0  # of the scatter of dots in a figure, and of resampling for an interval


class Stream(NamedTuple):
    """Things that are drawn one by one, each from the stream's seed and its own number."""

    kind: str
    seed: int  # 0 where each is drawn from its number alone
    numbers: range

    def share(self, share: float, *, least: int = 1) -> range:
        """The first numbers, as many as a share of them all is, and at least `least`."""
        return self.numbers[: max(least, round(len(self.numbers) * share))]

    def overlaps(self, other: Stream) -> bool:
        """True if something is drawn in both."""
        return self[:2] == other[:2] and not set(self.numbers).isdisjoint(other.numbers)

    def __str__(self) -> str:
        return f"{self.kind} {self.seed}: {self.numbers[0]} to {self.numbers[-1]}"


class Seeds(NamedTuple):
    """Random streams of an experiment: to learn from, to choose constants on, to evaluate on.

    `method` is the seed of the methods' own random choices.
    """

    evaluation: Mapping[str, Stream]
    tuning: Mapping[str, Stream] = MappingProxyType({})
    learned: Mapping[str, Stream] = MappingProxyType({})
    method: int = 0

    def named(self) -> dict[str, object]:
        """The seeds as a result's JSON names them."""
        parts = {"learned": self.learned, "tuning": self.tuning, "evaluation": self.evaluation}
        return {"method": self.method} | {
            part: {name: str(stream) for name, stream in streams.items()} for part, streams in parts.items() if streams
        }


def _scenes(count: int) -> dict[str, Stream]:
    return {"scenes": Stream("random scene", 2026, range(count))}


def _hands(seed: int) -> dict[str, Stream]:
    """The hands of the nominal scene."""
    return {"hands": Stream("hands", seed, range(1))}


def _letters(seed: int) -> dict[str, Stream]:
    """Demonstrations of written letters, five of each."""
    return {"letters": Stream("written letter", seed, range(5))}


TUNED_SCENES = {"scenes": Stream("random scene", 2019, range(100))}  # the constants of separation were chosen on them
SHIPPED = Stream("demonstration", 1, range(1, 6))
_SHIPPED = {"demonstrations": SHIPPED}
_IN_SPACE = {"letters": Stream("letter in space", 3, range(4))}
_WRITTEN = Seeds(_letters(1), tuning=_letters(0))  # how much of ProMP's covariance to fill up was chosen on 0
_TUNED_HANDS = {"people": Stream("moving hands", 0, range(3)), "stops": Stream("sudden stop", 0, range(24))}
_TEACHERS = {**_SHIPPED, "teachers": Stream("moving hands", 0, range(100, 105))}

BY_EXPERIMENT: dict[str, Seeds] = {
    "hands": Seeds(_hands(7) | _scenes(40), tuning=TUNED_SCENES, learned=_SHIPPED),
    "statistics": Seeds(_scenes(100), tuning=TUNED_SCENES, learned=_SHIPPED),
    "people": Seeds(
        {
            "people": Stream("person", PERSON_SEEDS["test"], range(24)),
            "breaking": Stream("breaking scene", PERSON_SEEDS["test"], range(40)),
        },
        tuning={
            "people": Stream("person", PERSON_SEEDS["tuning"], range(10)),
            "breaking": Stream("breaking scene", PERSON_SEEDS["tuning"], range(10)),
        },
        learned={"people": Stream("person", PERSON_SEEDS["demonstrations"], range(6))},
    ),
    "partners": Seeds(
        {kind: Stream(f"made task {kind}", 1, range(18, 24)) for kind in TASK_KINDS},
        tuning={kind: Stream(f"made task {kind}", 0, range(12)) for kind in TASK_KINDS},
        learned={kind: Stream(f"made task {kind}", 1, range(12, 18)) for kind in TASK_KINDS},
    ),
    "motion": Seeds(
        {
            "people": Stream("moving hands", 0, range(200, 203)),
            "stops": Stream("sudden stop", 0, range(200, 224)),
            **_hands(Scene().seed),
        },
        tuning=_TUNED_HANDS,
        learned=_TEACHERS,
    ),
    "motion-of-others": Seeds({}, tuning=_TUNED_HANDS, learned=_TEACHERS),  # evaluated on recordings
    "separation": Seeds(_scenes(100), tuning=TUNED_SCENES),
    "faults": Seeds(_hands(Scene().seed)),
    "letters": _WRITTEN,
    "promp": Seeds(_letters(1) | {"functions": Stream("random function", 0, range(5))}, tuning=_WRITTEN.tuning),
    "table": _WRITTEN,
    "correlation": Seeds(_IN_SPACE | {"points": Stream("via-point", 0, range(2))}),
    "runs": Seeds(_IN_SPACE | {"searches": Stream("search", 0, range(10))}),
    "phase": Seeds(_hands(11), learned=_SHIPPED),
    "orientation": Seeds(_hands(31) | _scenes(5), tuning=TUNED_SCENES, learned=_SHIPPED),
    "demonstrations": Seeds(
        _scenes(40) | {"demonstrations": Stream("demonstration", 1, range(21, 26))},
        tuning=TUNED_SCENES,
        learned={"demonstrations": Stream("demonstration", 1, range(1, 21)), "orders": Stream("order", 0, range(4))},
    ),
}
