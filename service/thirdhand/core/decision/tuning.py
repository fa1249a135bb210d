"""Tuned numbers of the decision.

docs/tuning.md has them as a table, with their measured sensitivity. The comment above one has the
range of sensible values, and what more and less of it are expected to do.
"""

from __future__ import annotations

from typing import NamedTuple


class DecisionTuning(NamedTuple):
    """Tuned numbers of the decision."""

    # A tool that is stuck: it comes no nearer to its target.
    # 5e-3 to 0.05. More: fewer tools are stuck. Less: a lag looks stuck.
    # a tool nearer than this is at its target; a target that moves farther is a new one
    stuck_gap_m: float = 0.01
    # 0.3 to 3. More: a stuck tool is noticed later. Less: slow progress looks stuck.
    # time within which progress is expected, toward a target or out of a thing
    stuck_s: float = 0.8
    # 0.02 to 0.3. More: slow progress looks stuck. Less: a stuck tool is missed.
    progress_share: float = 0.08  # expected progress, as share of the distance
