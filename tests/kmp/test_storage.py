"""Files: exact to the bit, with units, without pickle."""

import numpy as np
import pytest

import kmp
from kmp.storage import checksum
from support.primitives import skill


def saved(folder):
    """A file with a primitive."""
    kmp.save(folder / "whole.npz", skill(), input_unit="m", output_unit="m")
    return folder / "whole.npz"


def test_foreign_file_is_refused(tmp_path):
    """The error names the file."""
    (tmp_path / "text").write_text("no")
    with pytest.raises(ValueError, match=r"text: not an \.npz file that `kmp\.save` wrote"):
        kmp.load(tmp_path / "text")
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(
        ValueError, match=r"other\.npz: not an \.npz file that `kmp\.save` wrote, or damaged: save"
    ):
        kmp.load(tmp_path / "other.npz")
    np.savez(tmp_path / "object.npz", a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"object\.npz: not an \.npz file"):
        kmp.load(tmp_path / "object.npz")
    (tmp_path / "pointer.npz").write_bytes(
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0a1b\nsize 284\n"
    )
    with pytest.raises(
        ValueError, match=r"pointer\.npz: a pointer of Git LFS .*; `git lfs pull` fetches that"
    ):
        kmp.load(tmp_path / "pointer.npz")
    half = {"kmp_format": np.array(1)}
    np.savez(tmp_path / "half.npz", **half, checksum=np.array(checksum(half)))
    with pytest.raises(ValueError, match=r"half\.npz: The primitive's arrays lack base_inputs"):
        kmp.load(tmp_path / "half.npz")
    with pytest.raises(FileNotFoundError):
        kmp.load(tmp_path / "none.npz")
    with pytest.raises(OSError, match=str(tmp_path)):
        kmp.load(tmp_path)


def test_cut_file_is_refused(tmp_path):
    """The error names the file, which is cut or has one array only."""
    part = tmp_path / "part.npz"
    data = saved(tmp_path).read_bytes()
    for size in (0, 3, 100, len(data) // 2, len(data) - 1):
        part.write_bytes(data[:size])
        with pytest.raises(
            ValueError, match=r"part\.npz: not an \.npz file that `kmp\.save` wrote"
        ):
            kmp.load(part)
    part.write_bytes(data[:300] + bytes(8) + data[308:])
    with pytest.raises(ValueError, match=r"part\.npz: not an \.npz file"):
        kmp.load(part)
    np.save(tmp_path / "one.npy", np.ones(3))
    with pytest.raises(ValueError, match=r"one\.npy: not an \.npz file"):
        kmp.load(tmp_path / "one.npy")


def test_changed_numbers_are_refused(tmp_path):
    part = tmp_path / "part.npz"
    arrays = dict(np.load(saved(tmp_path)))
    np.savez(part, **(arrays | {"weights": 2 * arrays["weights"]}))
    with pytest.raises(ValueError, match=r"part\.npz: the numbers are not those that were saved"):
        kmp.load(part)
    del arrays["checksum"]
    np.savez(part, **arrays)
    with pytest.raises(ValueError, match=r"part\.npz: the numbers are not those that were saved"):
        kmp.load(part)
    for name, value in (
        ("base_weights", arrays["base_weights"] + 1j),
        ("ell", np.array("x")),
        ("kmp_format", np.ones(2)),
    ):
        np.savez(part, **(arrays | {name: value}))
        with pytest.raises(ValueError, match=r"part\.npz: "):
            kmp.load(part)
