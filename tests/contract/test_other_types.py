"""A message of another type is refused with the names of both types, on every input."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from thirdhand.contract.channels import BOOL, CHANNELS, POSE, Channel
from thirdhand.contract.messages import WireError
from thirdhand.contract.other_types import _TYPE_LAYOUTS, Refusal, likely_type

ROS = get_typestore(Stores.ROS2_HUMBLE)
INPUTS = [channel for channel in CHANNELS if channel.direction == "in"]
FOUR_BYTES = ("std_msgs/msg/Float32", "std_msgs/msg/Int32")
KINDS = {
    f"{named.rpartition('/')[0]}/{name.rpartition('/')[2]}": named
    for named in _TYPE_LAYOUTS
    for name in re.split(", | or ", named)
}


def _message(kind: str, random: np.random.Generator) -> Any:
    fields = ROS.get_msgdef(kind).fields
    return ROS.types[kind](*(_value(*node, random) for _, node in fields))


def _value(node: Any, details: Any, random: np.random.Generator) -> Any:
    if node.name == "NAME":
        return _message(details, random)
    if node.name == "BASE":
        number = random.normal() if "f" in details[0] else 1
        return "abc" if details[0] == "string" else number
    (inner, named), count = details
    count = count if node.name == "ARRAY" else 3
    if inner.name == "NAME" or named[0] == "string":
        return [_value(inner, named, random) for _ in range(count)]
    numbers = 100 * random.normal(size=count) if "f" in named[0] else np.ones(count)
    return numbers.astype(named[0])


@pytest.mark.parametrize("kind", KINDS)
def test_the_type_is_recognised_by_the_bytes(kind: str) -> None:
    """The bytes of another implementation are recognised, whatever they hold."""
    for seed in range(20):
        data = bytes(ROS.serialize_cdr(_message(kind, np.random.default_rng(seed)), kind))
        assert likely_type(data) == KINDS[kind]


@pytest.mark.parametrize("channel", INPUTS, ids=lambda channel: channel.key)
def test_another_type_is_refused_with_both_names(channel: Channel) -> None:
    """Every input refuses each other type, and names it and its own."""
    random = np.random.default_rng(1)
    for kind, named in KINDS.items():
        is_padded_bool = channel.codec is BOOL and kind in FOUR_BYTES
        is_plain_wish = channel.key == "tool/wish" and kind == POSE.type
        if kind == channel.codec.type or is_padded_bool or is_plain_wish:
            continue
        data = bytes(ROS.serialize_cdr(_message(kind, random), kind))
        with pytest.raises(WireError) as refused:
            channel.codec.decode(data)
        text = str(Refusal(str(refused.value), channel.codec.type, data))
        assert text.startswith(f"{len(data)} bytes that fit {named}; {channel.codec.type} needed: ")


def test_what_is_not_cdr_is_named_by_its_encoding() -> None:
    """JSON is recognised, and a Zenoh encoding is quoted."""
    refusal = Refusal("a header of another kind", "std_msgs/msg/Bool", b'{"x": 1}', "text/json")
    assert str(refusal) == (
        "8 bytes that fit JSON sent as 'text/json'; std_msgs/msg/Bool needed: a header of another "
        "kind"
    )
    assert str(refusal._replace(data=b"", encoding="")) == (
        "a header of another kind; std_msgs/msg/Bool needed"
    )
