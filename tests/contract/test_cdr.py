"""The wire: bytes equal those of other ROS 2 implementations, and each malformed message or request
causes an error that names the position.
"""

from __future__ import annotations

import base64
import json
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from support.wam import JOINT_NAMES
from thirdhand.contract import cdr, channels, messages, requests
from thirdhand.contract.channels import EVENT_NUMBERS
from thirdhand.contract.ros2msg import schema
from thirdhand.core.frame import definitions

ROS = get_typestore(Stores.ROS2_HUMBLE)
FRAMES = ("", "b", "ba", "bas", "base", "base_", "base_l", "a/tracker/over there", "tête")
finite = st.floats(allow_nan=False, width=64)
stamps = st.integers(0, 2**32 * 10**9 - 1)
texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)


def _header(stamp_ns: int, frame: str) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    signed = (sec + 2**31) % 2**32 - 2**31  # the same bits
    time = ROS.types["builtin_interfaces/msg/Time"](signed, nanosec)
    return ROS.types["std_msgs/msg/Header"](time, frame)


def _pose(position: Any, orientation: Any) -> Any:
    point = ROS.types["geometry_msgs/msg/Point"]
    quaternion = ROS.types["geometry_msgs/msg/Quaternion"]
    return ROS.types["geometry_msgs/msg/Pose"](point(*position), quaternion(*orientation))


def _transform(stamp_ns: int, parent: str, child: str, translation: Any, orientation: Any) -> Any:
    vector = ROS.types["geometry_msgs/msg/Vector3"]
    quaternion = ROS.types["geometry_msgs/msg/Quaternion"]
    transform = ROS.types["geometry_msgs/msg/Transform"]
    return ROS.types["geometry_msgs/msg/TransformStamped"](
        _header(stamp_ns, parent), child, transform(vector(*translation), quaternion(*orientation))
    )


def _bytes(kind: str, *fields: Any) -> bytes:
    return bytes(ROS.serialize_cdr(ROS.types[kind](*fields), kind))


three = st.tuples(*[finite] * 3)
four = st.tuples(*[finite] * 4)


@given(stamps, st.sampled_from(FRAMES) | texts, three, four)
def test_poses_are_the_bytes_of_another_implementation(
    stamp_ns: int, frame: str, position: Any, orientation: Any
) -> None:
    message = messages.PoseStamped(stamp_ns, frame, position, orientation)
    data = cdr.encode_pose(message)
    assert data == _bytes(
        channels.POSE.type, _header(stamp_ns, frame), _pose(position, orientation)
    )
    assert cdr.decode_pose(data) == message


@given(
    stamps, st.sampled_from(FRAMES) | texts, three, four, st.lists(finite, min_size=36, max_size=36)
)
def test_poses_with_covariance_have_the_bytes_of_rosbags(
    stamp_ns: int, frame: str, position: Any, orientation: Any, covariance: list[float]
) -> None:
    message = messages.PoseWithCovarianceStamped(
        stamp_ns, frame, position, orientation, tuple(covariance)
    )
    data = cdr.encode_pose_with_covariance(message)
    pose = ROS.types["geometry_msgs/msg/PoseWithCovariance"](
        _pose(position, orientation), np.array(covariance)
    )
    assert data == _bytes(channels.POSE_WITH_COVARIANCE.type, _header(stamp_ns, frame), pose)
    assert cdr.decode_pose_with_covariance(data) == message


@given(stamps, st.sampled_from(FRAMES), st.lists(texts, max_size=9), st.data())
def test_joint_states_are_the_bytes_of_another_implementation(
    stamp_ns: int, frame: str, names: list[str], data: st.DataObject
) -> None:
    values = [data.draw(st.lists(finite, max_size=9)) for _ in range(3)]
    message = messages.JointState(stamp_ns, tuple(names), *map(tuple, values), frame_id=frame)
    encoded = cdr.encode_joints(message)
    assert encoded == _bytes(
        channels.JOINTS.type,
        _header(stamp_ns, frame),
        names,
        *(np.array(value, np.float64) for value in values),
    )
    assert cdr.decode_joints(encoded) == message


@given(st.booleans())
def test_bools_are_the_bytes_of_another_implementation(value: bool) -> None:
    data = cdr.encode_bool(value)
    assert data == _bytes(channels.BOOL.type, value)
    assert cdr.decode_bool(data) is value


