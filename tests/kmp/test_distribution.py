"""kmp as a distribution of its own: requirements and content, and its use without Numba."""

import json
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile

import numpy as np
import pytest

import kmp
from kmp import KMP, GaussianKernel, Gaussians
from support.paths import ROOT

WITHOUT_NUMBA = """
import json, sys
sys.path[:0] = [{site!r}, {libraries!r}]
sys.modules["numba"] = None
import numpy as np
import kmp
from kmp.compiled import AVAILABLE
from kmp import KMP, GaussianKernel, Gaussians
s = np.linspace(0, 2, 40)[:, None] * [1.0, -0.5]
reference = Gaussians(np.sin(s), np.tile(1e-3 * np.eye(2), (40, 1, 1)))
one = KMP.fit(s, reference, kernel=GaussianKernel(2.0), lambda_mean=1)
one = one.adapt_jacobian(s[5:6], [np.eye(2)], deviation=0.1)
found = one.predict_motion([0.3, 0.2], [1.0, 0.5], [0.0, 0.1])
print(json.dumps([kmp.__file__, AVAILABLE, *(np.asarray(part).tolist() for part in found)]))
"""


def run(*arguments, cwd):
    """Run a module of this Python, which must succeed, without the folder in its path."""
    command = [sys.executable, "-P", "-m", *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=100, check=False, cwd=cwd
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """The source distribution, unpacked."""
    folder = tmp_path_factory.mktemp("sdist")
    run("hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT / "kmp")
    [path] = folder.glob("kernelized_movement_primitives-*.tar.gz")
    shutil.unpack_archive(path, folder, filter="data")
    return folder / path.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def wheel(sdist):
    """The wheel that is made of the source distribution."""
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    run("pip", "wheel", *options, "--disable-pip-version-check", sdist, cwd=sdist.parent)
    [path] = sdist.parent.glob("*.whl")
    return path


def test_source_holds_the_tests(sdist):
    tests = {path.name for path in (ROOT / "tests" / "kmp").glob("*.py")}
    assert {path.name for path in (sdist / "tests" / "kmp").iterdir()} == tests
    used = "".join(path.read_text() for path in (sdist / "tests" / "kmp").glob("*.py"))
    supports = set(re.findall(r"^from support\.(\w+)", used, re.MULTILINE))
    assert {path.stem for path in (sdist / "tests" / "support").iterdir()} == supports


def test_it_holds_this_tree_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
        metadata = archive.read(
            next(name for name in archive.namelist() if name.endswith("/METADATA"))
        ).decode()
    modules = {path for path in (ROOT / "kmp").rglob("*.py") if "docs" not in path.parts}
    assert held == {str(path.relative_to(ROOT)) for path in modules} | {"kmp/py.typed"}
    needed = {
        line.removeprefix("Requires-Dist: ")
        for line in metadata.splitlines()
        if line.startswith("Requires-D")
    }
    assert {line for line in needed if "extra" not in line} == {"numpy>=2.1", "scipy>=1.14"}
    for name, extra in (("scikit-learn", "sklearn"), ("numba", "fast"), ("matplotlib", "plot")):
        assert any(line.startswith(name) and f"extra == '{extra}'" in line for line in needed)
    assert wheel.stat().st_size < 250_000


def test_requirements_agree_with_project():
    whole, alone = (
        tomllib.loads((ROOT / path).read_text())
        for path in ("pyproject.toml", "kmp/pyproject.toml")
    )
    extras, theirs = (project["project"]["optional-dependencies"] for project in (alone, whole))
    assert {*alone["project"]["dependencies"], *extras["fast"]} <= set(theirs["cell"])
    assert set(extras["plot"]) <= set(theirs["learn"])
    assert whole["project"]["requires-python"].startswith(alone["project"]["requires-python"])
    assert alone["project"]["authors"] == whole["project"]["authors"]


def test_predicts_the_same_without_numba(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    code = WITHOUT_NUMBA.format(site=str(tmp_path), libraries=sysconfig.get_path("purelib"))
    command = [sys.executable, "-I", "-S", "-c", code]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=100, check=False, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    where, compiled, *printed = json.loads(done.stdout)
    assert where.startswith(str(tmp_path))
    assert not compiled
    s = np.linspace(0, 2, 40)[:, None] * [1.0, -0.5]
    reference = Gaussians(np.sin(s), np.tile(1e-3 * np.eye(2), (40, 1, 1)))
    primitive = KMP.fit(s, reference, kernel=GaussianKernel(2.0), lambda_mean=1)
    primitive = primitive.adapt_jacobian(s[5:6], [np.eye(2)], deviation=0.1)
    expected = primitive.predict_motion([0.3, 0.2], [1.0, 0.5], [0.0, 0.1])
    assert kmp.__file__ != where
    for a, b in zip(printed, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)
