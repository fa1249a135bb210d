"""Notes of a recording as sentences, for the viewer's log."""

from __future__ import annotations

from typing import Any

import msgspec

from thirdhand.contract.explain import in_file
from thirdhand.contract.incidents import ORDERS

_REQUESTS = {
    "via_points": "Teaching",
    "skill": "Loading a skill",
    **{name: f"A request to {name}" for name in ORDERS},
}


def sentence(note: str) -> str:
    """A note as a sentence; plain text is returned unchanged."""
    name, _, content = note.partition(" ")
    if name not in _REQUESTS:
        return note
    outcome, _, why = content.partition(": ")
    if outcome in ("refused", "failed"):
        return (
            f"{_REQUESTS[name]} {'was refused' if outcome == 'refused' else outcome}: "
            f"{in_file(why)}"
        )
    try:
        request = msgspec.json.decode(content, type=dict[str, Any])
    except msgspec.DecodeError:
        return note
    match request:
        case _ if name in ORDERS:
            return f"{ORDERS[name].capitalize()}."
        case _ if name == "skill":
            return f"Skill {request.get('name')} is in force."
        case {"op": "add", "points": [*points]}:
            return (
                "Taught: "
                f"{_list([str(point.get('name')) for point in points if isinstance(point, dict)])}."
            )
        case {"op": "remove", "names": [*names]}:
            return f"Removed: {_list(names)}."
        case {"op": "clear"}:
            return "All via-points were removed."
    return "The via-points were listed."


def _list(names: list[str]) -> str:
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)