@pytest.mark.parametrize(
    ("names", "position", "words"),
    [
        (("gripper",), (0.25,), ""),
        (("finger", "gripper"), (9.0, 1.0), ""),
        (("gripper",), (1.01,), "gripper at 1.01; 0 (open) to 1 (closed) needed"),
        (("gripper",), (math.nan,), "gripper at nan; 0 (open) to 1 (closed) needed"),
        (("finger",), (0.5,), "joints ['gripper'] missing among 1, finger"),
    ],
)
def test_a_wish_for_the_gripper_is_a_number_from_0_to_1(
    names: Any, position: Any, words: str
) -> None:
    data = cdr.encode_joints(messages.JointState(1, names, position, ()))
    if not words:
        assert channels.CLOSURE.decode(data) == position[names.index("gripper")]
        return
    with pytest.raises(messages.WireError, match=re.escape(words)):
        channels.CLOSURE.decode(data)


sizes = st.tuples(*[st.floats(1e-3, 10.0)] * 3)
shares = st.floats(0.0, 1.0, width=32)
turns = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda turn: math.hypot(*turn) > 0.1)


@st.composite
def a_thing(draw: st.DrawFn) -> messages.SceneObject:
    turn = draw(turns)
    return messages.SceneObject(
        draw(
            st.text(st.characters(codec="ascii", exclude_characters="\0"), min_size=1, max_size=20)
        ),
        draw(st.sampled_from(("box", "ball", "cylinder"))),
        draw(st.sampled_from(FRAMES)),
        draw(st.tuples(*[st.floats(-10.0, 10.0)] * 3)),
        tuple(value / math.hypot(*turn) for value in turn),
        draw(sizes),
        draw(st.tuples(*[shares] * 4)),
    )


@given(stamps, st.lists(a_thing(), max_size=5, unique_by=lambda thing: thing.name))
def test_things_are_the_bytes_of_another_implementation(
    stamp_ns: int, things: list[messages.SceneObject]
) -> None:
    data = channels.OBJECTS.encode(stamp_ns, things)
    read = ROS.deserialize_cdr(data, channels.OBJECTS.type)
    assert bytes(ROS.serialize_cdr(read, channels.OBJECTS.type)) == data
    assert [(item.ns, item.header.frame_id, item.scale.x) for item in read.markers] == [
        (thing.name, thing.frame_id, thing.size[0]) for thing in things
    ]
    assert channels.OBJECTS.decode(data) == tuple(things)
    if things:
        with pytest.raises(messages.WireError):
            channels.OBJECTS.decode(data[: len(data) // 2])


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"size": (0.1, 0.0, 0.1)}, "no size"),
        ({"position": (math.nan, 0.0, 0.0)}, "beyond 10 m"),
        ({"orientation": (0.0, 0.0, 0.0, 0.0)}, "norm 1"),
        ({"name": ""}, "1 to 64"),
        ({"colour": (2.0, 0.0, 0.0, 1.0)}, "0 to 1 each"),
    ],
)
def test_a_thing_that_cannot_be_is_refused_in_words(change: dict[str, Any], error: str) -> None:
    thing = messages.SceneObject(
        "board", "box", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.1, 0.1, 0.1), (0, 0, 0, 1)
    )
    with pytest.raises(messages.WireError, match=error):
        channels.OBJECTS.decode(channels.OBJECTS.encode(1, [thing._replace(**change)]))
    with pytest.raises(messages.WireError, match="a name of its own"):
        channels.OBJECTS.decode(channels.OBJECTS.encode(1, [thing, thing]))


@given(stamps, st.lists(finite, min_size=14, max_size=14))
def test_the_quick_command_is_the_same_bytes_as_the_general_one(
    stamp_ns: int, values: list[float]
) -> None:
    message = messages.JointState(stamp_ns, JOINT_NAMES, tuple(values[:7]), tuple(values[7:]))
    assert cdr.encode_command(stamp_ns, JOINT_NAMES, values[:7], values[7:]) == cdr.encode_joints(
        message
    )


@given(texts)
def test_texts_are_the_bytes_of_another_implementation(text: str) -> None:
    assert cdr.encode_string(text) == _bytes("std_msgs/msg/String", text)
    assert cdr.decode_string(cdr.encode_string(text)) == text


@given(stamps, st.lists(st.tuples(texts, texts, three, four), max_size=4))
def test_transforms_are_the_bytes_of_another_implementation(
    stamp_ns: int, items: list[Any]
) -> None:
    theirs = [_transform(stamp_ns, *item) for item in items]
    ours = cdr.encode_transforms(stamp_ns, [messages.Transform(*item) for item in items])
    assert ours == _bytes("tf2_msgs/msg/TFMessage", theirs)
    read = [
        (child, messages.PoseStamped(stamp_ns, parent, xyz, turn))
        for parent, child, xyz, turn in items
    ]
    slashless = [
        (child.lstrip("/"), pose._replace(frame_id=pose.frame_id.lstrip("/")))
        for child, pose in read
    ]
    assert cdr.decode_transforms(ours) == slashless
    for child, _ in slashless:
        assert cdr.decode_transforms(ours, (child,)) == [
            pair for pair in slashless if pair[0] == child
        ]


