"""Messages that are read before the deadline of their tick."""

from __future__ import annotations

from support.cell import until
from thirdhand.client import Publisher, endpoints, open_session
from thirdhand.contract import cdr
from thirdhand.contract.messages import BASE, JointState, PoseStamped
from thirdhand.core.frame import Event
from thirdhand.daemon.cell_streams import Arrivals, CellStreams, heard
from thirdhand.settings.config import Settings

SETTINGS = Settings()
JOINTS = SETTINGS.joints.names


def test_early_messages_are_kept_but_for_older_states_of_the_arm() -> None:
    with open_session(listen=["tcp/127.0.0.1:0"]) as listening:
        arrivals = {channel.key: Arrivals() for channel in heard(SETTINGS)}
        streams = CellStreams(listening, SETTINGS, arrivals=arrivals, failed=print)
        with open_session(connect=list(endpoints(listening))) as session:
            hand = Publisher(session, SETTINGS.cell, "hands/left")
            arm = Publisher(session, SETTINGS.cell, "joints/state")
            events: list[Event] = []
            for stamp_ns in (1, 2):
                pose = PoseStamped(stamp_ns, BASE, (0.1 * stamp_ns, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
                state = JointState(stamp_ns, JOINTS, SETTINGS.arm.posture, (0.0,) * len(JOINTS))
                hand.put(cdr.encode_pose(pose))
                arm.put(cdr.encode_joints(state))

                def is_read(stamp_ns: int = stamp_ns) -> bool:
                    events[:] = streams.receive(events)
                    kinds = [event.kind for event in events if event.value.stamp_ns == stamp_ns]
                    return sorted(kinds) == ["hands/left", "joints/state"]

                until(is_read)
        streams.close()
    stamps = {
        kind: [event.value.stamp_ns for event in events if event.kind == kind]
        for kind in ("hands/left", "joints/state")
    }
    assert stamps == {"hands/left": [1, 2], "joints/state": [2]}
