"""MediaPipe's model of hands: its origin, and the file that MediaPipe loads.

Later packages of MediaPipe come without a model, and expect it to be fetched from a server. The
package of version 0.10.21 still has its two networks. They are extracted from the package once. It
is not installed, because it needs NumPy 1.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.settings.user_folder import user_folder

PACKAGE = "mediapipe==0.10.21"
# the networks are the same in the packages of all platforms
PLATFORM = ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11")
NETWORKS = {  # name in the model: path in the package, SHA-256
    "hand_detector.tflite": (
        "mediapipe/modules/palm_detection/palm_detection_full.tflite",
        "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    ),
    "hand_landmarks_detector.tflite": (
        "mediapipe/modules/hand_landmark/hand_landmark_full.tflite",
        "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
    ),
}
DOWNLOAD_TIMEOUT_S = 600.0


class HandModelError(ExplainedError, RuntimeError):
    """There is no model of hands; the message has the cause."""


def hand_model(given: Path | None, say: Callable[[str], object]) -> Path:
    """The model's file: the one `given` (a model, or the package's wheel), or that in the user's
    cache, made from the package when it is first needed. Raises HandModelError.
    """
    if given is not None and not given.is_file():
        raise HandModelError(
            f"{given}: there is no such file; a hand_landmarker.task or the wheel of {PACKAGE} "
            "needed"
        )
    if given is not None and given.suffix != ".whl":
        return given
    model = user_folder("cache") / "hand_landmarker-0.10.21.task"
    if given is not None:
        return _made(model, given)
    if not model.exists():
        say(f"extracting the model of hands from the package {PACKAGE} (36 MB, once)")
        with tempfile.TemporaryDirectory() as folder:
            _made(model, _downloaded(Path(folder)))
    return model


def _downloaded(folder: Path) -> Path:
    arguments = [
        "download",
        "--quiet",
        "--no-deps",
        "--only-binary=:all:",
        *PLATFORM,
        "--dest",
        str(folder),
        PACKAGE,
    ]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments],
            capture_output=True,
            text=True,
            timeout=DOWNLOAD_TIMEOUT_S,
            check=False,
        )
        reason = (done.stderr.strip().splitlines() or [""])[-1]
    except subprocess.TimeoutExpired:
        reason = f"no answer within {DOWNLOAD_TIMEOUT_S:g} s"
    wheels = list(folder.glob("*.whl"))
    if not wheels:
        raise HandModelError(
            f"the package {PACKAGE} could not be downloaded: {reason}. On a machine with a "
            f"network: pip {' '.join(arguments[:-3])} {PACKAGE}; then give the wheel here by "
            "--model FILE.whl"
        )
    return wheels[0]


def _made(model: Path, wheel: Path) -> Path:
    """Write the model from the package's wheel. Raises HandModelError."""
    try:
        with zipfile.ZipFile(wheel) as package:
            networks = {name: package.read(path) for name, (path, _) in NETWORKS.items()}
    except (OSError, zipfile.BadZipFile, KeyError) as error:
        raise HandModelError(
            f"{wheel}: {in_words(error, named=False)}; the wheel of {PACKAGE} needed"
        ) from None
    for name, network in networks.items():
        if hashlib.sha256(network).hexdigest() != NETWORKS[name][1]:
            raise HandModelError(f"{wheel}: its {NETWORKS[name][0]} is not that of {PACKAGE}")
    try:
        model.parent.mkdir(parents=True, exist_ok=True)
        part_file = model.with_suffix(f".{os.getpid()}")
        with zipfile.ZipFile(part_file, "w", zipfile.ZIP_STORED) as task:
            for name, network in networks.items():
                task.writestr(name, network)
        part_file.replace(model)
    except OSError as error:
        raise HandModelError(f"{model} cannot be written: {in_words(error, named=False)}") from None
    return model