def test_each_frame_of_a_message_has_its_stamp_and_parent() -> None:
    frames = {
        "wrist": (1, "world"),
        "my_wrist": (2, "w"),
        "/wrist": (3, "/rig/1"),
        "wrist_2": (4, ""),
        "é": (5, "map"),
    }
    pose = (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)
    theirs = [_transform(stamp, parent, child, *pose) for child, (stamp, parent) in frames.items()]
    data = _bytes("tf2_msgs/msg/TFMessage", theirs)
    decoded = [
        (name, pose.stamp_ns, pose.frame_id)
        for name, pose in cdr.decode_transforms(data, ("wrist", "é"))
    ]
    assert decoded == [("wrist", 1, "world"), ("wrist", 3, "rig/1"), ("é", 5, "map")]
    assert cdr.decode_transforms(data, ("elbow",)) == []
    assert all(cdr.bytes_of_frame(child) in data for child in frames)


POSE = cdr.encode_pose(messages.PoseStamped(7, "base", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))
JOINTS = cdr.encode_joints(messages.JointState(7, JOINT_NAMES, (0.5,) * 7, ()))
COVARIANCE = cdr.encode_pose_with_covariance(
    messages.PoseWithCovarianceStamped(
        7, "base", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), (0.0,) * 36
    )
)
TRANSFORMS = cdr.encode_transforms(
    7, [messages.Transform("a", "b", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))] * 3
)
BOX = messages.SceneObject(
    "box", "box", "base", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), (1.0,) * 3, (1.0,) * 4
)
OBJECTS = channels.OBJECTS.encode(7, [BOX])
MESSAGES = [
    (POSE, cdr.decode_pose),
    (JOINTS, cdr.decode_joints),
    (COVARIANCE, cdr.decode_pose_with_covariance),
    (TRANSFORMS, cdr.decode_transforms),
]


# By the Python package of Cyclone DDS 11.0.1, final types, `serialize(use_version_2=True)`.
CDR2 = {
    b"\x07\x11": "AAcAAAEAAAACAAAABQAAAGJhc2UAAAAAFAAAAAIAAAACAAAAYQAAAAQAAABiY2QAAgAAAAAAAAAAAPA/AAAAAAAAAEA"
    "AAAAAAgAAAAAAAAAAAAhAAAAAAAAAEEA=",
    b"\x06\x10": "AAYAAAAAAAEAAAACAAAABWJhc2UAAAAAAAAAFAAAAAIAAAACYQAAAAAAAARiY2QAAAAAAj/wAAAAAAAAQAAAAAAAAAA"
    "AAAAAAAAAAkAIAAAAAAAAQBAAAAAAAAA=",
}


@pytest.mark.parametrize("numbers", CDR2)
def test_cdr2_is_read_in_both_byte_orders_with_any_options(numbers: bytes) -> None:
    state = messages.JointState(1_000_000_002, ("a", "bcd"), (1.0, 2.0), (), (3.0, 4.0), "base")
    data = base64.b64decode(CDR2[numbers])[4:]
    for number in numbers:
        for padding in range(4):
            header = bytes([0, number, 0xFF, 0xFC | padding])
            assert cdr.decode_joints(header + data + bytes(padding)) == state


@pytest.mark.parametrize(
    ("codec", "data"),
    [
        (channels.POSE, POSE),
        (channels.JOINTS, JOINTS),
        (channels.TRANSFORMS, TRANSFORMS),
        (channels.OBJECTS, OBJECTS),
    ],
)
def test_messages_of_a_big_endian_machine_are_read(codec: channels.Codec, data: bytes) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)  # its MarkerArray equals the service's
    big = store.serialize_cdr(
        store.deserialize_cdr(data, codec.type), codec.type, little_endian=False
    )
    assert codec.decode(bytes(big)) == codec.decode(data)


@pytest.mark.parametrize(("data", "decode"), MESSAGES)
def test_a_message_cut_anywhere_is_refused(data: bytes, decode: Any) -> None:
    for size in range(len(data)):
        with pytest.raises(messages.WireError):
            decode(data[:size])


