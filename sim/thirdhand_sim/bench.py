"""The bench: arm, hands and things that move by a script, and the success of the task.

It has no network and no clock: `step` is one period.

bench = Bench(HandScript(Scene(), seed=1))
bench.begin()
while not bench.finished:
    seen = bench.step(q, dq)
"""

from __future__ import annotations

import itertools
import math
from types import TracebackType
from typing import NamedTuple, Protocol, Self

import msgspec
import numpy as np
import numpy.typing as npt

from thirdhand.arms.playback import REJOIN_AFTER_S
from thirdhand.client import BRAKE_AFTER_S
from thirdhand.contract.messages import BASE, SceneObject
from thirdhand.settings.config import Settings
from thirdhand_sim.engines import world_of
from thirdhand_sim.scene import ARRIVED_M, GRASP_DISTANCE, HAND_ORIENTATION, TOOL_FROM_HAND, Scene
from thirdhand_sim.script import GRIP_S, Array, HandMotions, TaskProgress
from thirdhand_sim.world import (
    BOARD_IN_TOOL,
    LEVEL,
    POSITION_GAIN,
    Floats,
    Pose,
    World,
    carried_by,
    seen_from,
)

# shortest and longest time for the arm to settle before the script begins
SETTLE_RANGE_S = (0.5, 2.5)
SETTLED_STILL_S = 0.25  # the arm has settled after resting for this time
# after a silence, a command must be this near to position and velocity of the standing arm
STAND_RAD = 0.02
STAND_RADPS = 0.05
HOLDS = 0.5  # fingers that are closed this far hold a thing between them
TAIL_S = 0.5  # the task is observed until this time after the script's end
# the joint that is farthest behind exceeds its commanded speed by at most this
CATCH_UP_RADPS = 0.25
# [m] a resting tool moves by up to this, because the hand that leads it trembles
STILL_WITHIN = 0.005


class TaskEvent(msgspec.Struct, frozen=True):
    """The result of one event: True if the tool reached it, the smallest distance [mm], and the
    time of the script [s] at which the tool first reached it or was nearest. The distance is
    infinite (null in JSON) if the hands were never at the event's places.
    """

    reached: bool
    error_mm: float
    time_s: float


class TaskEvents(msgspec.Struct, frozen=True):
    """The three events of a run."""

    handover: TaskEvent
    grasp: TaskEvent
    carry: TaskEvent

    @property
    def success(self) -> bool:
        """True if the board was taken, the glass was grasped, and it was held over the board."""
        return self.handover.reached and self.grasp.reached and self.carry.reached


class Observation(NamedTuple):
    """The bench after a step: number of steps, time since the script began [s] (0 before), joints
    [rad, rad/s], tool [m, m/s], hands, gripper.
    """

    tick: int
    time_s: float
    joints: Floats
    joint_velocities: Floats
    tool: Pose
    tool_velocity: Floats
    hands: HandMotions
    gripper: float  # closure, 0 open to 1 closed


class _Watch:
    """The smallest distance of the tool within the window of one event."""

    def __init__(self) -> None:
        self.nearest = math.inf
        self.nearest_s = 0.0
        self.reached_s = math.nan

    def see(self, distance: float, time_s: float, *, counts: bool = True) -> bool:
        """Note a distance [m]; True at the first one within GRASP_DISTANCE that `counts`."""
        if distance < self.nearest:
            self.nearest = distance
            self.nearest_s = time_s
        first = counts and distance <= GRASP_DISTANCE and math.isnan(self.reached_s)
        if first:
            self.reached_s = time_s
        return first

    def event(self) -> TaskEvent:
        reached = not math.isnan(self.reached_s)
        return TaskEvent(
            reached,
            round(1000 * self.nearest, 3),
            round(self.reached_s if reached else self.nearest_s, 3),
        )


class BenchHands(Protocol):
    """The hands at the bench: a `HandScript`, or the `TrackedHands` of a person."""

    scene: Scene
    seed: int

    @property
    def ready(self) -> bool: ...

    @property
    def duration_s(self) -> float: ...

    def begin(self) -> None: ...

    def truth(self, t: float) -> HandMotions: ...

    def sample(self, t: float) -> tuple[Array, Array]: ...

    def progress(self, t: float, reached: int) -> TaskProgress: ...

    def places(self) -> tuple[SceneObject, ...]: ...


