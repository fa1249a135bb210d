"""Bytes of unknown origin: every decoder returns a value or a refusal in words, in bounded time.

`THIRDHAND_EXAMPLES=100000 pytest tests/contract/test_hostile_bytes.py` mutates more;
`support/hostile_bytes.py` itself searches with atheris.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from random import Random

import pytest

from support.hostile_bytes import DECODERS, FOUND, REQUESTS, check, mutated, seeds
from thirdhand.contract import cdr
from thirdhand.contract.messages import WireError
from thirdhand.contract.requests import RequestError

MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "1500"))
LARGE = 2_000_000  # [bytes] far more than in any message
SOON_S = 5.0  # on a busy machine; a decoder of quadratic time would take minutes


@pytest.mark.parametrize("name", DECODERS)
def test_mutated_messages_are_taken_or_refused_in_words(name: str) -> None:
    random = Random(name)
    corpus = seeds(name)
    taken = 0
    for _ in range(MANY):
        data = mutated(name, random.choice(corpus), random)
        taken += check(name, data)
        if len(corpus) < 200 and random.random() < 0.1:
            corpus.append(data[:4000])
    assert taken < MANY


@pytest.mark.parametrize("name", DECODERS)
@pytest.mark.parametrize("filler", [b"\0", b"\xff", b"\1\0\0\0", b"[", b'{"a":', b'"', b"9"])
def test_what_is_large_is_answered_soon(name: str, filler: bytes) -> None:
    begin = time.process_time()
    for head in (b"", cdr.CDR_HEADER, seeds(name)[0]):
        check(name, head + filler * (LARGE // len(filler)))
    assert time.process_time() - begin < SOON_S


@pytest.mark.parametrize("name", REQUESTS)
def test_what_is_nested_deep_is_refused_at_any_depth(name: str) -> None:
    limit = sys.getrecursionlimit()
    for depth in [*range(limit - 120, limit + 10, 3), 10 * limit]:
        for text in ("[" * depth + "]" * depth, '{"op":' * depth + "1" + "}" * depth):
            assert not check(name, text.encode())
            assert not check(name, b'{"op": "add", "points": ' + text.encode() + b"}")
            assert not check(name, b'{"name": ' + text.encode() + b"}")


@pytest.mark.parametrize(
    ("decode", "most"),
    [
        (cdr.decode_pose, 8192),
        (cdr.decode_pose_with_covariance, 8192),
        (cdr.decode_joints, 8192),
        (cdr.decode_transforms, 32768),
    ],
)
def test_what_the_loop_reads_is_refused_by_its_size_alone(
    decode: Callable[[bytes], object], most: int
) -> None:
    with pytest.raises(WireError, match=f"a message of {most + 1} bytes, at most {most} accepted"):
        decode(b"x" * (most + 1))


def test_a_stamp_has_less_than_a_second_of_nanoseconds() -> None:
    for data in FOUND["joints"]:
        with pytest.raises(WireError, match="4294967295 ns"):
            cdr.decode_joints(data)
    with pytest.raises(RequestError, match="not JSON"):
        DECODERS["nothing"](b"\xff")
