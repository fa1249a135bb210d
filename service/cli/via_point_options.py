"""The options of `thirdhand via-points add`."""

from __future__ import annotations

import argparse

from service.contract.requests import TOLERANCE_M, ViaPoint


def add_options(c: argparse.ArgumentParser) -> None:
    """Adds the options that define the via-point."""
    for hand in ("left", "right", "tool"):
        c.add_argument(f"--{hand}", nargs=3, type=float, metavar=("X", "Y", "Z"), help="position [m] in frame base")
    c.add_argument("--here", action="store_true", help="hands and tool as they are, once they hold still")
    defaults = ViaPoint("defaults", (0, 0, 0), (0, 0, 0), (0, 0, 0))
    c.add_argument(
        "--std",
        type=float,
        default=defaults.std,
        metavar="M",
        help="how exactly the tool is to go there (default: %(default)s m)",
    )
    c.add_argument(
        "--radius",
        type=float,
        default=defaults.radius,
        metavar="M",
        help="also for hands this far from there (default: %(default)s m)",
    )
    c.add_argument(
        "--follow",
        choices=("none", "left", "right"),
        default="none",
        help="within the radius the tool moves with this hand",
    )
    c.add_argument(
        "--orientation", nargs=4, type=float, metavar=("X", "Y", "Z", "W"), help="how the tool is turned there"
    )
    c.add_argument("--gripper", choices=("open", "closed"), help="what the gripper does there")
    c.add_argument(
        "--tolerance",
        type=float,
        metavar="M",
        help=f"points learned nearer than this give way (default: {TOLERANCE_M} m)",
    )
    c.add_argument("--file", metavar="FILE", help="a request as JSON instead; - is standard input")
