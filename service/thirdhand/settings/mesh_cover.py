"""Capsules around the collision meshes of a URDF, written into the URDF beside the meshes' names,
so that the text alone describes the arm's shape.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import math
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.explain import in_words
from thirdhand.settings.file_content import content
from thirdhand.settings.urdf import COVER, UrdfError

Points = NDArray[np.float64]
MAX_MESH_BYTES = 20_000_000  # of a collision mesh; a larger one takes gigabytes of memory
END_DIGITS = 4  # a capsule's ends are rounded to 0.1 mm, and its radius is enlarged by 0.1 mm
MIN_AXIS2_M2 = 1e-12  # added to a squared length, so that an axis of length 0 divides nothing by 0
CAPSULE_CACHE = Path("~/.cache/thirdhand/capsules")  # files are named by a digest of mesh and scale
EVALUATIONS = 100  # the cost is evaluated this often for each principal axis
# first steps: two tilts, two offsets / size
SIMPLEX = np.vstack((np.zeros(4), np.diag((0.3, 0.3, 0.1, 0.1))))
RADII = np.linspace(1.0, 1.5, 12)  # tried radii / smallest radius that holds all points
_HEIGHTS = (np.arange(100) + 0.5) / 100
# the golden angle spreads directions evenly
_TURNS = np.arange(100) * math.pi * (3.0 - math.sqrt(5.0))
DIRECTIONS = np.column_stack(
    (
        np.sqrt(1.0 - _HEIGHTS**2) * np.cos(_TURNS),
        np.sqrt(1.0 - _HEIGHTS**2) * np.sin(_TURNS),
        _HEIGHTS,
    )
).astype(np.float32)  # (100, 3) unit vectors over half a sphere


@functools.cache
def covered(text: str, path: Path, packages: tuple[str, ...] = ()) -> str:
    """The URDF in a file, with a capsule around each collision mesh that has none. `packages` are
    folders of ROS packages.

    Raises UrdfError for a mesh that is not found, is not a mesh, or has vertices that are not
    finite.
    """
    robot = ElementTree.fromstring(text)
    if lost := unfound(robot, path, packages, "collision"):
        raise UrdfError(
            f"{path}: {lost}. Links with a box, cylinder or sphere instead need no mesh"
        )
    for link in robot.iter("link"):
        for mesh in (element for shape in link.iter("collision") for element in shape.iter("mesh")):
            if COVER not in mesh.attrib:
                mesh.set(
                    COVER,
                    " ".join(f"{number:.5f}" for number in _capsule(mesh, link, path, packages)),
                )
    return ElementTree.tostring(robot, encoding="unicode")


def _capsule(
    mesh: ElementTree.Element, link: ElementTree.Element, urdf: Path, packages: tuple[str, ...]
) -> tuple[float, ...]:
    """The capsule around a mesh in its own frame, with the URDF's scale; a negative scale mirrors
    the mesh. Raises UrdfError.
    """
    name = mesh.get("filename", "")
    scale = mesh.get("scale", "1 1 1")
    subject = f"{urdf}: the collision mesh {name} of link {link.get('name', '')!r}"
    try:
        factors = np.array([float(number) for number in scale.split()])
        if factors.shape != (3,) or not np.isfinite(factors).all() or not factors.all():
            raise UrdfError(
                f"{subject}: scale {scale!r} given; three finite numbers, none of them 0, needed"
            )
        file = next(
            candidate for candidate in _candidates(name, urdf, packages) if candidate.is_file()
        )
        data = content(file, MAX_MESH_BYTES)
        made_by = hashlib.sha256(Path(__file__).read_bytes())
        made_by.update(repr((file.suffix.lower(), factors.tolist())).encode() + data)
        if (capsule := _kept(made_by.hexdigest())) is None:
            points = _vertices(file, data) * factors
            if not len(points) or not np.isfinite(points).all():
                raise ValueError("vertices with finite numbers needed")
            capsule = capsule_around(points)
            _keep(made_by.hexdigest(), capsule)
    except (ValueError, RuntimeError, OSError) as error:
        if isinstance(error, UrdfError):
            raise
        # the library's source file is cut off
        words = in_words(error, named=False).rpartition("message:")[2]
        raise UrdfError(f"{subject} cannot be read: {' '.join(words.split())}") from None
    return capsule


def found_meshes(
    robot: ElementTree.Element, urdf: Path, packages: tuple[str, ...]
) -> Iterator[tuple[ElementTree.Element, Path]]:
    """The meshes of a robot whose files exist, each with its file."""
    for mesh in robot.iter("mesh"):
        candidates = _candidates(mesh.get("filename", ""), urdf, packages)
        if file := next((candidate for candidate in candidates if candidate.is_file()), None):
            yield mesh, file


def unfound(robot: ElementTree.Element, urdf: Path, packages: tuple[str, ...], kind: str) -> str:
    """A message on the meshes of a kind (collision or visual) that are not found: their names, the
    searched folders, and how to add a folder. Empty if all are found or covered.
    """
    lost = _lost(robot, urdf, packages, kind)
    if not lost:
        return ""
    name, link_name = next(iter(lost.items()))
    problem = f"the {kind} mesh {name} of link {link_name!r} is not found"
    if len(lost) > 1:
        links = ", ".join(dict.fromkeys(lost.values()))
        problem = f"{len(lost)} {kind} meshes of links {links} are not found, the first is {name}"
    tried = _candidates(name, urdf, packages)
    if not name.startswith(("package://", "model://")):
        return f"{problem}: there is no {tried[0]}; put it there"
    path = name.rpartition("://")[2]
    folders = ", ".join(
        str(candidate).removesuffix(path) for candidate in tried if str(candidate).endswith(path)
    )
    return (
        f"{problem}; package {path.partition('/')[0]!r} with this file is in none of {folders}. "
        "Name the folder that holds the package in [arm] packages (`thirdhand arm`: by --packages)"
    )


def _lost(
    robot: ElementTree.Element, urdf: Path, packages: tuple[str, ...], kind: str
) -> dict[str, str]:
    """The link of each mesh of a kind that is neither found nor covered, by the mesh's name."""
    links: dict[str, str] = {}
    for link in robot.iter("link"):
        for mesh in (element for shape in link.iter(kind) for element in shape.iter("mesh")):
            name = mesh.get("filename", "")
            files = [] if COVER in mesh.attrib else _candidates(name, urdf, packages)
            if files and not any(file.is_file() for file in files):
                links.setdefault(name, link.get("name", ""))
    return links


