"""Covers the collision meshes of a URDF with capsules, which are written beside the meshes' names:
so whoever has the text needs no file besides.
"""

from __future__ import annotations

import contextlib
import functools
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from service.urdf import COVER, UrdfError

Points = NDArray[np.float64]
ROUNDED = 4  # digits of a capsule's ends [m]; its radius is that much larger
TINY = 1e-12  # [m²]


@functools.cache
def covered(text: str, path: Path, packages: tuple[str, ...] = ()) -> str:
    """The URDF in a file, with a capsule around each collision mesh that has none. `packages` are
    folders in which ROS has packages.

    Raises UrdfError for a mesh that is not found, or is none.
    """
    robot = ElementTree.fromstring(text)
    for link in robot.iter("link"):
        for mesh in (found for one in link.iter("collision") for found in one.iter("mesh")):
            if COVER not in mesh.attrib:
                scale = [float(number) for number in mesh.get("scale", "1 1 1").split()]
                points = _read(mesh.get("filename", ""), path, packages, link.get("name", "")) * scale
                mesh.set(COVER, " ".join(f"{number:.5f}" for number in capsule_around(points)))
    return ElementTree.tostring(robot, encoding="unicode")


def _read(name: str, urdf: Path, packages: tuple[str, ...], link: str) -> Points:
    """The vertices (N, 3) of a mesh."""
    scheme, _, rest = name.rpartition("://")
    package, _, inside = rest.partition("/")
    tried = [urdf.parent / rest]
    if scheme == "package":
        above = urdf.absolute().parents
        tried = [folder / inside for folder in above if folder.name == package]
        tried += [folder / package / inside for folder in (*above, *(Path(one).expanduser() for one in packages))]
    file = next((one for one in tried if one.is_file()), None)
    what = f"{urdf}: the collision mesh {name} of link {link!r}"
    if file is None:
        where = f"package {package!r} is in no folder above the URDF, and in none of $.arm.packages: name its folder's"
        raise UrdfError(
            f"{what} is not found: {where if scheme == 'package' else f'there is no {tried[0]}: put it'} there, or "
            "give the link a box, cylinder or sphere instead"
        )
    import coal  # heavy, and few arms need it

    try:
        return np.array(coal.MeshLoader().load(str(file), np.ones(3)).vertices())
    except (ValueError, RuntimeError) as error:
        raise UrdfError(f"{what} cannot be read: {error}") from None


def capsule_around(points: Points) -> tuple[float, ...]:
    """The ends of its axis and the radius (7,) [m] of a capsule about as small and thin as any that
    holds all points (N, 3).
    """
    with contextlib.suppress(QhullError, ValueError):  # flat, or too few
        points = points[ConvexHull(points).vertices]

    def radius(ends: Points) -> float:
        start, way = ends[:3], ends[3:] - ends[:3]
        share = np.clip((points - start) @ way / (way @ way + TINY), 0.0, 1.0)
        return float(np.linalg.norm(points - start - share[:, None] * way, axis=1).max())

    def cost(ends: Points) -> float:  # volume times radius
        r = radius(ends) + 10.0**-ROUNDED  # at 0, on a line, no length would cost anything
        return r * r * r * float(np.linalg.norm(ends[3:] - ends[:3]) + 4.0 / 3.0 * r)

    middle = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - middle)
    reaches = axes[: len(sizes)] * sizes[:, None] / math.sqrt(len(points))
    tried = [minimize(cost, [*(middle - way), *(middle + way)], method="Nelder-Mead") for way in reaches]
    ends = np.round(min(tried, key=lambda one: one.fun).x, ROUNDED)
    return (*ends, radius(ends) + 10.0**-ROUNDED)
