"""Primitives in files: without pickle, exact to the bit, with the units of their numbers."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from kmp.primitive import KMP

_FORMAT = 1


class Stored(NamedTuple):
    """What a file held."""

    primitive: KMP
    input_unit: str
    output_unit: str


def save(path: str | Path, primitive: KMP, *, input_unit: str, output_unit: str) -> None:
    """Writes the primitive and the units of its numbers ("m", "s", "m, m/s") to an .npz file.

    The file has this very name. Raises OSError if the file cannot be written.
    """
    units = {
        "kmp_format": np.array(_FORMAT),
        "input_unit": np.array(input_unit),
        "output_unit": np.array(output_unit),
    }
    with Path(path).open("wb") as file:
        np.savez(file, allow_pickle=False, **units, **primitive.to_arrays())


def load(path: str | Path) -> Stored:
    """The primitive and the units that `save` wrote; it predicts the same, bit for bit.

    Raises OSError if the file cannot be read, and ValueError if it is not one that `save` wrote.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = dict(archive)
    except (ValueError, EOFError, TypeError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: not an .npz file that `kmp.save` wrote: {error}") from None
    if int(arrays.get("kmp_format", 0)) != _FORMAT:
        raise ValueError(f"{path}: format {int(arrays.get('kmp_format', 0))} given, {_FORMAT} needed.")
    try:
        return Stored(KMP.from_arrays(arrays), str(arrays["input_unit"]), str(arrays["output_unit"]))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
