"""A status as a daemon publishes it."""

from __future__ import annotations

from thirdhand.contract.requests import Percentiles, Status


def holding(cell: str, tick: int) -> Status:
    """The status of a cell that has not seen a hand since it started."""
    numbers = {
        "tick": tick,
        "rate_hz": 500.0,
        "missed": 0,
        "hand_distance_m": 3.0,
        "hand_limit_m_s": 1.5,
    }
    return Status(
        cell=cell,
        mode="hold",
        reason="no_hands",
        skill="",
        version="",
        realtime=False,
        memory_locked=False,
        awake=False,
        **numbers,
        **dict.fromkeys(("flags", "via_points", "endpoints"), ()),
        **{name: {} for name in ("rejected", "hand_age_ms", "scribe")},
        **dict.fromkeys(("lateness_us", "work_us", "latency_ms"), Percentiles()),
    )  # type: ignore[arg-type]
