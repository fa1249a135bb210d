"""The static part of the scene: the arm and its ghost, table, reach, names and colours.

Units, sizes and transparencies of the drawing are chosen here, in `dynamic` and in `blueprint`.
"""

from __future__ import annotations

import itertools
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.contract.explain import in_words
from thirdhand.contract.incidents import title, word
from thirdhand.contract.records import SIDES, Mode, Reason
from thirdhand.core.frame import STAGES
from thirdhand.core.separation.body import body_of
from thirdhand.settings import palette
from thirdhand.settings.config import Reach, Settings, robot_description, urdf_path
from thirdhand.settings.file_content import UnusableError, begin_of
from thirdhand.settings.mesh_cover import found_meshes, unfound
from thirdhand.settings.robot_xml import element_of
from thirdhand.settings.urdf import Urdf
from thirdhand.viewer.banner import HEIGHT, WIDTH
from thirdhand.viewer.blueprint import EYE, LOOK_AT, UP

GHOST = "measured/"  # prefix of its frames' names
ARC_STEPS = 48
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# right of, above and in front of the point that the camera looks at
BANNER_AT = (0.55, 0.66, -0.44)
BANNER_WIDTH = 0.74  # times the camera's distance, as BANNER_AT is
_SHAPES = (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D)
NAMING_OTHERS = (".dae", ".gltf", ".obj")  # meshes that may name other files
VISUAL = "/visual_geometries/"
_DRAWN = ("Asset3D:", "Mesh3D:", *(f"{shape.__name__}:" for shape in _SHAPES))


class ArmModels:
    """The arm as commanded and as measured: one URDF, loaded twice under different names.

    `body` holds the capsules, which are drawn around meshes, and instead of meshes that are missing
    or cannot be drawn (`undrawn`). `remark` names those; it is empty if all are drawn. All meshes
    take at most `mesh_mb` [MB].
    """

    def __init__(self, urdf: Path, settings: Settings) -> None:
        # otherwise the URDF is a recording's, whose meshes are already covered
        live = urdf == urdf_path(settings)
        text = robot_description(settings) if live else urdf.read_text(encoding="utf-8")
        self.body = body_of(settings, text)
        self.covered = any(shape.kind == "mesh" for shape in Urdf(text).shapes)
        with tempfile.TemporaryDirectory() as folder:
            self.remark = _write_drawn(
                urdf.read_bytes(), settings, drawn_urdf := Path(folder) / "arm.urdf"
            )
            self.commanded = rr.urdf.UrdfTree.from_file_path(drawn_urdf, entity_path_prefix="arm")
            self.measured = rr.urdf.UrdfTree.from_file_path(
                drawn_urdf,
                entity_path_prefix="measured",
                frame_prefix=GHOST,
                static_transform_entity_path="/measured/tf_static",
            )
        drawn: dict[str, bool] = {}
        size = 0
        for chunk in self.commanded.stream(include_joint_transforms=False):
            _, visual, path = chunk.entity_path.partition(VISUAL)
            if visual:
                rows = chunk.to_record_batch()
                size = size + rows.nbytes
                names = rows.schema.names
                drawn[path] = drawn.get(path, False) or any(
                    name.startswith(_DRAWN) for name in names
                )
        self.mesh_mb = 2 * size // 1_000_000
        self.undrawn = tuple(path for path, is_drawn in drawn.items() if not is_drawn)
        if self.undrawn and not self.remark:
            links = ", ".join(dict.fromkeys(path.partition("/")[0] for path in self.undrawn))
            self.remark = (
                f"the viewer cannot draw the meshes of links {links}; the arm is drawn by its "
                "capsules"
            )


def _write_drawn(urdf: bytes, settings: Settings, path: Path) -> str:
    """Write the URDF that Rerun reads: in UTF-8, with full paths of meshes, and without masses,
    prefixes and collision shapes, which are not drawn. Visual shapes whose mesh is not found or not
    readable are left out; return a remark about them, or an empty text.
    """
    robot = element_of(urdf)
    origin = urdf_path(settings)
    for link in robot.findall("link"):
        for part in (*link.findall("inertial"), *link.findall("collision")):
            link.remove(part)

    packages = _packages(settings)
    lost = unfound(robot, origin, packages, "visual")
    cause = f"{lost}; ROS_PACKAGE_PATH names more" if lost else ""
    files: dict[ElementTree.Element, Path] = {}
    for mesh, file in found_meshes(robot, origin, packages):
        try:
            for needed_file in (file, *_named_in(file)):
                begin_of(needed_file)
            files[mesh] = file
        except (OSError, UnusableError) as error:
            cause = cause or f"a visual mesh is not readable: {in_words(error)}"
    for link in robot.findall("link"):
        _set_mesh_files(link, files)
    ElementTree.ElementTree(robot).write(path, encoding="utf-8")
    return f"the arm is drawn by its capsules: {cause}" if cause else ""


