"""The experiments: purpose, module, origin of the numbers, and seeds, tuning and evaluation apart.

An experiment is a module with `run(results, options) -> numbers`, and a row of `EXPERIMENTS`. The
command writes the seeds of the row into the result. No number of the service or of a rival may be
chosen on what an experiment is evaluated on.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from sim.made_tasks import KINDS
from sim.people import SEEDS as PERSON_SEEDS
from sim.scene import Scene

DRAWING = 0  # seed of the scatter of dots in a figure, and of resampling for an interval


class Stream(NamedTuple):
    """Random things, each drawn from the stream's seed and its own number."""

    kind: str
    seed: int  # 0 where each is drawn from its number alone
    numbers: range

    def share(self, share: float, *, least: int = 1) -> range:
        """The first numbers of the stream: a share of all, and at least `least`."""
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


class Experiment(NamedTuple):
    """An experiment: its purpose, its module below `sim.experiments`, the digests and the options
    of the command line that its numbers depend on, and its seeds.
    """

    about: str
    module: str
    depends_on: tuple[str, ...]
    seeds: Seeds
    options: tuple[str, ...] = ()


def _scenes(count: int) -> dict[str, Stream]:
    return {"scenes": Stream("random scene", 2026, range(count))}


def _hands(seed: int) -> dict[str, Stream]:
    """The hands of the nominal scene."""
    return {"hands": Stream("hands", seed, range(1))}


def _letters(seed: int) -> dict[str, Stream]:
    """Demonstrations of written letters, five of each."""
    return {"letters": Stream("written letter", seed, range(5))}


# The constants of separation were chosen on these scenes.
TUNED_SCENES = {"scenes": Stream("random scene", 2019, range(100))}
SHIPPED = Stream("demonstration", 1, range(1, 6))
_SHIPPED = {"demonstrations": SHIPPED}
_IN_SPACE = {"letters": Stream("letter in space", 3, range(4))}
# The ridge of ProMP was chosen on the letters of seed 0.
_WRITTEN = Seeds(_letters(1), tuning=_letters(0))
_TUNED_HANDS = {"people": Stream("moving hands", 0, range(3)), "stops": Stream("sudden stop", 0, range(24))}
_TEACHERS = {**_SHIPPED, "teachers": Stream("moving hands", 0, range(100, 105))}

ALL = ("core", "learning", "kmp")

EXPERIMENTS: Mapping[str, Experiment] = {
    "hands": Experiment(
        "the soldering task through the running service: as learned, and adapted to new places (Figures 4 and 5)",
        "hands",
        ALL,
        Seeds(_hands(7) | _scenes(40), tuning=TUNED_SCENES, learned=_SHIPPED),
    ),
    "statistics": Experiment(
        "100 random scenes whose places are taught, beside rivals, some of which need no demonstration",
        "statistics",
        ALL,
        Seeds(_scenes(100), tuning=TUNED_SCENES, learned=_SHIPPED),
    ),
    "people": Experiment(
        "learned skills on modelled people who did not demonstrate, beside seven rivals with the same places",
        "people.comparison",
        ALL,
        Seeds(
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
        ("group", "hands"),
    ),
    "partners": Experiment(
        "what `thirdhand learn` makes of recordings of real third hands, and of made tasks that are not soldering",
        "partners",
        ALL,
        Seeds(
            {kind: Stream(f"made task {kind}", 1, range(18, 24)) for kind in KINDS},
            tuning={kind: Stream(f"made task {kind}", 0, range(12)) for kind in KINDS},
            learned={kind: Stream(f"made task {kind}", 1, range(12, 18)) for kind in KINDS},
        ),
        ("data",),
    ),
    "motion": Experiment(
        "how the tool follows moving hands: error, lag, smoothness, stops, beside rivals",
        "motion",
        ALL,
        Seeds(
            {
                "people": Stream("moving hands", 0, range(200, 203)),
                "stops": Stream("sudden stop", 0, range(200, 224)),
                **_hands(Scene().seed),
            },
            tuning=_TUNED_HANDS,
            learned=_TEACHERS,
        ),
        ("arm",),
    ),
    "motion-of-others": Experiment(
        "the same with recorded hands: `motion --hands DIR`",
        "motion",
        ALL,
        Seeds({}, tuning=_TUNED_HANDS, learned=_TEACHERS),  # evaluated on recordings
        ("arm", "hands"),
    ),
    "separation": Experiment(
        "how near the arm comes to hands and how fast, in random scenes and with hands thrust in its way",
        "separation",
        ("core", "learning"),
        Seeds(_scenes(100), tuning=TUNED_SCENES),
    ),
    "faults": Experiment(
        "what happens when service, tracker, network, router, scribe or disk fail: time to rest, path, loss",
        "load.faults",
        ("core", "learning"),
        Seeds(_hands(Scene().seed)),
        ("arm",),
    ),
    "letters": Experiment(
        "adaptation of handwritten letters (Figure 1)", "reproduction.letters", ("kmp",), _WRITTEN, ("letters",)
    ),
    "promp": Experiment(
        "KMP beside ProMP on the same letters (Figure 2), and what each costs as the input's dimension grows",
        "reproduction.promp",
        ("kmp",),
        Seeds(_letters(1) | {"functions": Stream("random function", 0, range(5))}, tuning=_WRITTEN.tuning),
        ("letters",),
    ),
    "correlation": Experiment(
        "correlations learned from a reward by policy improvement, with a via-point kept (Figure 3)",
        "reproduction.correlation",
        ("kmp",),
        Seeds(_IN_SPACE | {"points": Stream("via-point", 0, range(2))}),
    ),
    "runs": Experiment(
        "ten runs of that search with one letter and one via-point (Figure 3(c))",
        "reproduction.runs",
        ("kmp",),
        Seeds(_IN_SPACE | {"searches": Stream("search", 0, range(10))}),
    ),
    "table": Experiment(
        "DMP, ProMP, mixture regression and KMP on the same letters (Table I)",
        "reproduction.table",
        ("kmp",),
        _WRITTEN,
        ("letters",),
    ),
    "phase": Experiment(
        "hands that pause and go back pause and reverse the robot",
        "phase",
        ("core", "learning"),
        Seeds(_hands(11), learned=_SHIPPED),
    ),
    "orientation": Experiment(
        "the tool turns the glass to the eyes: orientation predicted with the position, and followed",
        "orientation",
        ALL,
        Seeds(_hands(31) | _scenes(5), tuning=TUNED_SCENES, learned=_SHIPPED),
    ),
    "demonstrations": Experiment(
        "error against the number of demonstrations",
        "demonstrations",
        ("learning", "kmp"),
        Seeds(
            _scenes(40) | {"demonstrations": Stream("demonstration", 1, range(21, 26))},
            tuning=TUNED_SCENES,
            learned={
                "demonstrations": Stream("demonstration", 1, range(1, 21)),
                "orders": Stream("order", 0, range(4)),
            },
        ),
    ),
}
