"""A hand, or a headset's controller, that leads the tool while it pinches: wishes of the tool."""

from __future__ import annotations

import contextlib

import numpy as np
import zenoh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.client import Publisher
from thirdhand.contract import cdr, channels
from thirdhand.contract.messages import BASE, PoseStamped, WireError
from thirdhand.workbench.trackers.cell_view import Latest
from thirdhand.workbench.trackers.hand_message import PageHand
from thirdhand.workbench.trackers.pinch import is_pinched


class Lead:
    """Publisher of `tool/wish`: the tool moves and turns as one hand does since its pinch began.

    `side` is that hand, left or right. The pose of its frame in base is that of the daemon's
    status; until there is one, and before the first setpoint, nothing is wished.
    """

    def __init__(self, session: zenoh.Session, cell: str, side: str, latest: Latest) -> None:
        self.side = side
        self._latest = latest
        self._tool: PoseStamped | None = None
        self._begun: tuple[NDArray[np.float64], Rotation, PoseStamped] | None = None
        self._publisher = Publisher(session, cell, "tool/wish")
        self._subscriber = session.declare_subscriber(
            channels.key(cell, "tool/setpoint"), self._take
        )

    def _take(self, sample: zenoh.Sample) -> None:
        with contextlib.suppress(WireError):  # of another program than a daemon
            self._tool = cdr.decode_pose(sample.payload.to_bytes())

    def release(self) -> None:
        """End a pinch."""
        self._begun = None

    def follow(self, hand: PageHand, frame: str, stamp_ns: int) -> None:
        """Publish a wish if this hand, seen in a frame at a time, pinches."""
        mapping = self._latest.mapping(frame)
        is_kept = is_pinched(hand.pinch_m, self._begun is not None)
        if not is_kept or mapping is None or self._tool is None:
            self._begun = None
            return
        frame_turn = Rotation.from_quat(mapping[3:])
        position = frame_turn.apply(hand.position) + mapping[:3]
        turn = frame_turn * Rotation.from_quat(hand.orientation)
        if self._begun is None:
            self._begun = position, turn, self._tool
        began_at, began_turn, tool = self._begun
        moved = tool.position + position - began_at
        turned = turn * began_turn.inv() * Rotation.from_quat(tool.orientation)
        x, y, z = moved.tolist()
        a, b, c, d = turned.as_quat().tolist()
        self._publisher.put(cdr.encode_pose(PoseStamped(stamp_ns, BASE, (x, y, z), (a, b, c, d))))
