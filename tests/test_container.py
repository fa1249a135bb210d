"""The container in examples/: image, services and settings agree with this version."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from support.installed import wheel_of
from support.paths import ROOT
from thirdhand.command_line import parser
from thirdhand.settings.config import Settings, parse

EXAMPLES = ROOT / "examples"
IMAGE = (EXAMPLES / "Containerfile").read_text(encoding="utf-8")
COMPOSE: dict[str, Any] = yaml.safe_load((EXAMPLES / "compose.yaml").read_text(encoding="utf-8"))


def instruction(name: str) -> list[str]:
    """The words of the last instruction of this name, which is in list form."""
    return list(json.loads(re.findall(rf"^{name} .*?(\[.*\])$", IMAGE, re.MULTILINE)[-1]))


def test_image_installs_this_distribution_and_runs() -> None:
    """The versions are the tested ones, and commands run without rights of the superuser."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = re.findall(r'"/source\[(.*?)\]"', IMAGE)[0].split(",")
    assert set(extras) <= set(project["optional-dependencies"])
    assert "--constraint /source/.ci/constraints.txt" in IMAGE
    assert re.findall(r"FROM \S*/python:(\d\.\d+)", IMAGE) == ["3.11", "3.11"]
    assert IMAGE.index("USER 10001") < IMAGE.index("ENTRYPOINT")
    assert instruction("ENTRYPOINT") == ["thirdhand"]
    served = parser().parse_args(instruction("CMD"))
    assert (served.run, served.hold, served.log) == ("thirdhand.cli.serve.serve", True, "json")
    checked = parser().parse_args(instruction("HEALTHCHECK")[1:])
    assert (checked.run, checked.exit_code) == ("thirdhand.cli.status.status", True)


def test_what_is_copied_into_the_image_suffices_for_the_wheel(tmp_path: Path) -> None:
    for sources, target in re.findall(r"^COPY ((?!--).*) /source/?(.*)$", IMAGE, re.MULTILINE):
        for source in sources.split():
            if (ROOT / source).is_dir():
                shutil.copytree(
                    ROOT / source, tmp_path / target, ignore=shutil.ignore_patterns("__pycache__")
                )
            else:
                (tmp_path / target).mkdir(exist_ok=True)
                shutil.copy(ROOT / source, tmp_path / target)
    with (
        zipfile.ZipFile(wheel_of(tmp_path, tmp_path / "dist")) as wheel,
        zipfile.ZipFile(wheel_of(ROOT, tmp_path / "whole")) as whole,
    ):
        assert sorted(wheel.namelist()) == sorted(whole.namelist())


def test_services_reach_each_other() -> None:
    """The services' commands are those of this version."""
    services = COMPOSE["services"]
    configs = COMPOSE["configs"]
    cell, metrics = (parser().parse_args(services[name]["command"]) for name in ("cell", "metrics"))
    assert (cell.run, cell.hold) == ("thirdhand.cli.serve.serve", True)
    assert metrics.run == "thirdhand.workbench.cli.metrics.metrics"
    settings = parse(configs["bench"]["content"], origin="compose.yaml")
    assert isinstance(settings, Settings)
    assert [str(cell.config)] == [config["target"] for config in services["cell"]["configs"]]
    router = services["router"]["command"]
    assert (
        list(settings.network.connect) == metrics.connect == [router[router.index("--listen") + 1]]
    )
    assert services["router"]["image"].split(":")[1] in (
        ROOT / ".ci" / "constraints.txt"
    ).read_text(encoding="utf-8")
    scraped = yaml.safe_load(configs["prometheus"]["content"])
    assert scraped["scrape_configs"][0]["static_configs"][0]["targets"] == [metrics.listen]
    rules, inside, _ = services["prometheus"]["volumes"][0].split(":")
    assert (EXAMPLES / rules).is_file()
    assert scraped["rule_files"] == [inside]
    assert settings.files.record.startswith("/var/lib/thirdhand/")
    assert services["cell"]["volumes"] == ["state:/var/lib/thirdhand"]
    assert services["cell"]["ulimits"] == {"rtprio": 90, "memlock": -1}


@pytest.mark.skipif(shutil.which("hadolint") is None, reason="hadolint is not installed")
def test_a_linter_accepts_the_image() -> None:
    done = subprocess.run(
        ["hadolint", str(EXAMPLES / "Containerfile")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout
