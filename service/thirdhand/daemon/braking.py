"""The last commands of a daemon: the planned stop, and the rest position, repeated in case messages
are lost.
"""

from __future__ import annotations

import time

from thirdhand.contract import cdr
from thirdhand.contract.messages import Attachment
from thirdhand.core.frame import Frame
from thirdhand.core.limiter.stage import Limiter
from thirdhand.daemon.cell_streams import CellStreams
from thirdhand.daemon.clock import Deadlines
from thirdhand.settings.config import Settings

# the rest position is repeated for this time, because some controllers extrapolate the last command
RESTS_S = 0.1


def brake(settings: Settings, frame: Frame, clock: Deadlines, streams: CellStreams) -> None:
    """Command the stop that follows the newest frame, tick by tick, and repeat the last command."""
    limiter = Limiter(settings.joints, settings.period_s)
    names = settings.joints.names
    q, dq, ddq = (
        frame[name].copy() for name in ("joints", "joint_velocities", "joint_accelerations")
    )
    index = int(frame["tick"])
    stamp_ns = clock.stamp_ns
    resting = 0
    while frame["commanded"] and resting < RESTS_S * settings.rate_hz:
        deadline, _ = clock.wait()
        if dq.any():
            q, dq, ddq, _ = limiter.stop(q, dq, ddq)
            index = deadline
            stamp_ns = clock.stamp_ns
        else:
            resting += 1
        attachment = cdr.encode_attachment(Attachment(index, time.time_ns(), 0))
        command = cdr.encode_command(stamp_ns, names, q.tolist(), dq.tolist())
        streams.publish("joints/command", command, attachment)
