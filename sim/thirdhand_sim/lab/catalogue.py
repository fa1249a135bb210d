"""The experiments: module, dependencies and seeds of each, separately for tuning and evaluation.

An experiment is a module with `run(results, options) -> numbers`, and a row of `EXPERIMENTS`. The
first sentence of the module is its help. The command writes the seeds into the result. No number of
the service or of a rival may be chosen by data on which an experiment is evaluated.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from thirdhand_sim.made_tasks import TASK_KINDS
from thirdhand_sim.people import GROUP_SEEDS
from thirdhand_sim.scene import Scene

DRAWING = 0  # seed of the scatter of dots in a figure, and of resampling for an interval


class Stream(NamedTuple):
    """Random scenes, hands or people, each drawn from the stream's seed and its own number."""

    kind: str
    seed: int  # 0 if each is drawn from its number only
    numbers: range

    def share(self, share: float, *, least: int = 1) -> range:
        """The first numbers of the stream: a share of all, and at least `least`."""
        return self.numbers[: max(least, round(len(self.numbers) * share))]

    def moved(self, offset: int) -> Stream:
        """The stream of as many items, whose numbers are larger by an offset."""
        return self._replace(numbers=range(self.numbers.start + offset, self.numbers.stop + offset))

    def overlaps(self, other: Stream) -> bool:
        """True if two streams have an item in common."""
        return self[:2] == other[:2] and not set(self.numbers).isdisjoint(other.numbers)

    def __str__(self) -> str:
        return f"{self.kind} {self.seed}: {self.numbers[0]} to {self.numbers[-1]}"


class Seeds(NamedTuple):
    """Random streams of an experiment: for learning, for the choice of constants, for evaluation.

    `method` is the seed of the methods' own random choices.
    """

    evaluation: Mapping[str, Stream]
    tuning: Mapping[str, Stream] = MappingProxyType({})
    learned: Mapping[str, Stream] = MappingProxyType({})
    method: int = 0

    def moved(self, offset: int) -> Seeds:
        """The same with other numbers for evaluation, larger by an offset."""
        moved = {name: stream.moved(offset) for name, stream in self.evaluation.items()}
        return self._replace(evaluation=moved)

    def named(self) -> dict[str, object]:
        """The seeds as in a result's JSON."""
        parts = {"learned": self.learned, "tuning": self.tuning, "evaluation": self.evaluation}
        return {"method": self.method} | {
            part: {name: str(stream) for name, stream in streams.items()}
            for part, streams in parts.items()
            if streams
        }


class Experiment(NamedTuple):
    """An experiment: its module below `thirdhand_sim.lab`, the digests that its numbers depend on,
    its seeds, and the options of the command line that it uses.
    """

    module: str
    depends_on: tuple[str, ...]
    seeds: Seeds
    options: tuple[str, ...] = ()

    @property
    def about(self) -> str:
        """The experiment's purpose: the first sentence of its module, read without importing it."""
        path = Path(__file__).parent.joinpath(*self.module.split(".")).with_suffix(".py")
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        return " ".join(text.partition("\n\n")[0].split())


def _scenes(count: int) -> dict[str, Stream]:
    return {"scenes": Stream("random scene", 2026, range(count))}


def _hands(seed: int) -> dict[str, Stream]:
    """The hands of the nominal scene."""
    return {"hands": Stream("hands", 0, range(seed, seed + 1))}


def _letters(seed: int) -> dict[str, Stream]:
    """Demonstrations of written letters, five of each."""
    return {"letters": Stream("written letter", seed, range(5))}


# The constants of separation were chosen on these scenes.
TUNED_SCENES = {"scenes": Stream("random scene", 2019, range(100))}
SHIPPED_TAKES = Stream("demonstration", 1, range(1, 6))
_SHIPPED = {"demonstrations": SHIPPED_TAKES}
# The ridge of ProMP was chosen on the letters of seed 0.
_WRITTEN = Seeds(_letters(1), tuning=_letters(0))
_TUNED_HANDS = {
    "people": Stream("moving hands", 0, range(3)),
    "stops": Stream("sudden stop", 0, range(24)),
}
_TEACHERS = {**_SHIPPED, "teachers": Stream("moving hands", 0, range(100, 105))}