def _named_in(mesh: Path) -> list[Path]:
    """The files beside a mesh that it names: materials, textures and buffers."""
    if mesh.suffix.lower() not in NAMING_OTHERS:
        return []
    text = mesh.read_bytes()
    return [file for file in mesh.parent.iterdir() if file.is_file() and file.name.encode() in text]


def _packages(settings: Settings) -> tuple[str, ...]:
    """The folders of ROS packages, from the settings and the environment."""
    environment = os.environ
    ros_folders = environment.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
    prefixes = environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return (
        *settings.arm.packages,
        *filter(None, ros_folders),
        *(f"{prefix}/share" for prefix in filter(None, prefixes)),
    )


def _set_mesh_files(link: ElementTree.Element, files: Mapping[ElementTree.Element, Path]) -> None:
    """Write full paths into a link's visual shapes; those with a mesh that is not in `files` are
    removed.
    """
    for visual in link.findall("visual"):
        meshes = list(visual.iter("mesh"))
        if any(mesh not in files for mesh in meshes):
            link.remove(visual)
            continue
        for mesh in meshes:
            mesh.set("filename", f"file://{files[mesh].absolute()}")


def log_static(stream: rr.RecordingStream, models: ArmModels, settings: Settings) -> None:
    """Log everything that never changes."""

    def fix(path: str, *archetypes: Any) -> None:
        stream.log(path, *archetypes, static=True)

    for tree, path, ghost in (
        (models.commanded, "/arm", False),
        (models.measured, "/measured", True),
    ):
        _log_arm(stream, tree, path, models.undrawn, ghost=ghost)
        if models.remark or (models.covered and not ghost):
            _log_capsules(fix, tree, path, models, settings, ghost=ghost)
    fix("/scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    fix(
        "/scene/base",
        rr.Transform3D(parent_frame="tf#/", child_frame=models.commanded.root_link().name),
    )
    fix(
        "/scene/ghost_base",
        rr.Transform3D(parent_frame="tf#/", child_frame=GHOST + models.measured.root_link().name),
    )
    _log_surroundings(fix, settings)
    fix("/scene/tool", rr.TransformAxes3D(0.07))
    for name, colour, radius in (
        ("left_hand", palette.LEFT, 0.022),
        ("right_hand", palette.RIGHT, 0.022),
        ("setpoint", palette.TOOL, 0.008),
    ):
        labels = [name.replace("_", " ")]
        marker = rr.Points3D.from_fields(
            colors=[colour], radii=[radius], labels=labels, show_labels=radius > 0.01
        )
        fix(f"/scene/{name}", marker)
    wireframe = rr.components.FillMode.TransparentFillMajorWireframe
    region = rr.Ellipsoids3D.from_fields(
        colors=[palette.TARGET],
        line_radii=[0.0006],
        fill_mode=wireframe,
        labels=["target, 95 %"],
        show_labels=False,
    )
    fix("/scene/target", region)
    for name, colour in palette.BY_TRACK.items():
        fix(f"/scene/{name}_trail", rr.LineStrips3D.from_fields(colors=[colour], radii=[0.002]))
    fix(
        "/scene/nearest",
        rr.LineStrips3D.from_fields(colors=[palette.NEAREST], radii=[0.0015], show_labels=True),
    )
    _log_names(fix, settings)


def _log_arm(
    stream: rr.RecordingStream,
    tree: rr.urdf.UrdfTree,
    path: str,
    undrawn: tuple[str, ...],
    *,
    ghost: bool,
) -> None:
    """Log the shapes of the arm: solid, or transparent as a ghost."""
    for chunk in tree.stream(include_joint_transforms=False):
        is_collision = "/collision_geometries/" in chunk.entity_path
        if not is_collision and chunk.entity_path.partition(VISUAL)[2] not in undrawn:
            stream.send_chunks(chunk)
            _log_style(stream, chunk, ghost=ghost)
    for joint in tree.joints():
        if joint.joint_type == "fixed":
            stream.log(
                f"{path}/joints/{joint.child_link}", joint.compute_transform(0.0), static=True
            )


