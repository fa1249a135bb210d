"""Capsules that cover collision meshes: points inside, search for files, and errors of missing
files.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from support.paths import ARMS
from thirdhand.core.geometry import rotation
from thirdhand.core.separation.body import body_of
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import Settings, converted, robot_description, urdf_path
from thirdhand.settings.file_content import SettingsError
from thirdhand.settings.mesh_cover import capsule_around, covered
from thirdhand.settings.urdf import Shape, Urdf, UrdfError

WAM = (ARMS / "wam.urdf").read_text(encoding="utf-8")
Points = NDArray[np.float64]


def arm_settings() -> dict[str, Any]:
    """Settings of a cell whose arm has the WAM's joints."""
    arm = Settings().arm
    joints = Settings().joints
    return {
        "arm": {"urdf": "arm.urdf", "plate": arm.plate, "posture": list(arm.posture)},
        "joints": {"acceleration": list(joints.acceleration), "jerk": list(joints.jerk)},
    }


def forearm(text: str) -> list[Shape]:
    """The collision shapes of the forearm in a description."""
    return [shape for shape in Urdf(text).shapes if shape.link == "forearm"]


def outside(points: Points, ends: Points, radius: float) -> float:
    """The largest distance of points (N, 3) from a capsule [m]."""
    start = ends[0]
    span = ends[1] - ends[0]
    share = np.clip((points - start) @ span / max(span @ span, 1e-18), 0.0, 1.0)
    return float(np.linalg.norm(points - start - share[:, None] * span, axis=1).max() - radius)


def volume(ends: Points, radius: float) -> float:
    return float(np.pi * radius**2 * (np.linalg.norm(ends[1] - ends[0]) + 4.0 / 3.0 * radius))


def stl(points: Points) -> bytes:
    """A binary STL file of the triangles around points."""
    triangles = np.asarray(points, "<f4")[ConvexHull(points).simplices]
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in triangles)
    return bytes(80) + struct.pack("<I", len(triangles)) + body


def box(x: float, y: float, z: float) -> Points:
    return np.array(
        [(a * x, b * y, c * z) for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)]
    )


@settings(deadline=None, max_examples=40, derandomize=True)
@given(
    arrays(
        float, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-1.0, 1.0, width=32)
    )
)
def test_every_point_is_inside_a_capsule(points: Points) -> None:
    """The points may be flat, or a single one."""
    capsule = np.array(capsule_around(points))
    ends = capsule[:6].reshape(2, 3)
    radius = float(capsule[6])
    assert outside(points, ends, radius) <= 1e-9
    widest = np.linalg.norm(points - points.mean(axis=0), axis=1).max() + 0.001
    assert volume(ends, radius) <= 1.05 * volume(np.zeros((2, 3)), widest)


def plain(points: Points) -> float:
    """The volume of a capsule along the longest edge of the box around points."""
    *short, longest = sorted(np.ptp(points, axis=0))
    return volume(np.array(((0, 0, 0), (0, 0, longest))), float(np.hypot(*short)) / 2)


def described(name: str, scale: str = "") -> str:
    """The WAM with this mesh, rotated and moved, as the only collision shape of its forearm."""
    begin = WAM.index('<link name="forearm">')
    end = WAM.index("</link>", begin)
    shape = (
        '<collision><origin xyz="0.01 0 0.1" rpy="0 0.5 0"/><geometry><mesh '
        f'filename="{name}"{scale}/></geometry>'
    )
    return f'{WAM[:begin]}<link name="forearm">{shape}</collision>{WAM[end:]}'


