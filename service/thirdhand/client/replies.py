"""JSON that a daemon publishes or replies, validated, with its texts made printable."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from thirdhand.client.session import RefusedError
from thirdhand.contract.explain import InvalidError, in_words, validated
from thirdhand.contract.printable import printable_values

Decoded = TypeVar("Decoded")


def decoded(data: bytes, kind: type[Decoded]) -> Decoded:
    """The value of this type in JSON bytes, each of its texts printable. Raises RefusedError."""
    try:
        return validated(printable_values(msgspec.json.decode(data)), kind)
    except (msgspec.DecodeError, InvalidError, RecursionError, UnicodeDecodeError) as error:
        problem = f"not a {kind.__name__}: {in_words(error, named=False)}"
        raise RefusedError(f"{problem}. Do daemon and client have the same version?") from None
