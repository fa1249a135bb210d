"""The arm's description in recordings, with spheres for the hands, the target and the setpoint.

Rerun, Foxglove and RViz draw a description with the frames in `/tf`. These include hands and
target, so viewers show them without a plug-in or a setting.
"""

from __future__ import annotations

from thirdhand.settings import palette
from thirdhand.settings.urdf import Urdf

# frame, colour, radius [m]
MARKERS = (
    ("left_hand", palette.LEFT, 0.03),
    ("right_hand", palette.RIGHT, 0.03),
    ("target", palette.TARGET, 0.015),
    ("setpoint", palette.TOOL, 0.01),
)


def with_markers(urdf: str) -> str:
    """The URDF with a floating link for each marker.

    It is unchanged if it has no `</robot>`, or already has links of these names.
    """
    head, end, tail = urdf.rpartition("</robot>")
    if not end or any(f'name="{frame}"' in urdf for frame, _, _ in MARKERS):
        return urdf
    links = []
    root = Urdf(urdf).root
    for frame, colour, radius in MARKERS:
        red, green, blue = (value / 255 for value in colour)
        links.append(
            f'  <link name="{frame}"><visual><geometry><sphere radius="{radius}"/></geometry>'
            f'<material name="{frame}"><color rgba="{red:.3f} {green:.3f} {blue:.3f} '
            '1"/></material></visual></link>\n'
            f'  <joint name="{frame}_at" type="floating"><parent link="{root}"/><child '
            f'link="{frame}"/></joint>\n'
        )
    return f"{head}{''.join(links)}{end}{tail}"