def _log_style(stream: rr.RecordingStream, chunk: rr.chunk.Chunk, *, ghost: bool) -> None:
    """Log fill and colour of the shapes in a chunk of the arm."""
    fills = rr.components.FillMode
    fill = fills.TransparentFillMajorWireframe if ghost else fills.Solid
    colour = palette.faint(palette.MEASURED, 0.35)
    kinds = {name.partition(":")[0] for name in chunk.to_record_batch().schema.names}
    for shape in _SHAPES:
        if shape.__name__ in kinds:
            lines = "radii" if shape is rr.Boxes3D else "line_radii"
            style: dict[str, Any] = {"colors": [colour], lines: [0.0005]} if ghost else {}
            stream.log(chunk.entity_path, shape.from_fields(fill_mode=fill, **style), static=True)
    if ghost and "Asset3D" in kinds:
        stream.log(chunk.entity_path, rr.Asset3D.from_fields(albedo_factor=colour), static=True)


def _log_capsules(
    fix: Any,
    tree: rr.urdf.UrdfTree,
    path: str,
    models: ArmModels,
    settings: Settings,
    *,
    ghost: bool,
) -> None:
    """Log the capsules of the arm, each in the frame of its link."""
    moved = [
        joint.child_link
        for name in settings.joints.names
        if (joint := tree.get_joint_by_name(name)) is not None
    ]
    root = tree.root_link().name
    body = models.body
    faint = ghost or not models.remark
    for link in np.unique(body.capsules["link"]):
        capsules = body.capsules[body.capsules["link"] == link]
        along = capsules["ends"][:, 1] - capsules["ends"][:, 0]
        turns = [
            Rotation.align_vectors([axis], [UP])[0].as_quat() if axis.any() else UPRIGHT
            for axis in along
        ]
        fill = (
            rr.components.FillMode.TransparentFillMajorWireframe
            if faint
            else rr.components.FillMode.Solid
        )
        shapes = rr.Capsules3D(
            lengths=np.linalg.norm(along, axis=1),
            radii=capsules["radius"],
            translations=capsules["ends"][:, 0],
            quaternions=np.array(turns),
            colors=[palette.faint(palette.MEASURED, 0.35) if faint else palette.ARM_BODY],
            line_radii=[0.0005],
            fill_mode=fill,
        )
        frame = moved[link - 1] if link else root
        fix(
            f"{path}/capsules/{link}",
            rr.CoordinateFrame(f"{GHOST if ghost else ''}{frame}"),
            shapes,
        )


def _log_surroundings(fix: Any, settings: Settings) -> None:
    """Log the table, the obstacles and the arm's reach."""
    x, y, top = settings.table.centre
    half_x, half_y = settings.table.half_size
    solid = rr.components.FillMode.Solid
    half = [(half_x, half_y, 0.0095)]
    fix(
        "/scene/table",
        rr.Boxes3D(
            centers=[(x, y, top - 0.01)], half_sizes=half, colors=[palette.TABLE], fill_mode=solid
        ),
    )
    edge = [
        (x + a * half_x, y + b * half_y, top)
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
    ]
    fix("/scene/table/edge", rr.LineStrips3D([edge], colors=[palette.GREY], radii=[0.0015]))
    if boxes := settings.obstacles.boxes:
        fix(
            "/scene/obstacles",
            rr.Boxes3D(
                centers=[box.centre for box in boxes],
                half_sizes=[box.half_size for box in boxes],
                colors=[palette.TABLE],
                fill_mode=solid,
            ),
        )
    # width in pixels, constant near the camera
    faint = palette.faint(palette.GREY, 0.08)
    thin = rr.Radius.ui_points(0.5)
    fix(
        "/scene/reach",
        rr.LineStrips3D(list(reach_lines(settings.reach)), colors=[faint], radii=thin),
    )


def reach_lines(reach: Reach) -> Iterator[NDArray[np.float64]]:
    """Lines (P, 3) [m] on the outer shell of the reach: two parallels and three meridians."""
    centre = np.array(reach.centre)
    lowest = max(np.arcsin(np.clip((reach.min_z - centre[2]) / reach.outer, -1.0, 1.0)), -np.pi / 2)
    around = np.linspace(-np.pi / 2, np.pi / 2, ARC_STEPS)
    up = np.linspace(lowest, np.pi / 2, ARC_STEPS)
    arcs = [(around, np.full(ARC_STEPS, height)) for height in (lowest, 0.0)]
    arcs += [(np.full(ARC_STEPS, bearing), up) for bearing in (-np.pi / 3, 0.0, np.pi / 3)]
    for bearing, height in arcs:
        direction = np.stack(
            [np.cos(bearing) * np.cos(height), np.sin(bearing) * np.cos(height), np.sin(height)],
            axis=1,
        )
        points = centre + reach.outer * direction
        points = points[points[:, 0] >= reach.min_x]
        if len(points) > 1:
            yield points