def _candidates(name: str, urdf: Path, packages: tuple[str, ...]) -> list[Path]:
    """The paths at which the file of a mesh may be."""
    # the folder of the URDF, and if it is a symbolic link, that of the file to which it leads
    folders = dict.fromkeys((urdf.absolute().parent, urdf.resolve().parent))
    scheme, _, path = name.rpartition("://")
    if scheme in ("package", "model"):
        return _in_packages(path, folders, packages)
    if not scheme:
        path = name.removeprefix("file:") if name.startswith("file:/") else name
    elif scheme == "file" and path.startswith("localhost/"):
        path = path.removeprefix("localhost")
    files = dict.fromkeys((path, unquote(path)))
    return [folder / file for file in files for folder in folders]


def _in_packages(path: str, folders: Iterable[Path], packages: tuple[str, ...]) -> list[Path]:
    """The paths at which a package's file may be: the package is a folder above the URDF, or lies
    in one, or in one of `packages`.
    """
    package, _, inside = path.partition("/")
    above = dict.fromkeys(parent for folder in folders for parent in (folder, *folder.parents))
    roots = [*above, *(Path(root).expanduser() for root in packages)]
    return [
        *(folder / inside for folder in roots if folder.name == package),
        *(folder / package / inside for folder in roots),
    ]


def _vertices(file: Path, data: bytes) -> Points:
    """The vertices (N, 3) of a mesh [m], in the axes of the file.

    A binary STL file has 80 bytes, the number of triangles, and 50 bytes for each triangle. A
    Collada file has a unit. Its <up_axis> is ignored, as in RViz and MoveIt, because robots' meshes
    are drawn in the frames of their links.
    """
    count = int.from_bytes(data[80:84], "little")
    if file.suffix.lower() == ".stl" and len(data) == 84 + 50 * count:
        triangles = np.frombuffer(
            data[84:], np.dtype([("normal", "<f4", 3), ("at", "<f4", (3, 3)), ("", "<u2")])
        )
        return triangles["at"].reshape(-1, 3).astype(np.float64)
    import coal  # its import is slow, and few arms need it

    unit = _unit_m(data) if file.suffix.lower() == ".dae" else 1.0
    return unit * np.array(coal.MeshLoader().load(str(file), np.ones(3)).vertices())


