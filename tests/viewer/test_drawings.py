"""Content of a drawing: the arm without meshes, labels, and the time of a picture."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.recorded import TEXT, at_ns, drawn, ticks, values, viewed
from support.wicked import WICKED, wicked_skill
from thirdhand.command_line import main
from thirdhand.contract.messages import SceneObject
from thirdhand.contract.printable import as_markdown, printable
from thirdhand.contract.records import Mode, Reason
from thirdhand.contract.requests import encode_json
from thirdhand.core.frame import Record
from thirdhand.core.separation.body import body_of
from thirdhand.settings.config import WAM, Settings
from thirdhand.viewer.stream import Viewer
from thirdhand.workbench.cli.view import RRD_MAGIC, last_followed, screenshot


@pytest.mark.usefixtures("drawing")
@pytest.mark.thorough
def test_picture_is_of_the_last_followed_moment(tmp_path: Path) -> None:
    """The last moment in `follow` is the default time of a picture."""

    def change(_: Viewer, k: int, frame: Record) -> None:
        if k >= 400:
            frame["mode"] = Mode.FAULT
            frame["reason"] = Reason.ARM_SILENT

    viewed(tmp_path / "a.rrd", 600, change)
    assert last_followed(tmp_path / "a.rrd", 599 * 2_000_000) == 400 * 2_000_000 - 1
    screenshot(tmp_path / "a.rrd", tmp_path / "a.png")
    screenshot(tmp_path / "a.rrd", tmp_path / "b.png", time=0.5)
    corners = []
    for name in ("a.png", "b.png"):
        with Image.open(tmp_path / name) as picture:
            corners.append(
                np.asarray(
                    picture.crop((picture.width - 200, 0, picture.width, 28)).convert("L"), int
                )
            )
    assert all((corner > 128).sum() > 50 for corner in corners)  # the corner with the time
    assert (corners[0] != corners[1]).any()


def test_arm_without_meshes_is_drawn_by_capsules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The log says so."""
    shape = re.compile("(<visual>.*?<geometry>).*?(</geometry>)", re.DOTALL)
    mesh = r'\1<mesh filename="package://wam_description/meshes/link.stl"/>\2'
    urdf = shape.sub(mesh, WAM.read_text(encoding="utf-8"))
    package = tmp_path / "packages" / "wam_description"
    (package / "meshes").mkdir(parents=True)
    (package / "package.xml").write_text(
        "<package><name>wam_description</name></package>", encoding="utf-8"
    )
    corner = "".join(f"  vertex {x} {y} 0\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    solid = f"solid a\nfacet normal 0 0 1\n outer loop\n{corner} endloop\nendfacet\nendsolid a\n"
    (package / "meshes" / "link.stl").write_text(solid, encoding="utf-8")
    shutil.copytree(tmp_path / "packages", tmp_path / "unfetched")
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0a1b\nsize 284184\n"
    (tmp_path / "unfetched" / "wam_description" / "meshes" / "link.stl").write_bytes(pointer)
    shutil.copytree(tmp_path / "packages", tmp_path / "untextured")
    meshes = tmp_path / "untextured" / "wam_description" / "meshes"
    (meshes / "link.stl").unlink()
    (meshes / "link.obj").write_text("mtllib link.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (meshes / "link.mtl").write_bytes(pointer)
    cases = {
        "untextured": r"link\.mtl: it is a pointer of Git LFS",
        "nowhere": "ROS_PACKAGE_PATH names more",
        "unfetched": r"link\.stl: it is a pointer of Git LFS",
        "packages": "",
    }
    for name, words in cases.items():
        folder = tmp_path / name
        is_drawn = bool(words)
        mesh_name = "link.obj" if name == "untextured" else "link.stl"
        (tmp_path / "arm.urdf").write_text(urdf.replace("link.stl", mesh_name), encoding="utf-8")
        monkeypatch.setenv("ROS_PACKAGE_PATH", str(folder))
        view = Viewer(urdf=tmp_path / "arm.urdf", settings=Settings(), rrd=tmp_path / "a.rrd")
        for tick, frame, timing in ticks(30):
            view.add(frame, at_ns(tick.index), timing)
        view.close()
        rows = drawn(tmp_path / "a.rrd")
        radii = [
            len(values(rows[path], "Capsules3D:radii")[0])
            for path in rows
            if path.startswith("/arm/capsules/")
        ]
        assert sum(radii) == (
            len(body_of(Settings(), WAM.read_text(encoding="utf-8")).capsules) if is_drawn else 0
        )
        texts = [text for (text,) in values(rows["/log"], TEXT) if "drawn by its capsules" in text]
        assert len(texts) == is_drawn
        assert re.search(words, "".join(texts))
        # the library's own warning is not printed
        assert "WARN" not in "".join(capfd.readouterr())


def test_without_vulkan_one_line_tells_what_a_picture_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, os.devnull)
    (tmp_path / "a.rrd").write_bytes(RRD_MAGIC)
    assert main(["view", str(tmp_path / "a.rrd"), "--screenshot", str(tmp_path / "a.png")]) == 1
    error = capfd.readouterr().err
    assert error.startswith("thirdhand view: a picture without a screen needs a Vulkan driver")
    assert "apt install mesa-vulkan-drivers" in error
    assert error.count("\n") == 1


def test_names_and_notes_are_drawn_without_effects(tmp_path: Path) -> None:
    thing = SceneObject(
        WICKED, "box", "base", (0.5, 0.4, 0.2), (0, 0, 0, 1), (0.1, 0.1, 0.1), (1, 1, 1, 1)
    )

    def change(one: Viewer, k: int, _: Record) -> None:
        if k == 10:
            one.note("objects", encode_json((thing,)).decode(), at_ns(k))
            one.note("log", f"rejected: {WICKED}", at_ns(k))
            one.note("requests", f"skill {encode_json({'name': WICKED}).decode()}", at_ns(k))

    rows = viewed(tmp_path / "a.rrd", 30, change, skill=wicked_skill())
    (named,) = (path for path in rows if re.fullmatch(r"/scene/things/.*/name", path))
    assert values(rows[named], "Points3D:labels")[-1] == [printable(WICKED)]
    log = [text for (text,) in values(rows["/log"], "TextLog:text")]
    assert f"rejected: {printable(WICKED)}" in log
    assert f"Skill {printable(WICKED)} is in force." in log
    ((about,),) = values(rows["/about/skill"], "TextDocument:text")
    assert as_markdown(WICKED) in about
    assert all(line.isprintable() for text in (*log, about) for line in text.split("\n"))