ALL = ("core", "learning", "kmp")
CORE = ("core", "learning")
KMP = ("kmp",)
_TEST, _TUNING, _LEARNED = (GROUP_SEEDS[group] for group in ("test", "tuning", "demonstrations"))
_PEOPLE = Seeds(
    {
        "people": Stream("person", _TEST, range(24)),
        "breaking": Stream("breaking scene", _TEST, range(20)),
    },
    tuning={
        "people": Stream("person", _TUNING, range(10)),
        "breaking": Stream("breaking scene", _TUNING, range(10)),
    },
    learned={"people": Stream("person", _LEARNED, range(6))},
)
_PARTNERS = Seeds(
    {kind: Stream(f"made task {kind}", 1, range(18, 24)) for kind in TASK_KINDS},
    tuning={kind: Stream(f"made task {kind}", 0, range(12)) for kind in TASK_KINDS},
    learned={kind: Stream(f"made task {kind}", 1, range(12, 18)) for kind in TASK_KINDS},
)
_FOLLOWED = {
    "people": Stream("moving hands", 0, range(200, 203)),
    "stops": Stream("sudden stop", 0, range(200, 224)),
    "small": Stream("small motion", 0, range(200, 202)),
}
_OTHERS = Seeds({}, tuning=_TUNED_HANDS, learned=_TEACHERS)  # evaluated on recordings
_SENSITIVITY = Seeds(  # an item of each stream for each seed of a session
    {},
    tuning={
        "people": Stream("moving hands", 0, range(300, 306)),
        "stops": Stream("sudden stop", 0, range(300, 306)),
        "disturbed": Stream("disturbed hands", 5, range(6)),
        "hands": Stream("hands", 0, range(300, 306)),
        "implausible": Stream("implausible samples", 8, range(6)),
    },
    learned=_SHIPPED,
)

EXPERIMENTS: Mapping[str, Experiment] = {
    "hands": Experiment(
        "hands", ALL, Seeds(_hands(7) | _scenes(40), tuning=TUNED_SCENES, learned=_SHIPPED)
    ),
    "statistics": Experiment(
        "statistics", ALL, Seeds(_scenes(100), tuning=TUNED_SCENES, learned=_SHIPPED)
    ),
    "people": Experiment("people.comparison", ALL, _PEOPLE, ("group", "hands")),
    "partners": Experiment("partners", ALL, _PARTNERS, ("data",)),
    "motion": Experiment(
        "motion", ALL, _OTHERS._replace(evaluation=_FOLLOWED | _hands(Scene().seed)), ("arm",)
    ),
    "motion-of-others": Experiment("motion", ALL, _OTHERS, ("arm", "hands")),
    "separation": Experiment("separation", CORE, Seeds(_scenes(100), tuning=TUNED_SCENES)),
    "seams": Experiment(
        "seams",
        ("core", "wishes"),
        Seeds(
            {"policies": Stream("policy", 0, range(100, 103))},
            tuning={"policies": Stream("policy", 0, range(2))},
        ),
    ),
    "faults": Experiment("load.faults", CORE, Seeds(_hands(Scene().seed)), ("arm",)),
    "letters": Experiment("reproduction.letters", KMP, _WRITTEN, ("letters",)),
    "table": Experiment("reproduction.table", KMP, _WRITTEN, ("letters",)),
    "sensitivity": Experiment("sensitivity", ALL, _SENSITIVITY),
}


def overlap(name: str, offset: int) -> str:
    """The streams of tuning or learning that an experiment's evaluation, moved by an offset, would
    use too, in words; empty if there is none.
    """
    used = [
        stream
        for experiment in EXPERIMENTS.values()
        for stream in (*experiment.seeds.tuning.values(), *experiment.seeds.learned.values())
    ]
    moved = EXPERIMENTS[name].seeds.moved(offset).evaluation.values()
    common = {str(stream) for stream in used if any(map(stream.overlaps, moved))}
    return " and ".join(sorted(common))
