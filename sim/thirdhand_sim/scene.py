"""The soldering scene: positions of things, durations of phases, and the three via-points that are
taught to the service.

Frame `base`: metres, z up, the arm's base plate at the origin, the table top at z = 0. The user
sits at +x and faces -x, so left is -y.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import math
import sys
from pathlib import Path
from typing import Annotated

import msgspec

from thirdhand.contract import requests
from thirdhand.contract.explain import exit_code_of, in_words, validated
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Reach
from thirdhand.settings.file_content import SettingsError, UnusableError, text_in, toml_in

Point = tuple[float, float, float]
Duration = Annotated[float, msgspec.Meta(gt=0, le=60)]

# [m] position of the tool with the glass, relative to the soldering place
TOOL_FROM_OBJECT: Point = (-0.13, 0.0, 0.20)
# Position of the tool that offers the board, relative to the hand that takes it: the arm is 4 cm
# away, and the board's edge is in the hand.
TOOL_FROM_HAND: Point = (-0.08, 0.0, 0.08)  # [m]
# [m] position of the hand with the iron, relative to the soldering place
RIGHT_FROM_OBJECT: Point = (0.03, 0.06, 0.05)
GRASP_DISTANCE = 0.03  # [m] within this distance a thing is taken over, or is at its target
ARRIVED_M = 0.04  # a hand within this distance of a place has arrived there
# The tool's +z points 45° forward and down, and its y axis is level: a turn of 135° about y.
TOOL_ORIENTATION = (0.0, math.sin(math.radians(67.5)), 0.0, math.cos(math.radians(67.5)))
# Both hands point at the robot, palms down: half a turn about z.
HAND_ORIENTATION = (0.0, 0.0, 1.0, 0.0)

FAR_OFF = 5.0  # [m] a place farther off is probably in other units
IN_REACH = 0.01  # [m] places are moved this far into the arm's reach
# [m] with a larger distance from the nominal places, the arm cannot reach every scene
MOST_MOVED = 0.15
MIN_HEIGHT_M = {  # least height of places above the table
    "robot_start": 0.05,
    "handover": 0.05,
    "glass": 0.05,
    "soldering": 0.05,
    "iron": 0.05,
    "solder": 0.01,  # the tool never moves there
    "left_start": 0.05,
    "right_start": 0.05,
}


class SceneError(ValueError):
    """A scene cannot be played; the message has the place, its value, and accepted values."""


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One soldering scene: places [m, frame `base`] and durations [s]."""

    robot_start: Point = (0.45, -0.05, 0.35)
    handover: Point = (0.62, -0.28, 0.30)  # the left hand at the handover
    glass: Point = (0.50, 0.38, 0.16)  # the handle of the magnifying glass
    soldering: Point = (0.75, 0.0, 0.06)  # the board during soldering
    iron: Point = (0.90, 0.42, 0.10)
    solder: Point = (0.88, 0.22, 0.015)
    left_start: Point = (0.98, -0.32, 0.06)
    right_start: Point = (0.98, 0.32, 0.06)
    # handover; fetch the glass; work over the board
    phases_s: tuple[Duration, Duration, Duration] = (3.0, 3.5, 3.0)
    # the hands rest after each phase
    dwells_s: tuple[Duration, Duration, Duration] = (0.4, 0.4, 0.3)
    seed: Annotated[int, msgspec.Meta(ge=0)] = 1

    def __post_init__(self) -> None:
        for name, lowest in MIN_HEIGHT_M.items():
            place: Point = getattr(self, name)
            nominal = _nominal(name)
            moved = math.dist(place, nominal)
            if not moved <= MOST_MOVED + 1e-9:
                raise ValueError(
                    f"{name}: {list(place)} lies {moved:.3g} m from the nominal {list(nominal)} m; "
                    f"up to {MOST_MOVED:g} m is "
                    f"reachable{'. Is it in metres?' if moved > FAR_OFF else ''}"
                )
            if place[2] < lowest:
                raise ValueError(
                    f"{name}: {list(place)} lies {100 * place[2]:.1f} cm above the table; "
                    f"at least {100 * lowest:.0f} cm is needed"
                )

    @property
    def right_final(self) -> Point:
        """Final position of the right hand with the iron [m]."""
        return _add(self.soldering, RIGHT_FROM_OBJECT)

    @property
    def offer(self) -> Point:
        """Position of the tool that offers the board to the left hand [m]."""
        return _add(self.handover, TOOL_FROM_HAND)

    @property
    def carry(self) -> Point:
        """Position of the tool that holds the glass over the board [m]."""
        return _add(self.soldering, TOOL_FROM_OBJECT)

    @property
    def segments(self) -> tuple[tuple[float, float], ...]:
        """Begin and end of each of the three motions, in script time [s]."""
        begin = 0.0
        out = []
        for phase, dwell in zip(self.phases_s, self.dwells_s, strict=True):
            out.append((begin, begin + phase))
            begin += phase + dwell
        return tuple(out)

    @property
    def dwells(self) -> tuple[tuple[float, float], ...]:
        """Begin and end of the rest after each motion, in script time [s]."""
        return tuple(
            (end, end + dwell) for (_, end), dwell in zip(self.segments, self.dwells_s, strict=True)
        )

    @property
    def duration_s(self) -> float:
        """Script time from the first motion to the end of the last rest [s]."""
        return self.dwells[-1][1]

    def via_points(self, *, gripper: bool = False) -> tuple[requests.ViaPoint, ...]:
        """The three via-points handover, glass and soldering, each with a neighbourhood of 3 cm,
        and if `gripper` with the state of the gripper.
        """
        s = self
        places = (
            _via_point(
                "handover", left=s.handover, right=s.right_start, tool=s.offer, follow="left"
            ),
            _via_point("glass", left=s.soldering, right=s.iron, tool=s.glass),
            _via_point("soldering", left=s.soldering, right=s.right_final, tool=s.carry),
        )
        if not gripper:
            return places
        handover, glass, soldering = places
        return (
            msgspec.structs.replace(handover, gripper="open"),
            msgspec.structs.replace(glass, gripper="closed"),
            msgspec.structs.replace(soldering, gripper="closed"),
        )

    def in_reach(self, reach: Reach) -> tuple[Scene, tuple[str, ...]]:
        """The scene with all places moved horizontally into an arm's reach, and messages on the
        moved places. Raises SceneError if a place must be moved too far.
        """
        places = msgspec.structs.asdict(self)
        centre = reach.centre
        moves = list[str]()
        lost = list[str]()
        for name, tool in (
            ("handover", self.offer),
            ("glass", self.glass),
            ("soldering", self.carry),
        ):
            up = tool[2] - centre[2]
            out = math.dist(tool[:2], centre[:2])
            low, high = (
                max(r * r - up * up, 0.0) ** 0.5
                for r in (reach.inner + IN_REACH, reach.outer - IN_REACH)
            )
            radius_m = min(max(out, low), high)
            share = (radius_m - out) / out if out else 0.0
            by = abs(radius_m - out)
            shift = (share * (tool[0] - centre[0]), share * (tool[1] - centre[1]), 0.0)
            place = _add(getattr(self, name), shift)
            moved_tool = _add(tool, shift)
            is_in = reach.inner <= math.dist(moved_tool, centre) <= reach.outer
            if math.dist(place, _nominal(name)) > MOST_MOVED or not is_in:
                lost.append(
                    f"{name} needs the tool {math.dist(tool, centre):.2f} m from the shoulder"
                )
            elif moved_tool[0] < reach.min_x or moved_tool[2] < reach.min_z:
                lost.append(
                    f"{name} needs the tool at x = {moved_tool[0]:.2f}, z = {moved_tool[2]:.2f} m"
                )
            elif by:
                places[name] = place
                moves.append(f"{name} moved by {100 * by:.0f} cm into the arm's reach")
        if lost:
            reaches = (
                f"from {reach.inner:.2f} to {reach.outer:.2f} m around its shoulder at "
                f"{list(centre)}"
            )
            raise SceneError(
                "the arm does not reach this scene, not even with each place moved by "
                f"{MOST_MOVED:g} m: {'; '.join(lost)}. Its tool reaches {reaches}, where x is at "
                f"least {reach.min_x:g} and z at least {reach.min_z:g} m. What to do: use a larger "
                "arm, place this one nearer (`thirdhand arm URDF --at X Y Z`), or teach it a task "
                "of its own size (docs/tutorial.md). A scene file (--scene FILE) moves places by "
                f"at most {MOST_MOVED:g} m"
            )
        return Scene(**places), tuple(moves)

    @staticmethod
    def load(path: Path) -> Scene:
        """The scene in a TOML file; places that are not given are nominal. Raises SceneError."""
        try:
            return validated(toml_in(text_in(path)), Scene)
        except (OSError, UnusableError) as error:
            raise SceneError(f"cannot read scene {path}: {in_words(error, named=False)}") from None
        except ValueError as error:
            raise SceneError(f"{path}: {error}") from None