def _unit_m(collada: bytes) -> float:
    """The unit of a Collada file [m]."""
    for _, element in ElementTree.iterparse(io.BytesIO(collada)):
        if element.tag.endswith("}unit"):
            return float(element.get("meter", "1"))
        if element.tag.endswith("}asset"):
            break
    return 1.0


def _kept(name: str) -> tuple[float, ...] | None:
    """A cached capsule; None if there is no such file, or it does not hold a capsule."""
    # RuntimeError: a user without a home
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        capsule = tuple(
            float(number)
            for number in (CAPSULE_CACHE.expanduser() / name).read_text(encoding="ascii").split()
        )
        if len(capsule) == 7 and all(map(math.isfinite, capsule)) and capsule[6] > 0.0:
            return capsule
    return None


def _keep(name: str, capsule: tuple[float, ...]) -> None:
    """Cache a capsule. If the folder is not writable, it is computed again each time."""
    with contextlib.suppress(OSError, RuntimeError):
        folder = CAPSULE_CACHE.expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as part:
            file = Path(part, name)
            file.write_text(" ".join(map(repr, map(float, capsule))), encoding="ascii")
            file.replace(folder / name)


def capsule_around(points: Points) -> tuple[float, ...]:
    """A small and thin capsule that holds all points (N, 3): the ends of its axis and its radius
    (7,) [m].

    The axis is a principal axis of the points, changed by two tilts and two offsets. For points at
    distances d from it and heights h along it, a radius r requires the axis to reach from
    min(h + sqrt(r² - d²)) to max(h - sqrt(r² - d²)). The radius of lowest cost is taken.
    """
    from scipy.optimize import minimize  # a slow import, which a cover from the cache does not need

    outline = _outline(points)
    middle = outline.mean(axis=0)
    outline = outline - middle
    size = float(np.abs(outline).max()) + 10.0**-END_DIGITS
    best = (math.inf, np.zeros(6))

    def around(q: Points, axis: Points, across: Points) -> tuple[float, Points]:
        along = axis + q[:2] @ across
        return _along(outline, along / np.linalg.norm(along), size * (q[2:] @ across))

    def cost(q: Points, axis: Points, across: Points) -> float:
        return around(q, axis, across)[0]

    for axis in np.linalg.eigh(outline.T @ outline)[1].T:
        across = np.linalg.svd(axis[None])[2][1:]
        optimum = minimize(
            cost,
            np.zeros(4),
            (axis, across),
            method="Nelder-Mead",
            options={
                "maxfev": EVALUATIONS,
                "initial_simplex": SIMPLEX,
                "xatol": 1e-3,
                "fatol": 1e-4 * size**4,
            },
        )
        best = min(best, around(optimum.x, axis, across), key=lambda one: one[0])
    ends = np.round(best[1] + np.tile(middle, 2), END_DIGITS)
    return (*ends.tolist(), _radius(points, ends) + 10.0**-END_DIGITS)


def _along(points: Points, along: Points, start: Points) -> tuple[float, Points]:
    """Cost and ends of the axis (6,) of the best capsule along a line that holds points (N, 3).

    cost = volume * radius.
    """
    away = points - start
    heights = away @ along
    squares = np.maximum((away * away).sum(axis=1) - heights * heights, 0.0)
    # above 0, or points on a line cost nothing
    radii = (math.sqrt(squares.max()) + 10.0**-END_DIGITS) * RADII
    depths = np.sqrt(radii[:, None] ** 2 - squares)
    low = (heights + depths).min(axis=1)
    high = (heights - depths).max(axis=1)
    low, high = (
        np.where(low > high, 0.5 * (low + high), low),
        np.where(low > high, 0.5 * (low + high), high),
    )
    costs = radii**3 * (high - low + 4.0 / 3.0 * radii)
    i = int(costs.argmin())
    return float(costs[i]), np.concatenate((start + low[i] * along, start + high[i] * along))


def _outline(points: Points) -> Points:
    """The points (N, 3) that are outermost in one of DIRECTIONS."""
    along = DIRECTIONS @ points.T.astype(np.float32)
    outermost: Points = points[np.unique((along.argmin(axis=1), along.argmax(axis=1)))]
    return outermost


def _radius(points: Points, ends: Points) -> float:
    """The greatest distance of points (N, 3) from the segment between two ends (6,)."""
    start = ends[:3]
    axis = ends[3:] - ends[:3]
    share = np.clip((points - start) @ axis / (axis @ axis + MIN_AXIS2_M2), 0.0, 1.0)
    return float(np.linalg.norm(points - start - share[:, None] * axis, axis=1).max())