@pytest.mark.parametrize(
    ("name", "file", "packages"),
    [
        ("meshes/arm.stl", "cell/meshes/arm.stl", ""),
        ("file://{folder}/arm.stl", "arm.stl", ""),
        ("../a%20b.stl", "a%20b.stl", ""),
        ("meshes/arm.stl", "linked/meshes/arm.stl", ""),  # the URDF is a link
        ("package://linked/arm.stl", "linked/arm.stl", ""),
        # the folder above the URDF is the package
        ("package://my_arm/meshes/arm.stl", "meshes/arm.stl", ""),
        ("package://other/arm.stl", "other/arm.stl", ""),  # a package beside my_arm
        ("package://theirs/arm.stl", "ros/share/theirs/arm.stl", "ros/share"),
    ],
)
def test_a_mesh_is_found_where_its_name_leads(
    tmp_path: Path, name: str, file: str, packages: str
) -> None:
    folder = tmp_path / "my_arm"
    (folder / "cell").mkdir(parents=True)
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    points = box(60.0, 50.0, 300.0) + np.array((0.0, 0.0, 40.0))  # in millimetres
    (folder / file).write_bytes(stl(points))
    urdf = folder / ("linked/urdf.xml" if "linked" in file else "cell/arm.urdf")
    urdf.write_text(described(name.format(folder=folder), ' scale="0.001 0.001 0.001"'))
    if "linked" in file:
        (folder / "cell" / "arm.urdf").symlink_to(urdf)
    document = arm_settings()
    document["arm"] |= {"link_radius": 1.0, "packages": ["/nowhere", str(folder / packages)]}
    cell = converted(document, origin="cell.toml", folder=folder / "cell")
    text = robot_description(cell)
    assert "covered_by" not in description(urdf_path(cell), cover=False)
    (folder / file).unlink()
    assert covered(text, tmp_path / "elsewhere.urdf") == text  # a recording needs no mesh files
    (shape,) = forearm(text)
    points_m = points * 0.001 @ rotation(shape.rotation).T + shape.translation
    capsules = body_of(cell, text).capsules
    mine = [
        capsule
        for capsule in capsules
        if outside(points_m, capsule["ends"], capsule["radius"]) <= 1e-9
    ]
    assert [round(float(capsule["radius"]), 2) for capsule in mine] == [0.04]
    assert capsules["radius"].max() < 0.2  # `link_radius` is not used


@pytest.mark.parametrize(
    ("name", "told"),
    [
        (
            "package://no_arm/link.stl",
            "package 'no_arm' with this file is in none of {folder}/, ",
        ),
        (
            "meshes/link.stl",
            "there is no {folder}/meshes/link.stl; put it there. Links with a box, cylinder or "
            "sphere instead",
        ),
        ("broken.stl", "cannot be read"),
    ],
)
def test_missing_mesh_is_refused_by_its_name(tmp_path: Path, name: str, told: str) -> None:
    """A file that is no mesh is refused too."""
    (tmp_path / "broken.stl").write_bytes(b"no mesh")
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(described(name))
    with pytest.raises(UrdfError) as error:
        covered(urdf.read_text(), urdf)
    assert f"{urdf}: the collision mesh {name} of link 'forearm'" in str(error.value)
    assert told.format(folder=tmp_path) in str(error.value)
    with pytest.raises(SettingsError, match=r"\[arm\] urdf: .*the collision mesh"):
        robot_description(Settings(arm=Settings().arm.__class__(urdf=str(urdf))))


def collada(points: Points, unit: str, node: str = "", up: str = "Z_UP") -> str:
    """A Collada file of the triangles around points, in a node that may be turned."""
    numbers = " ".join(f"{value:.9g}" for value in points.ravel())
    corners = " ".join(map(str, ConvexHull(points).simplices.ravel().tolist()))
    count = len(ConvexHull(points).simplices)
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="unit" meter="{unit}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="s"><float_array id="a" count="{points.size}">{numbers}</float_array><technique_common>
<accessor source="#a" count="{len(points)}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="{count}"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="n">{node}<instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""


def around(shape: Shape, points: Points) -> float:
    """The largest distance of points in a link's frame from the capsule of a mesh [m]."""
    ends = np.reshape(shape.size[:6], (2, 3)) @ rotation(shape.rotation).T + shape.translation
    return outside(points, ends, shape.size[6])