@pytest.mark.parametrize(("data", "decode"), MESSAGES)
def test_a_message_may_be_padded_to_four_bytes_and_no_further(data: bytes, decode: Any) -> None:
    assert decode(data + bytes(3)) == decode(data)
    with pytest.raises(messages.WireError, match="4 bytes follow the message"):
        decode(data + bytes(4))


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b"", "header missing; plain CDR or CDR2 needed"),
        (b"\0\1", "header 00 01; plain CDR or CDR2 needed"),
        *((bytes([0, i]) + POSE[2:], "encoding PL_CDR, header 00 0") for i in (2, 3)),
        (b"\0\4\0\0<pose/>", "encoding XML, header 00 04 00 00; plain CDR or CDR2 needed"),
        *(
            (bytes([0, i]) + POSE[2:], "encoding DELIMITED_CDR2, header 00 ")
            for i in (8, 9, 0x14, 0x15)
        ),
        *(
            (bytes([0, i]) + POSE[2:], "encoding PL_CDR2, header 00 ")
            for i in (0xA, 0xB, 0x12, 0x13)
        ),
        (POSE[:12] + b"\xff\xff\xff\x7f" + POSE[16:], "a length of 2147483647 with "),
        (POSE[:16] + b"\xff\xfe\0\0\0" + POSE[21:], "a string that is not UTF-8"),
        (POSE[:-1], "bytes end before byte"),
    ],
)
def test_the_error_of_a_malformed_message_says_what_is_wrong(data: bytes, error: str) -> None:
    with pytest.raises(messages.WireError, match=re.escape(error)):
        cdr.decode_pose(data)


@given(st.permutations(range(7)), st.booleans())
def test_joints_are_found_in_any_order_among_others(order: list[int], moving: bool) -> None:
    names = ("gripper", *(JOINT_NAMES[i] for i in order))
    position = (9.0, *(float(i) for i in order))
    message = messages.JointState(
        0, names, position, tuple(-value for value in position) if moving else ()
    )
    ordered, velocity = messages.in_order(message, JOINT_NAMES)
    assert ordered == tuple(float(i) for i in range(7))
    assert velocity == (tuple(-float(i) for i in range(7)) if moving else (0.0,) * 7)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (
            messages.JointState(0, JOINT_NAMES[1:], (0.0,) * 6, ()),
            "joints ['wam/base_yaw_joint'] missing",
        ),
        (messages.JointState(0, JOINT_NAMES, (0.0,) * 6, ()), "7 names, 6 positions, 0 velocities"),
        (
            messages.JointState(0, JOINT_NAMES, (0.0,) * 7, (0.0,) * 3),
            "7 names, 7 positions, 3 velocities",
        ),
    ],
)
def test_a_joint_state_that_does_not_fit_the_arm_is_refused(
    message: messages.JointState, error: str
) -> None:
    with pytest.raises(messages.WireError, match=re.escape(error)):
        messages.in_order(message, JOINT_NAMES)


@given(
    st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1)
)
def test_the_attachment_comes_back(tick: int, published_ns: int, hand_stamp_ns: int) -> None:
    attachment = messages.Attachment(tick, published_ns, hand_stamp_ns)
    assert cdr.decode_attachment(cdr.encode_attachment(attachment)) == attachment


def test_an_attachment_of_another_size_is_refused() -> None:
    with pytest.raises(messages.WireError, match="an attachment of 23 bytes, 24 needed"):
        cdr.decode_attachment(bytes(23))


PLACE = {
    "name": "handover",
    "left": [0.6, -0.3, 0.3],
    "right": [0.9, 0.3, 0.1],
    "tool": [0.6, -0.28, 0.3],
}


def _add(**changed: Any) -> bytes:
    return json.dumps({"op": "add", "points": [PLACE | changed]}).encode()


def test_a_request_is_read_with_its_defaults() -> None:
    request = requests.decode_request(_add(), requests.ViaPointsRequest)
    assert request == requests.Add(
        (
            requests.ViaPoint(
                "handover", (0.6, -0.3, 0.3), (0.9, 0.3, 0.1), (0.6, -0.28, 0.3), 0.0001
            ),
        ),
        0.05,
    )
    assert requests.decode_request(b"", requests.Nothing) == requests.Nothing()
    assert requests.decode_request(b'{"op": "list"}', requests.ViaPointsRequest) == requests.List()


