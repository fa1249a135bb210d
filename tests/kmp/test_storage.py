"""Files: exact to the bit, with units, without pickle."""

from dataclasses import dataclass

import numpy as np
import pytest

import kmp
from kmp import (
    KMP,
    GaussianKernel,
    Gaussians,
    LinearConstraints,
    Matern52,
    RadialKernel,
    named_arrays,
)
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


@dataclass(frozen=True, eq=False, repr=False)
class Rational(RadialKernel):
    """(1 + u / alpha)^-alpha."""

    alpha: float = 2.0

    def profile(self, u):
        return (1 + u / self.alpha) ** -self.alpha


class Hidden(RadialKernel):
    """A kernel with a parameter that is no field."""

    def __init__(self, ell, power):
        super().__init__(ell)
        self.__dict__["power"] = power

    def profile(self, u):
        return np.exp(-(u**self.power))


T = np.linspace(0, 1, 20)[:, None]


def with_kernel(kernel):
    return KMP.fit(T, Gaussians.of(np.sin(3 * T), deviation=0.1), kernel=kernel, lambda_mean=1.0)


@pytest.mark.parametrize(
    "kernel", [Rational(2.0, 3.0), 0.3 * Matern52(1.0) + Rational([2.0], 1.5) * GaussianKernel(3.0)]
)
def test_own_kernel_is_restored_by_its_class(tmp_path, kernel):
    """Without the class it is refused, and so is another class of that name."""
    skill = with_kernel(kernel)
    path = tmp_path / "own.npz"
    skill.save(path)
    loaded = KMP.load(path, kernels={"Rational": Rational})
    assert repr(loaded.kernel) == repr(kernel)
    assert np.array_equal(loaded.mean(T + 0.1), skill.mean(T + 0.1))
    with pytest.raises(
        ValueError, match=r'own\.npz: kernel.*kind: Rational given.*"Rational": its'
    ):
        kmp.load(path)
    with pytest.raises(ValueError, match=r"own\.npz: .*unexpected keyword argument"):
        kmp.load(path, kernels={"Rational": Matern52})
    with pytest.raises(ValueError, match="kernels: list given"):
        kmp.load(path, kernels=[Rational])


def test_kernel_that_no_file_restores_is_refused(tmp_path):
    class Matern52(RadialKernel):
        profile = Rational.profile
        alpha = 2.0

    for kernel, message in (
        (Hidden(2.0, 0.4), "Hidden.*field for each of power"),
        (Matern52(2.0), "restores Matern52.*by a new name"),
    ):
        with pytest.raises(ValueError, match=message):
            with_kernel(kernel).save(tmp_path / "own.npz")
    assert not (tmp_path / "own.npz").exists()


def test_gaussian_kernel_keeps_its_arrays():
    """Files of earlier versions have these names, in this order."""
    arrays = named_arrays.to_arrays(with_kernel(GaussianKernel(2.0)))
    assert list(arrays)[-4:] == ["ell", "lambda_mean", "lambda_covariance", "prior_mean"]
    assert not [name for name in arrays if name.startswith("kernel")]
    others = named_arrays.to_arrays(with_kernel(Matern52(2.0)))
    assert {str(others["kernel.kind"]), float(others["kernel.ell"])} == {"Matern52", 2.0}
    assert "ell" not in others  # so that earlier versions refuse it


@pytest.mark.parametrize("name", ["kind", "inputs", "normals", "bounds"])
def test_constraints_are_stored_whole_or_refused(name):
    free = skill()
    count = len(free.inputs)
    bounds = free.mean(free.inputs)[:, 0] - 0.1
    normals = np.tile(np.eye(free.outputs)[0], (count, 1))
    arrays = named_arrays.to_arrays(
        free.constrained(LinearConstraints(free.inputs, normals, bounds))
    )
    lacking = {key: array for key, array in arrays.items() if key != f"constraints.{name}"}
    with pytest.raises(ValueError, match=rf"lack constraints\.{name}: give all of"):
        named_arrays.from_arrays(lacking)
    with pytest.raises(ValueError, match="AffineMean given, LinearConstraints needed"):
        named_arrays.from_arrays(
            arrays
            | {
                "constraints.kind": np.array("AffineMean"),
                "constraints.matrix": np.ones((2, 1)),
                "constraints.offset": np.ones(2),
            }
        )
