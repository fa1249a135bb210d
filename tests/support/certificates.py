"""Certificates, made by the commands in docs/access.md."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from support.paths import ROOT


def make_certificates(folder: Path, *more: str, expired: str = "") -> Path:
    """A new folder `secrets` in a folder, with certificates of an authority for each role, for
    `more` names, and for `expired` names, which are separated by spaces.
    """
    page = (ROOT / "docs" / "access.md").read_text(encoding="utf-8")
    authority, names, loop = re.findall(
        r"```sh\n(umask .*?)for name in (.*?);(.*?)```", page, re.DOTALL
    )[0]
    commands = f"{authority}for name in {' '.join([names, *more])};{loop}"
    commands += f"for name in {expired};{loop.replace('-days 3650', '-days -1')}"
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        ["bash", "-euo", "pipefail", "-c", commands], cwd=folder, check=True, capture_output=True
    )
    return folder / "secrets"