@pytest.mark.parametrize(
    ("data", "kind", "error"),
    [
        (
            _add(colour="red"),
            requests.ViaPointsRequest,
            "$.points[0]: unknown field 'colour'; known are",
        ),
        (_add().replace(b"0.6", b"NaN"), requests.ViaPointsRequest, "malformed"),
        (
            b'{"op": "fly"}',
            requests.ViaPointsRequest,
            "$.op: 'fly' given; add, remove, clear, list accepted",
        ),
        (b"{", requests.ViaPointsRequest, "truncated"),
        (b"[1]", requests.Nothing, "$: [1] given; an object with its fields needed"),
        (b'{"name": "\xff"}', requests.SkillRequest, "0xff is not valid; a text in UTF-8 needed"),
    ],
)
def test_the_error_of_a_request_names_the_place_in_it(data: bytes, kind: Any, error: str) -> None:
    with pytest.raises(requests.RequestError, match=re.escape(error)):
        requests.decode_request(data, kind)


def test_events_keep_the_numbers_that_recordings_know_them_by() -> None:
    kinds = [
        "hands/left",
        "hands/right",
        "joints/state",
        "skill",
        "hold",
        "resume",
        "reset",
        "fault",
        "way",
        "segment",
    ]
    kinds += ["clutch", "gripper/wish", "joints/guided", "begin", "tool/wish"]
    assert dict(enumerate(kinds)) == channels.EVENT_KINDS


def test_every_channel_has_a_key_of_its_own_and_a_schema_or_json() -> None:
    keys = [channel.key for channel in channels.CHANNELS]
    assert len(set(keys)) == len(keys)
    assert all(
        channel.codec.encoding == "json" or schema(channel.codec.type, definitions(7))
        for channel in channels.CHANNELS
    )
    entering = {
        channel.key
        for channel in channels.CHANNELS
        if channel.direction == "in" and channel.recorded
    }
    assert entering - {"objects"} < set(EVENT_NUMBERS)
    assert channels.key("hall/bench", "hands/left") == "hall/bench/hands/left"
    assert channels.topic("hall/bench", "hands/left") == "/hall/bench/hands/left"
    assert channels.topic("hall/bench", "/tf") == "/tf"


@given(
    st.binary(max_size=64),
    st.integers(-(2**63), 2**63 - 1),
    st.integers(0, 2**32 - 1),
    st.none() | st.integers(0, 2**32 - 1),
)
def test_what_only_recordings_hold_comes_back_too(
    data: bytes, index: int, lost: int, checksum: int | None
) -> None:
    kinds = bytes(value % len(EVENT_NUMBERS) for value in data)
    tick = cdr.encode_tick(index, kinds, lost, checksum)
    assert cdr.decode_tick(tick) == (index, kinds, lost, checksum)
    assert cdr.decode_skill(cdr.encode_skill(data)) == data
    with pytest.raises(messages.WireError, match="a Tick"):
        cdr.decode_tick(cdr.encode_tick(index, b"\0", lost)[:20])
    with pytest.raises(messages.WireError, match="a Skill"):
        cdr.decode_skill(cdr.encode_skill(data)[:7])


@pytest.mark.parametrize(
    "counts", [(7, 7, 0), (7, 0, 0), (7, 7, 7), (7, 0, 7), (3, 2, 1), (1, 1, 0)]
)
def test_joints_whose_layout_is_known_are_read_as_at_first(counts: tuple[int, int, int]) -> None:
    names = JOINT_NAMES[: counts[0]]
    for stamp_ns in (1, 4 * 10**18 + 3, 2 * 10**18):
        values = [tuple(0.1 * stamp_ns + k for k in range(count)) for count in counts]
        message = messages.JointState(stamp_ns, names, *values, "base")
        assert cdr.decode_joints(cdr.encode_joints(message)) == message
        cut = cdr.encode_joints(message)[:-1]
        with pytest.raises(messages.WireError):
            cdr.decode_joints(cut)


@pytest.mark.parametrize(
    "stamp_ns", [2**31 * 10**9, 2**32 * 10**9, 2**63 - 1, -1, -(10**20), 10**20]
)
def test_no_stamp_stops_what_encodes_it(stamp_ns: int) -> None:
    """From 2038-01-19 on, the seconds exceed an int32; read as unsigned, they are right until
    2106.
    """
    message = messages.PoseStamped(stamp_ns, "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    decoded_ns = cdr.decode_pose(cdr.encode_pose(message)).stamp_ns
    assert decoded_ns == stamp_ns % (2**32 * 10**9)
    values = (0.0,) * 7
    assert (
        cdr.decode_joints(cdr.encode_command(stamp_ns, JOINT_NAMES, values, values)).stamp_ns
        == decoded_ns
    )