LEG = box(0.05, 0.06, 0.3) + np.array((0.02, 0.03, 0.15))
QUARTER = "<matrix>0 -1 0 0 1 0 0 0 0 0 1 0 0 0 0 1</matrix>"  # about z
TURNED = LEG @ np.array(((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))


@pytest.mark.parametrize(
    ("name", "data", "scale", "expected"),
    [
        ("a.stl", stl(LEG), "", LEG),
        ("a.STL", stl(1000 * LEG), ' scale="0.001 0.001 0.001"', LEG),
        ("a.stl", stl(LEG), ' scale="1 -1 1"', LEG * (1, -1, 1)),
        ("a.stl", stl(LEG), ' scale="-1 2 0.5"', LEG * (-1, 2, 0.5)),
        ("a.dae", collada(1000 * LEG, "0.001"), "", LEG),
        # the result of RViz and MoveIt
        ("a.dae", collada(1000 * LEG, "0.001", QUARTER, "Y_UP"), "", TURNED),
        (
            "a.obj",
            "".join(f"v {x} {y} {z}\n" for x, y, z in LEG) + "f 1 2 3\nf 4 5 6\nf 6 7 8\n",
            "",
            LEG,
        ),
    ],
)
def test_mesh_has_the_size_and_direction_of_the_urdf(
    name: str, data: bytes | str, scale: str, expected: Points, tmp_path: Path
) -> None:
    """Unit and up axis of the file count too."""
    (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    (tmp_path / "arm.urdf").write_text(described(name, scale))
    (shape,) = forearm(description(tmp_path / "arm.urdf"))
    points_m = expected @ rotation(shape.rotation).T + shape.translation
    assert around(shape, points_m) <= 1e-5
    ends = np.reshape(shape.size[:6], (2, 3))
    assert volume(ends, shape.size[6]) < 1.1 * plain(expected)


def test_each_mesh_of_a_link_has_its_capsule(tmp_path: Path) -> None:
    for name, points in (("a.stl", LEG), ("b.stl", LEG + np.array((0.2, 0.0, 0.0)))):
        (tmp_path / name).write_bytes(stl(points))
    second = '</collision><collision><geometry><mesh filename="b.stl"/></geometry></collision>'
    text = described("a.stl").replace(
        '<mesh filename="a.stl"/></geometry></collision>',
        f'<mesh filename="a.stl"/></geometry>{second}',
    )
    (tmp_path / "arm.urdf").write_text(text)
    shapes = forearm(description(tmp_path / "arm.urdf"))
    assert [round(shape.size[6], 2) for shape in shapes] == [0.04, 0.04]
    assert around(shapes[1], LEG + np.array((0.2, 0.0, 0.0))) <= 1e-5


@pytest.mark.parametrize(
    ("data", "scale", "said"),
    [
        (
            stl(LEG).replace(struct.pack("<f", np.float32(LEG[1, 2])), struct.pack("<f", np.nan)),
            "",
            "finite numbers",
        ),
        (bytes(80) + struct.pack("<I", 0), "", "vertices with finite numbers needed"),
        (stl(LEG)[:-20], "", "cannot be read"),
        (stl(LEG), ' scale="nan 1 1"', "finite numbers up to 1e+06 needed"),
        (stl(LEG), ' scale="0 1 1"', "scale '0 1 1' given; three finite numbers"),
        (stl(1000 * LEG), "", "the mesh of link 'forearm' is 378 m long"),
    ],
)
def test_what_is_no_mesh_of_an_arm_is_refused(
    data: bytes, scale: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "a.stl").write_bytes(data)
    (tmp_path / "arm.urdf").write_text(described("a.stl", scale))
    with pytest.raises(SettingsError, match=re.escape(said)) as error:
        converted(arm_settings(), origin="cell.toml", folder=tmp_path)
    assert "forearm" in str(error.value)


def test_capsules_are_kept_and_found_anew_where_they_are_spoilt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "a.stl").write_bytes(stl(LEG))
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(described("a.stl"))

    def found() -> str:
        covered.cache_clear()
        return description(urdf)

    first = found()
    (cache,) = (tmp_path / "home" / ".cache" / "thirdhand" / "capsules").iterdir()
    right = cache.read_text()
    cache.write_text(right.replace(right.split()[6], "0.5"))
    assert found() != first  # the file in the cache is used
    for spoilt in ("", "nan " * 7, "1 2 3", "1 2 3 4 5 6 -7", "\udcff"):
        cache.write_bytes(spoilt.encode(errors="surrogateescape"))
        assert found() == first
        assert cache.read_text() == right
    (tmp_path / "a.stl").write_bytes(stl(LEG * 0.5))
    assert found() != first
    monkeypatch.setenv("HOME", "/dev/null")
    assert found() != first
