"""What goes out with a frame, live and in a recording alike: on which channels, which bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from service.contract import cdr
from service.contract.channels import Channel, sent_by_the_loop
from service.contract.messages import BASE, GRIPPER, PoseStamped, PoseWithCovarianceStamped
from service.core.frame import Frame
from service.core.skill.pose import CLOSED, UNKNOWN


def outgoing(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> Iterator[tuple[Channel, bytes]]:
    """What goes out with a frame, and on which channels; `joints` are the names of the commanded
    ones.

    Live and in a recording alike. Nothing is commanded before the arm is ready, and nothing aimed
    at without both hands.
    """
    for channel in sent_by_the_loop(int(frame["tick"])):
        payload = _OUTPUTS[channel.key](frame, stamp_ns, joints)
        if payload is not None:
            yield channel, payload


def _command(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if not frame["commanded"]:
        return None
    return cdr.encode_command(stamp_ns, joints, frame["joints"].tolist(), frame["joint_velocities"].tolist())


def _target(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if not frame["covariance"].any():
        return None
    covariance = [0.0] * 36
    for i, row in enumerate(frame["covariance"].tolist()):
        covariance[6 * i : 6 * i + 3] = row
    for i, row in enumerate(frame["orientation_covariance"].tolist()):
        covariance[6 * i + 21 : 6 * i + 24] = row
    position, orientation = tuple(frame["target"].tolist()), tuple(frame["orientation"].tolist())
    message = PoseWithCovarianceStamped(stamp_ns, BASE, position, orientation, tuple(covariance))
    return cdr.encode_pose_with_covariance(message)


def _setpoint(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    message = PoseStamped(
        stamp_ns, BASE, tuple(frame["setpoint"].tolist()), tuple(frame["setpoint_orientation"].tolist())
    )
    return cdr.encode_pose(message)


def _gripper(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    if frame["gripper"] == UNKNOWN:
        return None
    return cdr.encode_command(stamp_ns, (GRIPPER,), [float(frame["gripper"] == CLOSED)], [0.0])


_OUTPUTS: dict[str, Callable[[Frame, int, tuple[str, ...]], bytes | None]] = {
    "joints/command": _command,
    "tool/target": _target,
    "tool/setpoint": _setpoint,
    "gripper/command": _gripper,
}
