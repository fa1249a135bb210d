"""What ROS 2 is told of a cell, against independent implementations: rosbags' hashes of the types,
the names and attachments of zenoh-ros2-sdk.
"""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr
from zenoh_ros2_sdk.qos import QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from service.config import SettingsError, parse
from service.contract import channels, ros2

CELL, DOMAIN, SESSION = "lab/bench2", 7, "1a2b"


@pytest.mark.parametrize("store", [Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_the_hashes_of_the_types_are_those_of_ros2(store: Stores) -> None:
    types = get_typestore(store)
    assert {kind: f"RIHS01_{own}" for kind, own in ros2.TYPE_HASHES.items()} == {
        kind: types.hash_rihs01(kind) for kind in ros2.TYPE_HASHES
    }


def test_every_stream_has_a_topic_with_a_key_and_a_token_as_others_make_them() -> None:
    tokens = ros2.tokens(DOMAIN, CELL, SESSION, ros2.HEARD)
    node = NodeEntity(DOMAIN, SESSION, 0, ros2.NODE, f"/{CELL}")
    assert tokens.pop("") == node_liveliness_keyexpr(node)
    streams = [c.key for c in channels.CHANNELS if c.direction == "out" or (c.direction == "in" and c.event)]
    assert list(tokens) == sorted(streams, key=list(tokens).index)
    for number, (suffix, token) in enumerate(tokens.items(), start=1):
        channel = channels.BY_KEY[suffix]
        kind = ros2.type_of(channel)
        named = (f"/{CELL}/{suffix}", ros2_to_dds_type(kind), f"RIHS01_{ros2.TYPE_HASHES[kind]}")
        is_in = channel.direction == "in"
        quality = QosProfile(reliability=QosReliability.BEST_EFFORT if is_in else QosReliability.RELIABLE)
        entity = EntityKind.SUBSCRIPTION if is_in else EntityKind.PUBLISHER
        assert token == endpoint_liveliness_keyexpr(EndpointEntity(node, number, entity, *named, quality.encode()))
        assert ros2.key(DOMAIN, CELL, channel) == topic_keyexpr(DOMAIN, *named)


def test_what_rides_with_a_message_is_read_by_others() -> None:
    gid = ros2.gid("token")
    assert Attachment.from_bytes(ros2.encode_attachment(3, 1_700_000_000_000_000_001, gid)) == Attachment(
        3, 1_700_000_000_000_000_001, gid
    )
    assert len(ros2.encode_attachment(1, 1, gid)) == 33


@pytest.mark.parametrize(
    ("cell", "ok"),
    [("thirdhand", True), ("lab_1/b2", True), ("bench-2", False), ("2nd", False), ("a__b", False), ("a/", False)],
)
def test_a_cell_that_ros2_cannot_name_is_refused_with_a_domain_and_only_then(cell: str, ok: bool) -> None:
    assert ros2.is_name(cell) == ok
    if cell.endswith("/"):
        return
    assert parse(f"cell = {cell!r}", origin="cell.toml").cell == cell
    domain = f"cell = {cell!r}\nnetwork.ros2_domain = 0"
    if ok:
        assert parse(domain, origin="cell.toml").network.ros2_domain == 0
    else:
        with pytest.raises(SettingsError, match=r"cell\.toml: \$\.cell: .* given; with \$\.network\.ros2_domain names"):
            parse(domain, origin="cell.toml")


def test_a_domain_that_is_none_is_refused() -> None:
    with pytest.raises(
        SettingsError, match=r"\$\.network\.ros2_domain: 233 given; a whole number from 0 to 232 accepted"
    ):
        parse("network.ros2_domain = 233", origin="cell.toml")
