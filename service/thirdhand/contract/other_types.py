"""The types of messages that arrive where another type is needed, as far as their bytes show them.

Not for the loop: each layout is tried in turn.
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from thirdhand.contract.cdr import Reader
from thirdhand.contract.messages import WireError

# A layout is a sequence of fields, [in brackets] of an array: `h` header, `t` string, and as in
# `struct` a count of numbers d, f, i or B.
_TYPE_LAYOUTS = {
    "geometry_msgs/msg/PointStamped or Vector3Stamped": "h3d",
    "geometry_msgs/msg/QuaternionStamped": "h4d",
    "geometry_msgs/msg/TwistStamped or WrenchStamped": "h6d",
    "geometry_msgs/msg/PoseStamped": "h7d",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "h43d",
    "geometry_msgs/msg/TransformStamped": "ht7d",
    "geometry_msgs/msg/PoseArray": "h[7d]",
    "nav_msgs/msg/Odometry": "ht85d",
    "nav_msgs/msg/Path": "h[h7d]",
    "sensor_msgs/msg/JointState": "h[t][d][d][d]",
    "sensor_msgs/msg/CompressedImage": "ht[B]",
    "sensor_msgs/msg/Image": "h2itBi[B]",
    "std_msgs/msg/String": "t",
    "std_msgs/msg/Float64MultiArray": "[t2i]i[d]",
    "tf2_msgs/msg/TFMessage": "[ht7d]",
    "visualization_msgs/msg/Marker": "ht3i10d4f2iB[3d][4f]tht[B][2f]ttt[B]B",
    "visualization_msgs/msg/MarkerArray": "[ht3i10d4f2iB[3d][4f]tht[B][2f]ttt[B]B]",
    # numbers only, which fit any bytes of their length
    "std_msgs/msg/Bool": "B",
    "std_msgs/msg/Float32 or Int32": "i",
    "std_msgs/msg/Float64 or Int64": "d",
    "geometry_msgs/msg/Point, Vector3 or Pose2D": "3d",
    "geometry_msgs/msg/Quaternion": "4d",
    "geometry_msgs/msg/Twist, Accel or Wrench": "6d",
    "geometry_msgs/msg/Pose or Transform": "7d",
    "geometry_msgs/msg/PoseWithCovariance": "43d",
}
_FIELD = re.compile(r"(\d*)([htdfiB])|\[(\w+|\w+(?:\[\w+\]\w*)+)\]")
_ALIGN = {"d": 8, "f": 4, "i": 4, "B": 1}
_DEFAULT_ENCODING = "zenoh/bytes"
_OWN_ENCODING = "application/cdr"
_LONGEST_ENCODING = 100  # characters that are quoted


class Refusal(NamedTuple):
    """A message that cannot be decoded: the problem, the needed type, the bytes and their Zenoh
    encoding.
    """

    problem: str
    needed: str
    data: bytes = b""
    encoding: str = ""

    def __str__(self) -> str:
        """The problem in words, with the type that arrived as far as it is known."""
        kind = likely_type(self.data)
        is_named = self.encoding not in ("", _DEFAULT_ENCODING, _OWN_ENCODING)
        if kind in re.split(", | or ", self.needed):
            return self.problem
        if not kind and not is_named:
            return f"{self.problem}; {self.needed} needed"
        fitting = f" that fit {kind}" if kind else ""
        named = f" sent as {self.encoding[:_LONGEST_ENCODING]!r}" if is_named else ""
        return f"{len(self.data)} bytes{fitting}{named}; {self.needed} needed: {self.problem}"


def likely_type(data: bytes) -> str:
    """The type whose layout the bytes of a message have; empty if it is none of those known."""
    if data[:1] in (b"{", b"["):
        return "JSON"
    return next((kind for kind, layout in _TYPE_LAYOUTS.items() if _fits(data, layout)), "")


def _fits(data: bytes, layout: str) -> bool:
    try:
        reader = Reader(data)
        _read(reader, layout)
    except WireError:
        return False
    return reader.at == len(data)


def _read(reader: Reader, layout: str) -> None:
    for count, field, inner in _FIELD.findall(layout):
        if field == "h":
            reader.header()
        elif field == "t":
            reader.string()
        elif field:
            reader.unpack(struct.Struct(f"<{count}{field}"), _ALIGN[field])
        elif re.fullmatch(r"\d*[dfiB]", inner):
            reader.skip(struct.Struct(f"<{inner}"), _ALIGN[inner[-1]])
        else:
            for _ in range(reader.items()):
                _read(reader, inner)