class _Curves(NamedTuple):
    """Curves of one path: their names with units, and their colours, which repeat."""

    path: str
    names: Sequence[str]
    colours: Sequence[palette.Colour]


def _curves(settings: Settings) -> Iterator[_Curves]:
    """All curves, by path."""
    joints = [
        name.rpartition("/")[2].removesuffix("_joint").replace("_", " ")
        for name in settings.joints.names
    ]
    units = settings.joints.units
    for quantity, per in (("position", ""), ("velocity", "/s"), ("acceleration", "/s²")):
        names = [f"{joint} [{unit}{per}]" for joint, unit in zip(joints, units, strict=True)]
        yield _Curves(f"/joints/{quantity}", names, palette.BY_JOINT)
    yield _Curves("/timing/stages", [f"{stage} [µs]" for stage in STAGES], palette.BY_JOINT)
    yield _Curves("/age", [f"{side} hand [ms]" for side in SIDES], (palette.LEFT, palette.RIGHT))

    unit = "rad" if set(units) == {"rad"} else "rad or m"
    for path, name, colour in (
        ("/error/target", "tool to target [mm]", palette.TOOL),
        ("/turn/target", "tool to target [°]", palette.TOOL),
        ("/turn/std", "target, 1 σ [°]", palette.TARGET),
        ("/gripper/predicted", "predicted [%]", palette.TARGET),
        ("/gripper/commanded", "commanded [%]", palette.TOOL),
        ("/segment/number", "number [1]", palette.TOOL),
        ("/segment/probable", "probability [1]", palette.TARGET),
        ("/deviation/target", "target, 1 σ [mm]", palette.TARGET),
        ("/deviation/hands", "hands [mm]", palette.OFF),
        ("/deviation/gate", "holds above [mm]", palette.GATE),
        ("/doubt/target", "target [%]", palette.TARGET),
        ("/speed/tool", "tool [m/s]", palette.TOOL),
        ("/speed/left", "left hand [m/s]", palette.LEFT),
        ("/speed/right", "right hand [m/s]", palette.RIGHT),
        ("/separation/distance", "distance [m]", palette.NEAREST),
        ("/separation/limit", "allowed [m/s]", palette.SKY),
        ("/joints/error", f"largest [{unit}]", palette.MEASURED),
        ("/latency/hand", "hand's stamp to command [ms]", palette.LATENCY),
        ("/timing/lateness", "late by [µs]", palette.LATENESS),
        ("/timing/work", "work [µs]", palette.WORK),
    ):
        yield _Curves(path, [name], [colour])


def _log_names(fix: Any, settings: Settings) -> None:
    """Log names, units and colours of the curves, and labels and colours of the modes."""
    for path, names, colours in _curves(settings):
        # how values that share one pixel column are drawn: of times and ages, the largest
        is_largest = path.startswith(("/timing", "/latency", "/age"))
        fix(
            path,
            rr.SeriesLines(
                names=names,
                colors=list(itertools.islice(itertools.cycle(colours), len(names))),
                widths=[1.5] * len(names),
                aggregation_policy=rr.components.AggregationPolicy.Max if is_largest else None,
            ),
        )
    for path, members, packed_colours in (
        ("/mode", Mode, [palette.packed(palette.BY_MODE[mode]) for mode in Mode]),
        ("/reason", Reason, [palette.packed(palette.GREY)] * len(Reason)),
    ):
        words = [word(member) for member in members]
        fix(
            path,
            rr.StateConfiguration(
                values=words,
                labels=[title(name) for name in words],
                colors=np.array(packed_colours, np.uint32),
            ),
        )
    fix("/scene/banner", _board())


def _board() -> rr.Mesh3D:
    """The board behind the arm that shows mode and reason: it faces the camera."""
    far = np.linalg.norm(np.subtract(EYE, LOOK_AT))
    toward = np.subtract(EYE, LOOK_AT) / far
    right = np.cross(UP, toward) / np.linalg.norm(np.cross(UP, toward))
    up = np.cross(toward, right)
    centre = LOOK_AT + np.stack([right, up, toward], axis=1) @ (far * np.array(BANNER_AT))
    right = 0.5 * far * BANNER_WIDTH * right
    up = 0.5 * far * BANNER_WIDTH * HEIGHT / WIDTH * up
    corners = [centre - right - up, centre + right - up, centre + right + up, centre - right + up]
    return rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[(0, 1, 2), (0, 2, 3)],
        vertex_texcoords=[(0, 1), (1, 1), (1, 0), (0, 0)],
        vertex_normals=[(0, 0, 0)] * 4,
    )
