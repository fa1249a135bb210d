"""The distributions of this project, installed into folders without pip."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

from hatchling.builders.wheel import WheelBuilder


def wheel_of(project: Path, folder: Path, *, editable: bool = False) -> Path:
    """The wheel of a project, built into a folder."""
    kind = "editable" if editable else "standard"
    [built] = WheelBuilder(str(project)).build(directory=str(folder), versions=[kind])
    return Path(built)


def unpacked(wheel: Path, site: Path) -> Path:
    """A folder of installed packages, with the files of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site


def isolated(site: Path, code: str, *needs: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """A program, run by an interpreter with the standard library, a folder of installed packages,
    and links to the packages that it needs.
    """
    for name in needs:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        link = site / name
        if not link.exists():
            link.symlink_to(Path(spec.origin).parent)
    program = f"import site; site.addsitedir({str(site)!r})\n{code}"
    return subprocess.run(
        [sys.executable, "-I", "-S", "-c", program],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        **more,
    )
