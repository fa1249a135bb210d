"""Any bytes: each decoder returns a value or refuses them in words, and does nothing else.

`python tests/support/hostile_bytes.py DECODER [RUNS]` searches with atheris, guided by coverage,
if atheris is installed; `test_hostile_bytes` mutates the same seeds.
"""

from __future__ import annotations

import contextlib
import json
import math
import struct
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

if __name__ == "__main__":
    import atheris

    sys.path.insert(0, str(Path(__file__).parents[2]))
    with atheris.instrument_imports(include=["thirdhand.contract"]):
        import thirdhand.contract.cdr
        import thirdhand.contract.requests  # noqa: F401

from thirdhand.contract import cdr, requests
from thirdhand.contract.messages import (
    GRIPPER,
    JointState,
    PoseStamped,
    PoseWithCovarianceStamped,
    Transform,
    WireError,
    in_order,
)

LONGEST_WORDS = 600  # [characters] of a refusal, which is sent and logged
NAMES = ("wam/base_yaw_joint", "b", "c")
POSITION = (0.5, -0.1, 0.2)
TURN = (0.0, 0.0, 0.0, 1.0)
POINT = (
    b'{"name": "handover", "left": [0.5, 0.1, 0.2], "right": [0.5, -0.1, 0.2], "tool": [0.6, 0, 0.3], '
    b'"std": 0.0001, "radius": 0.02, "follow": "left"}'
)


def _joints(data: bytes) -> Any:
    """Decode joints as the intake does."""
    message = cdr.decode_joints(data)
    in_order(message, NAMES)
    return message


def _again(encode: Callable[..., bytes], decode: Callable[[bytes], Any], data: bytes) -> Any:
    """Assert that a decoded message, encoded and decoded again, is the same."""
    message = decode(data)
    assert repr(decode(encode(message))) == repr(message)
    return message


def _transforms(data: bytes) -> Any:
    """Assert that reading some frames agrees with reading all, and that each pose can be
    recorded.
    """
    read = cdr.decode_transforms(data)
    subset = cdr.decode_transforms(data, ("b",))
    assert repr(subset) == repr([entry for entry in read if entry[0] == "b"])
    for _, pose in read:
        if len(raw := cdr.encode_pose(pose)) <= 8192:
            assert repr(cdr.decode_pose(raw)) == repr(pose)
    return read


_request = partial(partial, requests.decode_request)
DECODERS: dict[str, Callable[[bytes], Any]] = {
    "pose": partial(_again, cdr.encode_pose, cdr.decode_pose),
    "pose_with_covariance": partial(
        _again, cdr.encode_pose_with_covariance, cdr.decode_pose_with_covariance
    ),
    "joints": partial(_again, cdr.encode_joints, cdr.decode_joints),
    "joints_in_order": _joints,
    "bool": partial(_again, cdr.encode_bool, cdr.decode_bool),
    "closure": cdr.decode_closure,
    "string": cdr.decode_string,
    "transforms": _transforms,
    "hands_of_transforms": partial(cdr.decode_transforms, frames=("b", "c")),
    "tick": cdr.decode_tick,
    "skill": cdr.decode_skill,
    "record": partial(cdr.decode_record, size=60),
    "attachment": cdr.decode_attachment,
    "via_points": _request(kind=requests.ViaPointsRequest),
    "skill_request": _request(kind=requests.SkillRequest),
    "nothing": _request(kind=requests.Nothing),
}
REQUESTS = ("via_points", "skill_request", "nothing")
_SEEDS: dict[str, list[bytes]] = {
    "pose": [cdr.encode_pose(PoseStamped(1_500_000_001, "base", POSITION, TURN))],
    "pose_with_covariance": [
        cdr.encode_pose_with_covariance(
            PoseWithCovarianceStamped(-1, "", POSITION, TURN, (0.0,) * 36)
        )
    ],
    "joints": [
        cdr.encode_joints(JointState(1, NAMES, POSITION, POSITION, (), "base")),
        cdr.encode_joints(JointState(1, NAMES, POSITION, (), POSITION)),
        cdr.encode_joints(JointState(1, (), (), ())),
    ],
    "bool": [cdr.encode_bool(True), cdr.encode_bool(False), cdr.encode_bool(True) + bytes(3)],
    "closure": [cdr.encode_joints(JointState(1, (GRIPPER,), (0.25,), ()))],
    "string": [cdr.encode_string("{}"), cdr.encode_string("é")],
    "transforms": [
        cdr.encode_transforms(
            7, [Transform("a", "b", POSITION, TURN), Transform("", "c", POSITION, TURN)]
        )
    ],
    "tick": [cdr.encode_tick(7, [0, 1, 6], 2)],
    "skill": [cdr.encode_skill(b"PK")],
    "record": [cdr.encode_record(bytes(60))],
    "attachment": [bytes(range(24))],
    "via_points": [
        b'{"op": "add", "points": [' + POINT + b'], "tolerance": 0.05}',
        b'{"op": "remove", "names": ["a", "b"]}',
        b'{"op": "list"}',
    ],
    "skill_request": [b'{"name": "soldering"}'],
    "nothing": [b"{}", b""],
}
_SEEDS["hands_of_transforms"] = _SEEDS["transforms"]
_SEEDS["joints_in_order"] = _SEEDS["joints"][:2]
# Messages found by searches: each once caused another error, or is the smallest one that could.
FOUND: dict[str, list[bytes]] = {
    # the sum of seconds and nanoseconds exceeds a stamp
    "joints": [
        _SEEDS["joints"][0][:4] + b"\xff\xff\xff\x7f\xff\xff\xff\xff" + _SEEDS["joints"][0][12:]
    ],
    "pose": [_SEEDS["pose"][0][:4] + b"\xff\xff\xff\x7f\x00\xca\x9a\x3b" + _SEEDS["pose"][0][12:]],
}


