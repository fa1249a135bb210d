"""A cell as pages show it: the newest status in the words of their buttons, and their orders."""

from __future__ import annotations

import contextlib
import re
import time
from typing import Any

import zenoh

from thirdhand.client import Client, RefusedError, UncertainError, decoded
from thirdhand.contract import channels
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.incidents import ORDERS, in_brief, title
from thirdhand.contract.messages import BASE, SceneObject, WireError
from thirdhand.contract.requests import Reply, Status

MAX_STATUS_BYTES = 262_144  # a daemon's has 3 to 10 kB, and more with many via-points
_COMMAND = re.compile(rf"(by |before )?thirdhand ({'|'.join(ORDERS)})")
SHOWN_FIELDS = (
    "mode",
    "reason",
    "because",
    "hands_m",
    "tool_m",
    "target_m",
    "std_m",
    "segment",
    "segment_belief",
    "demonstrated_m",
    "hands_at_m",
    "trackers",
)


class Latest:
    """The newest status of the daemon, its age, and the objects on the bench."""

    def __init__(self, session: zenoh.Session, cell: str, first: Status | None = None) -> None:
        self._status = first
        self._at = time.monotonic()
        self._objects: tuple[SceneObject, ...] = ()
        self._subscribers = [
            session.declare_subscriber(channels.key(cell, suffix), take)
            for suffix, take in (("status", self._take), ("objects", self._take_objects))
        ]

    def _take(self, sample: zenoh.Sample) -> None:
        if len(sample.payload) > MAX_STATUS_BYTES:
            return
        with contextlib.suppress(RefusedError):
            self._status = decoded(sample.payload.to_bytes(), Status)
            self._at = time.monotonic()

    def _take_objects(self, sample: zenoh.Sample) -> None:
        with contextlib.suppress(WireError):  # the daemon reports them
            self._objects = channels.BY_KEY["objects"].codec.decode(sample.payload.to_bytes())

    def mapping(self, frame: str) -> tuple[float, ...] | None:
        """The pose of a tracker's frame in base, x y z [m] and x y z w; None if there is none."""
        known = self._status.trackers.get(frame) if self._status else None
        return tuple(known) if known else None

    def objects(self) -> list[dict[str, Any]]:
        """The objects on the bench: name, shape, position [m], size [m], colour, `held`: true if
        the position is in a frame of the arm, which holds it.
        """
        fields = ("name", "shape", "position", "size", "colour")
        return [
            {name: getattr(item, name) for name in fields} | {"held": item.frame_id != BASE}
            for item in self._objects
        ]

    def summary(self) -> dict[str, Any]:
        """Mode, reason, its title and explanation, remedy by the page's buttons, positions [m], age
        [s], URL and process of the live view, and further facts in one line; empty before the first
        status.
        """
        now = self._status
        age_s = time.monotonic() - self._at
        if now is None:
            return {}
        hands = ", ".join(f"{side} hand {age:.0f} ms old" for side, age in now.hand_age_ms.items())
        near = f"{100 * now.hand_distance_m:.0f} cm to the nearest, " if hands else ""
        facts = (
            f"{hands or 'no hands seen'}; {near}{now.rate_hz:.0f} Hz, {now.missed} missed; skill "
            f"{now.skill}"
        )
        values = {name: getattr(now, name) for name in SHOWN_FIELDS} | {"title": title(now.reason)}
        remedy = _COMMAND.sub(
            lambda found: (
                f"{found[1]}pressing {found[2].title()}"
                if found[1]
                else f"press {found[2].title()}"
            ),
            now.remedy,
        )
        live = [now.scribe.get("live"), now.scribe.get("pid")]
        return values | {"remedy": remedy, "age_s": age_s, "live": live, "facts": facts}


def corrected(client: Client, given: str) -> tuple[bool, str]:
    """True if the daemon carried out a page's correction, and its answer in words. `given` is
    `undo`, or the tool's position x y z [m], for the hands of this moment.
    """
    try:
        if given == "undo":
            reply = client.undo_correction()
        else:
            x, y, z = (float(value) for value in given.split())
            reply = client.correct((x, y, z), hands="now")
    except (ExplainedError, ValueError) as error:
        return False, _failed("correct", error)
    correction = reply.correction
    text = (
        ""
        if correction is None
        else f"{correction.name} {'undone' if correction.undone else 'in force'}: {correction.text}"
    )
    return True, f"{text}. Resume lets the tool go there" + f"; {reply.note}" * bool(reply.note)


def carried_out(client: Client, order: str, by: str = "") -> tuple[bool, str]:
    """True if the daemon carried out hold, resume or reset, and its answer in words. `by` names the
    holder of a hold, or whose hold ends.
    """
    try:
        reply: Reply = getattr(client, order)(*([by] if by else []))
    except ExplainedError as error:
        return False, _failed(order, error)
    now = in_brief(reply.mode, reply.reason).replace("_", " ")
    note = f"; {reply.note}" if reply.note else ""
    return True, f"{order} carried out at tick {reply.tick}; mode then: {now}{note}"


def _failed(order: str, error: Exception) -> str:
    """The failure of an order, in words."""
    return (
        f"{order}: {error}"
        if isinstance(error, UncertainError)
        else f"{order} was NOT carried out: {error}"
    )
