"""The origin of each experiment's result, and its staleness against this source tree.

A result depends on up to four digests: `core`, of the frames of the golden session; `wishes`, of a
tool that a policy leads; `learning`, of the numbers of the shipped skill, which `learn` makes of
the shipped takes; `kmp`, of the library's results for two small problems. A result is stale if its
digests are not those of the tree.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import subprocess
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians
from kmp.storage import checksum
from thirdhand.core.frame import encode
from thirdhand.recordings.mcap_file import machine
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.shipped import SHIPPED_SKILL, recordings
from thirdhand.skills.skill_file import DEMONSTRATIONS
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.results import Array, ExperimentError, Options

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "recordings" / "experiments"
CODE = (
    "kmp",
    "service",
    "sim",
    "pyproject.toml",
    "recordings/*.npz",
    "recordings/people",
    "recordings/golden.mcap",
)
MACHINE = ("cpu", "python", "numpy", "scipy", "pin", "ruckig")
DECIMALS = 6  # kmp's outputs are rounded to these decimals, on which CPUs agree


USUAL = Options()
BEFORE = {"seed_offset": 0}  # options of results that do not name them


@functools.cache
def tree() -> dict[str, str]:
    """The digests of this tree, by name."""
    return {
        "core": core_digest(recordings() / "golden.mcap"),
        "learning": _skill_digest(),
        "kmp": kmp_digest(),
        "wishes": _wishes_digest(),
    }


def core_digest(golden: Path) -> str:
    """The digest of a golden session's frames and messages. Raises RecordingError.

    Checksums of frames cover the state too, which decides nothing by itself. So a frame that the
    file has as a whole counts instead of its checksum.
    """
    recording = Recording.open(golden)
    sums = hashlib.blake2b(digest_size=16)
    whole = {
        step.tick: encode(step.frame)
        for step in recording.steps(whole=False)
        if step.frame is not None
    }
    for tick, number in recording.checksums.items():
        sums.update(whole.get(tick) or number.to_bytes(4, "little"))
    return sums.hexdigest()


def _skill_digest() -> str:
    """The checksum of the shipped skill's numbers, without texts and without its demonstrations."""
    with np.load(recordings() / SHIPPED_SKILL, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files if name != DEMONSTRATIONS}
    return checksum({name: array for name, array in arrays.items() if array.dtype.kind != "U"})


def _wishes_digest() -> str:
    """The digest of a tool's path that a policy leads."""
    from thirdhand_sim.lab.seams import STEADY_POLICY, OurArm, cell, led

    arm = OurArm(cell())
    path = np.linspace(arm.tool, arm.tool + 0.05, 1000)
    return hashlib.blake2b(
        led(arm, path, STEADY_POLICY, (1,)).tool.tobytes(), digest_size=16
    ).hexdigest()


@functools.cache
def kmp_digest() -> str:
    """The digest of kmp's results for two small problems, rounded to DECIMALS."""
    sums = hashlib.blake2b(digest_size=16)
    for output in kmp_outputs():
        sums.update((np.round(output, DECIMALS) + 0.0).tobytes())  # -0.0 becomes 0.0
    return sums.hexdigest()


def kmp_outputs() -> Iterable[Array]:
    """References, predictions, derivatives and adaptations, over one input and over two."""
    for inputs in (1, 2):
        u = np.linspace(0.0, 1.0, 40)[:, None]
        lines = [np.hstack([u, u**2][:inputs]) + 0.01 * k for k in range(3)]
        outputs = [
            np.hstack([np.sin(3 * u + 0.1 * k), 0.2 * k * np.cos(4 * u) + u]) for k in range(3)
        ]
        samples = np.hstack([np.concatenate(lines), np.concatenate(outputs)])
        mixture = GaussianMixture.fit(samples, components=3, seed=0, regularization=1e-4)
        points = lines[1][::2]
        reference = mixture.regress(points)
        primitive = KMP.fit(
            points, reference, kernel=GaussianKernel(6.0), lambda_mean=0.5, lambda_covariance=2.0
        )
        through = Gaussians.of([[0.8, 0.2], [0.7, 0.8]], deviation=0.05)
        adapted = primitive.adapt(lines[1][[10, 30]], through, tolerance=0.1)
        yield from (mixture.means, reference.mean, reference.covariance)
        for predictor in (primitive, adapted):
            predicted = predictor.predict(lines[2])
            parts = predictor.uncertainty(lines[2])
            yield from (
                predictor.mean(lines[2]),
                predicted.mean,
                predicted.covariance,
                predictor.jacobian(lines[2][7]),
            )
            yield from (parts.variability, parts.distance)


def commit() -> str:
    """The commit of this source tree, with a `+` if its code is changed; "unknown" without git."""
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        return _git("rev-parse", "--short=12", "HEAD") + "+" * bool(
            _git("status", "--porcelain", "--", *CODE)
        )
    return "unknown"


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True
    ).stdout.strip()


def origin(name: str, options: Options) -> dict[str, Any]:
    """The origin of a result that is made now, for its JSON."""
    machine_facts = machine()
    digests = tree()
    return {
        "commit": commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {
            **{part: machine_facts.get(part, "unknown") for part in MACHINE},
            "cores": os.cpu_count(),
        },
        "seeds": EXPERIMENTS[name].seeds.moved(options.seed_offset).named(),
        "options": options_of(name, options),
        "depends_on": {
            dependency: digests[dependency] for dependency in EXPERIMENTS[name].depends_on
        },
    }


def options_of(name: str, options: Options) -> dict[str, Any]:
    """The options that an experiment uses; folders by their number of files and a digest."""
    used = ("share", "seed_offset", *EXPERIMENTS[name].options)
    values = {option: getattr(options, option) for option in used}
    return {
        "set" if option == "group" else option: _folder(value) if isinstance(value, Path) else value
        for option, value in values.items()
    }


def _folder(folder: Path) -> dict[str, Any]:
    """The number of recordings in a folder, and a digest of their names and bytes."""
    files = sorted(folder.glob("*.npz"))
    sums = hashlib.blake2b(digest_size=16)
    for file in files:
        sums.update(f"{file.name} {file.stat().st_size}\n".encode() + file.read_bytes())
    return {"files": len(files), "digest": sums.hexdigest()}


def staleness(
    name: str, result: Mapping[str, Any] | None, here: Mapping[str, str], options: Options = USUAL
) -> str:
    """The reason why a result does not belong to these digests and options; empty if it does.

    If the options name no folder, a result with any folder is accepted.
    """
    if result is None:
        return "there is no result"
    if "depends_on" not in result:
        return "measured with an unknown version"
    for option, value in options_of(name, options).items():
        was = result["options"].get(option, BEFORE.get(option))
        if value is not None and value != was:
            return f"measured with {option} {was}, and {value} is wanted"
    changed = [
        dependency
        for dependency in EXPERIMENTS[name].depends_on
        if result["depends_on"].get(dependency) != here[dependency]
    ]
    return f"{' and '.join(changed)} changed since {result['commit']}" if changed else ""


def result_of(folder: Path, name: str) -> dict[str, Any] | None:
    """The JSON of an experiment in a folder, if it exists. Raises ExperimentError."""
    path = folder / f"{name}.json"
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None
    except ValueError as error:
        raise ExperimentError(f"{path}: not the JSON of a result: {error}") from None
