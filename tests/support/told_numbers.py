"""Reads the numbers that a page tells, and holds each against where it is from: a result in
recordings/experiments, or a setting.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

from support.paths import ROOT

RESULTS = ROOT / "recordings" / "experiments"
COUNTED = ("two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")
WORDS = {**{word: n for n, word in enumerate(COUNTED, 2)}, "eighteen": 18}
NUMBER = re.compile(rf"(?<![\w.-])-?\d+(?: \d{{3}}\b)*(?:\.\d+)?|\b(?:{'|'.join(WORDS)}|half|third|fifth)\b", re.I)
LINKED = re.compile(r"\]\([^)]*\)")  # where a link goes to


@cache
def result(name: str) -> Any:
    """The JSON of an experiment."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class AtMost:
    """A result told as a bound: rounded up."""

    value: float


Source: TypeAlias = "float | AtMost | str"  # a result; or a setting or reference as it is told, which is no result


def of(path: str, scale: float = 1.0) -> float:
    """A result by experiment and keys, times a scale: "phase/ours/way_gone_back_mm"."""
    name, *keys = path.split("/")
    value = result(name)
    for key in keys:
        value = value[int(key)] if isinstance(value, list) else value[key]
    return scale * float(value)


def told(text: str) -> list[str]:
    """The numbers of a text, in order."""
    return NUMBER.findall(LINKED.sub("]", text))


def agrees(printed: str, source: Source) -> bool:
    """Whether a number is its source, to the digits printed."""
    if isinstance(source, str):
        return printed.lower() == source
    if printed.lower() in WORDS:
        return source == WORDS[printed.lower()]
    if not re.fullmatch(r"[-\d. ]+", printed):
        return False
    digits = printed.replace(" ", "")
    value, unit = float(digits), 10.0 ** -len(digits.partition(".")[2])
    if isinstance(source, AtMost):
        return -1e-9 < value - source.value < unit
    return abs(value - source) <= unit / 2 + 1e-9


def blocks(page: str) -> list[str]:
    """The page's paragraphs, headings, rows of tables, and points of lists, each on one line."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return [" ".join(block.split()) for block in re.split(r"\n\s*\n|\n(?=[|*])|(?<=\.png\))\n", text)]


def wrong(block: str, sources: list[Source]) -> list[str]:
    """What of a paragraph is not what its sources say."""
    numbers = told(block)
    found = [f"{number} is {one}" for number, one in zip(numbers, sources, strict=False) if not agrees(number, one)]
    if len(numbers) != len(sources):
        found.append(f"{len(sources)} sources for {numbers}")
    return [f"{block[:40]}: {one}" for one in found]