class Bench:
    """The bench, which waits for `begin` with the arm at its posture, the board in the tool, and
    the hands at the script's start.
    """

    def __init__(
        self,
        script: BenchHands,
        *,
        settings: Settings | None = None,
        posture: Floats | None = None,
        world: type[World] | None = None,
    ) -> None:
        """`settings` has the arm and the rate (default: the shipped cell). The arm begins at its
        posture unless another is given. `world` is the physics (default: the first installed).
        """
        self.script = script
        self.scene = script.scene
        settings = settings or Settings()
        self.period_s = settings.period_s
        self.joint_names = settings.joints.names
        self._plate = settings.arm.plate
        self.limits = settings.joints
        posture = posture or settings.arm.posture
        self.world = (world or world_of())(self.scene, settings, posture=posture)
        self.tick = 0
        self._ticks_since_begin = 0
        self._direction = 0  # direction of script time: 0 waiting, 1 forward, -1 backward
        self._since_command = 0
        self.refused = 0  # commands that after a silence did not begin at the standing arm
        self._still = 0
        # newest command; None without commands: near things are then grasped
        self._gripper: float | None = None
        self._lay_out()
        self._observation = self._observe()
        self._still_at = self._observation.tool.position
        self._command = (self._observation.joints, (0.0,) * len(self._observation.joints))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _lay_out(self) -> None:
        """Put everything at its place at the begin of a run."""
        scene = self.scene
        world = self.world
        self._watches = (_Watch(), _Watch(), _Watch())
        self.closed = 0  # number of events whose window is over
        world.put(world.glass, Pose(scene.glass, LEVEL))
        world.put(world.iron, Pose(scene.iron, LEVEL))
        # closure of the fingers; 1 if they closed in this step, -1 if they opened
        self._closure = 1.0
        self._closing = 0
        # The held things, each with its holder and its pose in the holder's frame.
        self._held: dict[str, tuple[str, Pose]] = {world.board: (world.arm, BOARD_IN_TOOL)}

    def begin(self) -> None:
        """Begin the script: hands move from the next step on."""
        self._lay_out()
        self.script.begin()
        self._ticks_since_begin = 0
        self._direction = 1

    def turn_back(self) -> None:
        """Move the hands back on their path, where the skill is certain, before another `begin`."""
        self._ticks_since_begin = min(
            self._ticks_since_begin, math.ceil(self.script.duration_s / self.period_s)
        )
        self._direction = -1

    @property
    def time_s(self) -> float:
        """Time of the script [s]; 0 before it begins."""
        return self._ticks_since_begin * self.period_s

    @property
    def finished(self) -> bool:
        """True once the script and the tail after it are over."""
        return self._direction == 1 and self.time_s >= self.script.duration_s + TAIL_S

    @property
    def waiting(self) -> bool:
        """True before the script begins."""
        return self._direction == 0

    @property
    def back(self) -> bool:
        """True once the hands are back at their start."""
        return self._direction == -1 and self._ticks_since_begin == 0

    @property
    def still_s(self) -> float:
        """Time for which the tool has remained within 5 mm [s]."""
        return self._still * self.period_s

    def settled(self, waited_s: float) -> bool:
        """True if the arm has settled, or has had the longest time to settle, after a time [s]."""
        return waited_s >= SETTLE_RANGE_S[1] or (
            waited_s >= SETTLE_RANGE_S[0] and self.still_s >= SETTLED_STILL_S
        )

    def observe(self) -> Observation:
        """The observation of the last step."""
        return self._observation

    def step(
        self,
        position: Floats | None = None,
        velocity: Floats | None = None,
        *,
        gripper: float | None = None,
    ) -> Observation:
        """Advance by one period with a command of the joints [rad, rad/s] and of the gripper (0
        open, 1 closed), or none. Before the first command of the gripper, it grasps near things.
        """
        self._follow(position, velocity)
        self._grip(gripper)
        self.world.step()
        self.tick += 1
        self._ticks_since_begin = max(0, self._ticks_since_begin + self._direction)
        observation = self._observe()
        self._still += 1
        if math.dist(observation.tool.position, self._still_at) > STILL_WITHIN:
            self._still = 0
            self._still_at = observation.tool.position
        self._handle(observation)
        if self._direction == 1:
            self._watch(observation)
        self._observation = observation
        return observation

    def _begins_here(self, position: Floats, velocity: Floats | None) -> bool:
        """True for a command at the standing arm, which begins a new sequence.

        After an interruption a network may deliver old commands at once, which would move the arm
        along a past path.
        """
        offset_rad = max(
            abs(aim - is_at) for aim, is_at in zip(position, self._observation.joints, strict=True)
        )
        return offset_rad <= STAND_RAD and max(map(abs, velocity or (0.0,))) <= STAND_RADPS

    def _follow(self, position: Floats | None, velocity: Floats | None) -> None:
        alone = self._since_command * self.period_s >= REJOIN_AFTER_S
        if position is not None and alone and not self._begins_here(position, velocity):
            position = None
            self.refused += 1
        if position is not None:
            self._command = (position, velocity or (0.0,) * len(position))
            self._since_command = 0
        else:
            # The clocks of bench and daemon differ, so periods without a command are ordinary. The
            # arm continues at the commanded velocity until BRAKE_AFTER_S.
            self._since_command += 1
            age_s = self._since_command * self.period_s
            if self._since_command == round(BRAKE_AFTER_S / self.period_s):
                self._command = (self._observation.joints, (0.0,) * len(self._observation.joints))
            position, velocity = self._command
            position = tuple(q + age_s * dq for q, dq in zip(position, velocity, strict=True))
        self.world.follow(self._caught_up(position), self._command[1])

    def _caught_up(self, position: Floats) -> Floats:
        """Target positions of the motors in this step.

        After a pause of a busy machine, the commands are far ahead. A real servo would not leap
        after them, so the difference is limited.
        """
        joints_rad = self._observation.joints
        behind = max(abs(aim - is_at) for aim, is_at in zip(position, joints_rad, strict=True))
        most = CATCH_UP_RADPS * self.period_s / POSITION_GAIN
        if behind <= most:
            return position
        return tuple(
            is_at + most / behind * (aim - is_at)
            for aim, is_at in zip(position, joints_rad, strict=True)
        )

    def _grip(self, command: float | None) -> None:
        """Move the fingers toward the newest command."""
        self._gripper = self._gripper if command is None else command
        if self._gripper is None:
            return
        before = self._closure
        most = self.period_s / GRIP_S
        self._closure += min(max(self._gripper - before, -most), most)
        self._closing = (before < HOLDS <= self._closure) - (before >= HOLDS > self._closure)

    def _observe(self) -> Observation:
        joints, velocities = self.world.joints()
        tool, speed = self.world.tool()
        hands = self.script.truth(self.time_s)
        return Observation(
            self.tick, self.time_s, joints, velocities, tool, speed, hands, self._closure
        )

    def _handle(self, seen: Observation) -> None:
        """Move the hands and all held things."""
        world = self.world
        holders = {
            world.arm: seen.tool,
            world.left: Pose(tuple(seen.hands.left.position), HAND_ORIENTATION),
            world.right: Pose(tuple(seen.hands.right.position), HAND_ORIENTATION),
        }
        world.put(world.left, holders[world.left])
        world.put(world.right, holders[world.right])
        for thing, (holder, grip) in self._held.items():
            world.put(thing, carried_by(holders[holder], grip))
        self._holders = holders

    def _take(self, thing: str, holder: str) -> None:
        self._held[thing] = (holder, seen_from(self._holders[holder], self.world.pose(thing)))

    def _watch(self, seen: Observation) -> None:
        """Detect the events by the tool's distances, in the rests after the motions."""
        world = self.world
        scene = self.scene
        reached = itertools.takewhile(
            bool, (event.reached for event in msgspec.structs.astuple(self.events()))
        )
        observed, over = self.script.progress(seen.time_s, sum(reached))
        tool = np.array(seen.tool.position)
        handover, grasp, carry = self._watches
        offered = _distance(tool, np.add(seen.hands.left.position, TOOL_FROM_HAND))
        by_itself = self._gripper is None
        if observed == 0 and handover.see(offered, seen.time_s, counts=by_itself):
            self._take(world.board, world.left)
        if self._closing < 0:
            self._let_go(seen, offered)
        if (
            self._closing > 0
            and not self._held_by_arm()
            and grasp.see(_distance(tool, scene.glass), seen.time_s)
        ):
            self._take(world.glass, world.arm)
        if observed == 1:
            if grasp.see(_distance(tool, scene.glass), seen.time_s, counts=by_itself):
                self._take(world.glass, world.arm)
            if (
                world.iron not in self._held
                and _distance(seen.hands.right.position, scene.iron) <= ARRIVED_M
            ):
                self._take(world.iron, world.right)
            if self._held.get(world.board, ("",))[0] == world.left:
                del self._held[world.board]
        if observed == 2:
            carry.see(_distance(tool, scene.carry), seen.time_s, counts=world.glass in self._held)
        self.closed = len(self._watches) if self.finished else over

    def things(self) -> tuple[SceneObject, ...]:
        """The things on the bench as viewers draw them: those that the arm holds in the frame of
        its plate, all others in `base`.
        """
        objects = []
        for name, look in self.world.things.items():
            holder, grip = self._held.get(name, (None, None))
            held = grip is not None and holder == self.world.arm
            frame = BASE
            pose = self.world.pose(name)
            if held and grip:
                frame = self._plate
                pose = carried_by(self.world.plate_from_tool, grip)
            objects.append(SceneObject(name, look.shape, frame, *pose, look.size, look.colour))  # type: ignore[arg-type]
        return (*objects, *self.script.places())

    def _held_by_arm(self) -> list[str]:
        return [thing for thing, (holder, _) in self._held.items() if holder == self.world.arm]

    def _let_go(self, seen: Observation, offered: float) -> None:
        """Give the held things to the hand that they are offered to, or drop them on the table."""
        world = self.world
        for thing in self._held_by_arm():
            if thing == world.board and self._watches[0].see(offered, seen.time_s):
                self._take(thing, world.left)
            else:
                del self._held[thing]
                x, y, _ = seen.tool.position
                world.put(thing, Pose((x, y, 0.0), LEVEL))

    def events(self) -> TaskEvents:
        """The results of the events; an event before its window has an infinite distance."""
        return TaskEvents(*(watch.event() for watch in self._watches))

    def close(self) -> None:
        """End the simulation."""
        self.world.close()


def _distance(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))
