"""Objects on the bench as `visualization_msgs/msg/MarkerArray` in CDR, which ROS 2 tools and
Foxglove draw directly. Only boxes, ellipsoids and cylinders are supported.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from thirdhand.contract import cdr
from thirdhand.contract.messages import SceneObject, WireError

SHAPES = {1: "box", 2: "ball", 3: "cylinder"}  # by the number of a Marker's type
NUMBERS = {shape: number for number, shape in SHAPES.items()}
LARGEST = 16_384  # bytes
MOST_OBJECTS = 32
LARGEST_M = 10.0
LONGEST_MARKER = 64
_ADD = 0  # the action that adds or changes a marker; others remove it
_KIND = struct.Struct("<iii")
_COLOUR = struct.Struct("<4f")
_PLACED = struct.Struct("<10d")
_POINT = struct.Struct("<3d")
_UV = struct.Struct("<2f")
_COUNT = struct.Struct("<I")
_BYTE = struct.Struct("<B")
_LIFETIME = struct.Struct("<II")


def encode_objects(stamp_ns: int, objects: Sequence[SceneObject]) -> bytes:
    """CDR bytes of a MarkerArray with one marker for each object."""
    out = cdr.Writer()
    out.pack(_COUNT, len(objects), align=4)
    for scene_object in objects:
        out.header(stamp_ns, scene_object.frame_id)
        out.string(scene_object.name)
        out.pack(_KIND, 0, NUMBERS[scene_object.shape], _ADD, align=4)
        out.pack(
            _PLACED, *scene_object.position, *scene_object.orientation, *scene_object.size, align=8
        )
        out.pack(_COLOUR, *scene_object.colour, align=4)
        out.pack(_LIFETIME, 0, 0, align=4)  # unlimited
        out.pack(_BYTE, 0, align=1)  # not locked to its frame
        out.pack(_COUNT, 0, align=4)  # points
        out.pack(_COUNT, 0, align=4)  # colours of the points
        out.string("")  # texture
        out.header(0, "")
        out.string("")
        out.pack(_COUNT, 0, align=4)
        out.pack(_COUNT, 0, align=4)  # texture coordinates
        out.string("")  # text
        out.string("")  # mesh
        out.string("")
        out.pack(_COUNT, 0, align=4)
        out.pack(_BYTE, 0, align=1)
    return bytes(out)


def decode_objects(data: bytes) -> tuple[SceneObject, ...]:
    """The objects in the CDR bytes of a MarkerArray; markers of other kinds are ignored.

    Raises WireError.
    """
    reader = cdr.Reader(data, LARGEST)
    objects = []
    for _ in range(reader.items()):
        _, frame = reader.header()
        name = reader.string()
        _, kind, action = reader.unpack(_KIND, 4)
        placed = reader.unpack(_PLACED, 8)
        colour = reader.unpack(_COLOUR, 4)
        reader.unpack(_LIFETIME, 4)
        reader.unpack(_BYTE, 1)
        reader.skip(_POINT, 8)
        reader.skip(_COLOUR, 4)
        reader.string()
        reader.header()
        reader.string()
        reader.skip(_BYTE, 1)
        reader.skip(_UV, 4)
        for _ in range(3):
            reader.string()
        reader.skip(_BYTE, 1)
        reader.unpack(_BYTE, 1)
        if action == _ADD and kind in SHAPES:
            objects.append(
                checked(
                    SceneObject(
                        name, SHAPES[kind], frame, placed[:3], placed[3:7], placed[7:], colour
                    )
                )
            )
    reader.end()
    if len(objects) > MOST_OBJECTS or len({scene_object.name for scene_object in objects}) < len(
        objects
    ):
        raise WireError(
            f"{len(objects)} objects; up to {MOST_OBJECTS}, each with a name of its own, accepted"
        )
    return tuple(objects)


def checked(one: SceneObject) -> SceneObject:
    """The object, if viewers can draw it. Raises WireError."""
    numbers = (*one.position, *one.size)
    if (
        not all(math.isfinite(value) and abs(value) <= LARGEST_M for value in numbers)
        or min(one.size) <= 0
    ):
        raise WireError(
            f"object {one.name[:LONGEST_MARKER]!r}: a position or size beyond {LARGEST_M:g} m, or "
            "no "
            "size"
        )
    if not abs(math.hypot(*one.orientation) - 1.0) < 1e-2:
        raise WireError(f"object {one.name[:LONGEST_MARKER]!r}: a quaternion of norm 1 needed")
    if not 0 < len(one.name) <= LONGEST_MARKER:
        raise WireError(
            f"an object with a name of {len(one.name)} letters, 1 to {LONGEST_MARKER} accepted"
        )
    if not all(0.0 <= value <= 1.0 for value in one.colour):
        raise WireError(
            f"object {one.name!r}: a colour of red, green, blue and opacity, 0 to 1 each, needed"
        )
    return one
