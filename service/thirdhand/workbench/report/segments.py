"""The most probable segments of the task during a session."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thirdhand.core.skill.segments import MOST_SEGMENTS
from thirdhand.workbench.report.columns import Columns, runs

LEAST_S = 0.3  # a shorter segment is taken for hesitation, and merged with the one before


class Segment(NamedTuple):
    """A segment from one via-point to the next: start since the first tick and duration [s], and
    the median of its probability.
    """

    start_s: float
    lasts_s: float
    begins: str
    ends: str
    probable: float

    @property
    def name(self) -> str:
        """The via-points at which the segment begins and ends."""
        return f"{self.begins} to {self.ends}"


def segments(columns: Columns) -> list[Segment]:
    """The segments, in order; none if the skill has no via-points."""
    frames = columns.frames
    times = columns.times
    stretches = list[Segment]()
    numbers = np.where(frames["segment_belief"] > 0, frames["segment"], -1)
    in_force = (
        np.searchsorted([change.tick for change in columns.skills], frames["tick"], side="right")
        - 1
    )
    for begin, end in runs(in_force * (MOST_SEGMENTS + 1) + numbers):
        names = columns.skills[in_force[begin]].skill.model.names if in_force[begin] >= 0 else ()
        if not 0 <= numbers[begin] < len(names) - 1:
            continue
        begins = names[numbers[begin]]
        ends = names[numbers[begin] + 1]
        lasts_s = (end - begin) * columns.period_s
        before = stretches[-1] if stretches else None
        if before is not None and (
            (begins, ends) == (before.begins, before.ends) or lasts_s < LEAST_S
        ):
            stretches[-1] = before._replace(
                lasts_s=float(times[end - 1]) + columns.period_s - before.start_s
            )
        else:
            probable = float(np.median(frames["segment_belief"][begin:end]))
            stretches.append(Segment(float(times[begin]), lasts_s, begins, ends, probable))
    return stretches