def seeds(name: str) -> list[bytes]:
    """Messages from which mutation begins, with those found before."""
    return _SEEDS[name] + FOUND.get(name, [])


def check(name: str, data: bytes) -> bool:
    """True if a decoder accepts the bytes. Raises AssertionError if its refusal is too long, and
    any error of the decoder that is no refusal.
    """
    try:
        DECODERS[name](data)
    except (WireError, requests.RequestError) as error:
        words = str(error)
        assert 0 < len(words) <= LONGEST_WORDS, (len(words), words[:200])
        words.encode()
        return False
    return True


HOSTILE_WORDS = tuple(
    word.to_bytes(size, "little")
    for size in (1, 4, 8)
    for word in {0, 1, 2**31 - 1 & 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (8 * size) - 1}
)
HOSTILE_NUMBERS = tuple(
    struct.pack("<d", x) for x in (math.nan, math.inf, -math.inf, 5e-324, 1e308, -0.0)
)
HOSTILE_JSON: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    2**63,
    10**400,
    1e308,
    -0.0,
    5e-324,
    "",
    "a",
    "\0",
    "$.points[0]",
    "é" * 300,
    "x" * 3000,
    [],
    {},
    [[]] * 50,
    {"op": "add"},
    {"name": 3},
    {"a.b[1]": {}, "`": 1},
    [0.1, 0.2],
    [0.1, 0.2, 0.3, 0.4],
)


def mutated(name: str, data: bytes, random: Random) -> bytes:
    """The message with a random fault; in a request mostly a fault of content, not of syntax."""
    if name in REQUESTS and random.random() < 0.8:
        with contextlib.suppress(ValueError, RecursionError):
            return json.dumps(_spoilt(json.loads(data or b"{}"), random)).encode()
    out = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 5))):
        offset = random.randrange(len(out) + 1)
        match random.randrange(6):
            case 0:
                out[offset : offset + 1] = bytes([random.randrange(256)])
            case 1:
                offset -= offset % 4
                word = random.choice(HOSTILE_WORDS + HOSTILE_NUMBERS)
                out[offset : offset + len(word)] = word
            case 2:
                del out[offset:]
            case 3:
                del out[offset : offset + random.choice((1, 4, 8))]
            case 4:
                out[offset:offset] = random.randbytes(random.choice((1, 4, 8, 100)))
            case _:
                out[offset:offset] = out[random.randrange(len(out) + 1) :][
                    : random.choice((4, 24, 200))
                ]
    return bytes(out)


def _spoilt(value: Any, random: Random) -> Any:
    """A JSON value with one of its parts replaced, left out, doubled or renamed."""
    if random.random() < 0.15 or not isinstance(value, dict | list) or not value:
        return random.choice(HOSTILE_JSON)
    if isinstance(value, list):
        index = random.randrange(len(value))
        chance = random.random()
        inner = [] if chance < 0.1 else [value[index]] * 2
        if chance >= 0.2:
            inner = [_spoilt(value[index], random)]
        return value[:index] + inner + value[index + 1 :]
    key = random.choice(list(value))
    chance = random.random()
    remaining = {k: v for k, v in value.items() if k != key}
    if chance < 0.1:
        return remaining
    if chance < 0.2:
        return {
            **remaining,
            random.choice(("", "op", "name", "a.b[0]", "`", "é\n" * 200, "x" * 2000)): value[key],
        }
    return {**remaining, key: _spoilt(value[key], random)}


def search(name: str, runs: int) -> None:
    """Search with atheris; ends the process."""
    folder = Path(f"/tmp/thirdhand-fuzz/{name}")
    folder.mkdir(parents=True, exist_ok=True)
    for i, seed in enumerate(seeds(name)):
        (folder / f"seed-{i}").write_bytes(seed)

    def mutate(data: bytes, longest: int, seed: int) -> bytes:
        random = Random(seed)
        if random.random() < 0.5:
            return bytes(atheris.Mutate(data, longest))
        return mutated(name, random.choice((data, *seeds(name))), random)[:longest]

    options = [f"-runs={runs}", "-timeout=2", "-max_len=4000", "-len_control=0", "-seed=1"]
    atheris.Setup(
        [sys.argv[0], *options, f"-artifact_prefix={folder}/", str(folder)],
        partial(check, name),
        custom_mutator=mutate,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    search(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000)
