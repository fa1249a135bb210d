"""The notes of a recording as sentences, for the viewer's log."""

from __future__ import annotations

from typing import Any

import msgspec

from service.contract.explain import in_file

_ORDERS = {
    "hold": "An operator stopped the arm; it stays until resumed.",
    "resume": "An operator let the arm go on.",
    "reset": "An operator ended the fault.",
}
_ASKED = {"via_points": "Teaching", "skill": "Loading a skill", **{name: f"A request to {name}" for name in _ORDERS}}


def sentence(note: str) -> str:
    """A note as a sentence; one that is plain text already stays as it is."""
    asked, _, rest = note.partition(" ")
    if asked not in _ASKED:
        return note
    outcome, _, why = rest.partition(": ")
    if outcome in ("refused", "failed"):
        return f"{_ASKED[asked]} {'was refused' if outcome == 'refused' else outcome}: {in_file(why)}"
    try:
        request = msgspec.json.decode(rest, type=dict[str, Any])
    except msgspec.DecodeError:
        return note
    if asked == "skill":
        return f"Skill {request.get('name')} is in force."
    return _taught(request) if asked == "via_points" else _ORDERS[asked]


def _taught(request: dict[str, Any]) -> str:
    match request:
        case {"op": "add", "points": [*points]}:
            return f"Taught: {_list([str(point.get('name')) for point in points if isinstance(point, dict)])}."
        case {"op": "remove", "names": [*names]}:
            return f"Forgotten: {_list(names)}."
        case {"op": "clear"}:
            return "All that was taught is forgotten."
    return "Via-points were asked for."


def _list(names: list[str]) -> str:
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)