def main(arguments: list[str] | None = None) -> int:
    """Print the request that teaches a scene's via-points; exit code 0, 1 on failure, 2 on bad
    usage.
    """
    # its import is slow, and most users of this module do not need it
    from thirdhand.cli.usage import option

    p = argparse.ArgumentParser(
        prog="python -m thirdhand_sim.scene",
        description="Prints the via-points of a scene as a `via_points` request.",
        epilog=(
            "example:\n  python -m thirdhand_sim.scene my-scene.toml | thirdhand via-points add "
            "--file -"
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    option(
        p,
        "scene",
        "FILE",
        "a TOML file with places [x, y, z] in metres (default: the nominal scene)",
        nargs="?",
    )
    about = f"{', '.join(ARMS)} or a cell's settings, FILE.toml; places are moved into its reach"
    option(p, "--arm", "ARM", about, "wam")
    p.add_argument("--gripper", action="store_true", help="include the state of the gripper")
    args = p.parse_args(arguments)
    try:
        scene = Scene.load(args.scene) if args.scene else Scene()
        scene, moved = scene.in_reach(cell_of(args.arm).reach)
    except (SceneError, SettingsError) as error:
        print(error, file=sys.stderr)
        return exit_code_of(error)
    for line in moved:
        print(line, file=sys.stderr)
    print(requests.encode_json(requests.Add(scene.via_points(gripper=args.gripper))).decode())
    return 0


def _nominal(name: str) -> Point:
    """A place of the nominal scene."""
    place: Point = Scene.__struct_defaults__[Scene.__struct_fields__.index(name)]
    return place


def _add(a: Point, b: Point) -> Point:
    # Rounding to 1 µm gives short decimal numbers.
    return (round(a[0] + b[0], 6), round(a[1] + b[1], 6), round(a[2] + b[2], 6))


def _via_point(
    name: str, *, left: Point, right: Point, tool: Point, follow: str = "none"
) -> requests.ViaPoint:
    return requests.ViaPoint(
        name=name,
        left=left,
        right=right,
        tool=tool,
        std=0.001,
        radius=0.03,
        follow=follow,  # type: ignore[arg-type]
    )


if __name__ == "__main__":
    sys.exit(main())
