"""The bench: arm, hands and things in step with a script, and whether the task succeeds.

No network, no clock: `step` is one period.

bench = Bench(HandScript(Scene(), seed=1))
bench.begin()
while not bench.finished:
    seen = bench.step(q, dq)
"""

from __future__ import annotations

import math
from types import TracebackType
from typing import NamedTuple, Self

import msgspec
import numpy as np
import numpy.typing as npt

from service.arms.playback import REJOIN_AFTER_S
from service.client import BRAKE_AFTER_S
from service.contract.messages import BASE, SceneObject
from service.settings.config import Settings
from sim.engines import world_of
from sim.scene import GRASP_DISTANCE, HAND_ORIENTATION, TOOL_FROM_HAND
from sim.script import GRIP_S, HandMotions, HandScript
from sim.world import BOARD_IN_TOOL, LEVEL, POSITION_GAIN, Floats, Pose, World, carried_by, seen_from

SETTLE_RANGE_S = (0.5, 2.5)  # at least and at most, before the script begins
SETTLED_STILL_S = 0.25  # of rest is settled
STAND_RAD, STAND_RADPS = 0.02, 0.05  # how nearly
HOLDS = 0.5  # closed so far the fingers hold what is between them
TAIL_S = 0.5  # watched after the script's end
CATCH_UP_RADPS = 0.25  # beside the commanded speed, at most, by the joint that is farthest behind
STILL_WITHIN = 0.005  # [m] a tool that a trembling hand leads is never quite at rest


class TaskEvent(msgspec.Struct, frozen=True):
    """How one event went: whether the tool was there, its smallest distance [mm], and when: first
    near enough, or nearest [s of the script].
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
        """Whether the board was taken, the glass grasped, and held over the board."""
        return self.handover.reached and self.grasp.reached and self.carry.reached


class Observation(NamedTuple):
    """The bench after a step: steps done, seconds since the script began (0 before), joints [rad,
    rad/s], tool [m, m/s], hands, gripper.
    """

    tick: int
    time_s: float
    joints: Floats
    joint_velocities: Floats
    tool: Pose
    tool_velocity: Floats
    hands: HandMotions
    gripper: float  # how far it is closed, 0 to 1


class _Watch:
    """The smallest distance within the window of one event."""

    def __init__(self) -> None:
        self.nearest, self.nearest_s, self.reached_s = math.inf, 0.0, math.nan

    def see(self, distance: float, time_s: float, *, counts: bool = True) -> bool:
        """Take one distance [m]; true at the first one that is near enough."""
        if distance < self.nearest:
            self.nearest, self.nearest_s = distance, time_s
        first = counts and distance <= GRASP_DISTANCE and math.isnan(self.reached_s)
        if first:
            self.reached_s = time_s
        return first

    def event(self) -> TaskEvent:
        reached = not math.isnan(self.reached_s)
        return TaskEvent(
            reached, round(1000 * self.nearest, 3), round(self.reached_s if reached else self.nearest_s, 3)
        )


class Bench:
    """The arm at its posture with the board in its tool, the hands at the script's start, waiting
    for `begin`.
    """

    def __init__(
        self,
        script: HandScript,
        *,
        settings: Settings | None = None,
        posture: Floats | None = None,
        world: type[World] | None = None,
    ) -> None:
        """`settings` name the arm and the rate (or else the shipped cell's). The arm begins at its
        posture unless another is given. `world` is the physics, or else the first installed.
        """
        self.script = script
        self.scene = script.scene
        settings = settings or Settings()
        self.period_s = settings.period_s
        self.joint_names, self._plate = settings.joints.names, settings.arm.plate
        self.limits = settings.joints
        posture = posture or settings.arm.posture
        self.world = (world or world_of())(self.scene, settings, posture=posture)
        self.tick = 0
        self._ticks_since_begin = 0
        self._direction = 0  # of script time: 0 waiting, 1 forth, -1 back
        self._since_command = 0
        self.refused = 0  # commands that did not begin where the arm stood, after a silence
        self._still = 0
        self._gripper: float | None = None  # as commanded; None: never, and what is near is grasped
        self._lay_out()
        self._observation = self._observe()
        self._still_at = self._observation.tool.position
        self._command = (self._observation.joints, (0.0,) * len(self._observation.joints))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _lay_out(self) -> None:
        """Everything back to where a run begins."""
        scene, world = self.scene, self.world
        self._watches = (_Watch(), _Watch(), _Watch())
        self.closed = 0  # events whose window is over
        world.put(world.glass, Pose(scene.glass, LEVEL))
        world.put(world.iron, Pose(scene.iron, LEVEL))
        self._closure, self._closing = 1.0, 0  # of the fingers; 1 when they closed in this step, -1 when they opened
        # What is held: by which holder, and how it lies in its hand.
        self._held: dict[str, tuple[str, Pose]] = {world.board: (world.arm, BOARD_IN_TOOL)}

    def begin(self) -> None:
        """Start the script: hands move from the next step on."""
        self._lay_out()
        self._ticks_since_begin, self._direction = 0, 1

    def turn_back(self) -> None:
        """Let the hands go back the way they came, which keeps them where the skill knows the way;
        then `begin` can follow.
        """
        self._ticks_since_begin = min(self._ticks_since_begin, math.ceil(self.script.duration_s / self.period_s))
        self._direction = -1

    @property
    def time_s(self) -> float:
        """Seconds of the script [s]; 0 before it begins."""
        return self._ticks_since_begin * self.period_s

    @property
    def finished(self) -> bool:
        """Whether the script and the tail after it are over."""
        return self._direction == 1 and self.time_s >= self.script.duration_s + TAIL_S

    @property
    def waiting(self) -> bool:
        """Whether the script has not begun."""
        return self._direction == 0

    @property
    def back(self) -> bool:
        """Whether the hands have come back to their start."""
        return self._direction == -1 and self._ticks_since_begin == 0

    @property
    def still_s(self) -> float:
        """For how long the tool has stayed within 5 mm [s]."""
        return self._still * self.period_s

    def settled(self, waited_s: float) -> bool:
        """Whether the arm, given so long, has come to rest where the hands want it."""
        return waited_s >= SETTLE_RANGE_S[1] or (waited_s >= SETTLE_RANGE_S[0] and self.still_s >= SETTLED_STILL_S)

    def observe(self) -> Observation:
        """What the last step left."""
        return self._observation

    def step(
        self, position: Floats | None = None, velocity: Floats | None = None, *, gripper: float | None = None
    ) -> Observation:
        """The bench one period later, after a command of its joints [rad, rad/s] and of its gripper
        (0 open, 1 closed), or none. Until the first of the latter it grasps what is near.
        """
        self._follow(position, velocity)
        self._grip(gripper)
        self.world.step()
        self.tick += 1
        self._ticks_since_begin = max(0, self._ticks_since_begin + self._direction)
        seen = self._observe()
        self._still += 1
        if math.dist(seen.tool.position, self._still_at) > STILL_WITHIN:
            self._still, self._still_at = 0, seen.tool.position
        self._handle(seen)
        if self._direction == 1:
            self._watch(seen)
        self._observation = seen
        return seen

    def _begins_here(self, position: Floats, velocity: Floats | None) -> bool:
        """Whether a command is one to stand where the arm stands, as whoever takes over sends it.

        What a network held back while it was cut comes all at once when it is mended, and would
        throw the arm along a way that is long past.
        """
        off = max(abs(told - is_at) for told, is_at in zip(position, self._observation.joints, strict=True))
        return off <= STAND_RAD and max(map(abs, velocity or (0.0,))) <= STAND_RADPS

    def _follow(self, position: Floats | None, velocity: Floats | None) -> None:
        alone = self._since_command * self.period_s >= REJOIN_AFTER_S
        if position is not None and alone and not self._begins_here(position, velocity):
            position = None
            self.refused += 1
        if position is not None:
            self._command = (position, velocity or (0.0,) * len(position))
            self._since_command = 0
        else:
            # Two clocks beat: a period without a command is ordinary, and the arm goes on as
            # commanded until it is too long.
            self._since_command += 1
            age_s = self._since_command * self.period_s
            if self._since_command == round(BRAKE_AFTER_S / self.period_s):
                self._command = (self._observation.joints, (0.0,) * len(self._observation.joints))
            position, velocity = self._command
            position = tuple(q + age_s * dq for q, dq in zip(position, velocity, strict=True))
        self.world.follow(self._caught_up(position), self._command[1])

    def _caught_up(self, position: Floats) -> Floats:
        """Where the motors go in this step.

        A bench that a busy machine held up finds the commands far ahead. The servo of an arm never
        sleeps: it would not leap after them, and this one does not either.
        """
        at = self._observation.joints
        behind = max(abs(told - is_at) for told, is_at in zip(position, at, strict=True))
        most = CATCH_UP_RADPS * self.period_s / POSITION_GAIN
        if behind <= most:
            return position
        return tuple(is_at + most / behind * (told - is_at) for told, is_at in zip(position, at, strict=True))

    def _grip(self, told: float | None) -> None:
        """Moves the fingers on toward the newest command."""
        self._gripper = self._gripper if told is None else told
        if self._gripper is None:
            return
        before, most = self._closure, self.period_s / GRIP_S
        self._closure += min(max(self._gripper - before, -most), most)
        self._closing = (before < HOLDS <= self._closure) - (before >= HOLDS > self._closure)

    def _observe(self) -> Observation:
        joints, velocities = self.world.joints()
        tool, speed = self.world.tool()
        hands = self.script.truth(self.time_s)
        return Observation(self.tick, self.time_s, joints, velocities, tool, speed, hands, self._closure)

    def _handle(self, seen: Observation) -> None:
        """Move the hands, and what anyone holds."""
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
        """Let the events happen, by nearness in the rests after the motions."""
        world, scene = self.world, self.scene
        script_s = self.script.clock.at(seen.time_s)[0]
        tool = np.array(seen.tool.position)
        first, second, third = scene.dwells
        handover, grasp, carry = self._watches
        offered = _distance(tool, np.add(seen.hands.left.position, TOOL_FROM_HAND))
        by_itself = self._gripper is None
        if first[0] <= script_s <= first[1] and handover.see(offered, seen.time_s, counts=by_itself):
            self._take(world.board, world.left)
        if self._closing < 0:
            self._let_go(seen, offered)
        if self._closing > 0 and not self._held_by_arm() and grasp.see(_distance(tool, scene.glass), seen.time_s):
            self._take(world.glass, world.arm)
        if second[0] <= script_s <= second[1]:
            if grasp.see(_distance(tool, scene.glass), seen.time_s, counts=by_itself):
                self._take(world.glass, world.arm)
            if world.iron not in self._held and _distance(seen.hands.right.position, scene.iron) <= GRASP_DISTANCE:
                self._take(world.iron, world.right)
            if self._held.get(world.board, ("",))[0] == world.left:
                del self._held[world.board]
        if third[0] <= script_s:
            carry.see(_distance(tool, scene.carry), seen.time_s, counts=world.glass in self._held)
        self.closed = (script_s > first[1]) + (script_s > second[1]) + self.finished

    def things(self) -> tuple[SceneObject, ...]:
        """What lies on the bench or is held, as viewers draw it: what the arm holds in the frame of
        its plate, all else in base.
        """
        found = []
        for name, look in self.world.things.items():
            holder, grip = self._held.get(name, (None, None))
            held = grip is not None and holder == self.world.arm
            frame, pose = BASE, self.world.pose(name)
            if held and grip:
                frame, pose = self._plate, carried_by(self.world.plate_from_tool, grip)
            found.append(SceneObject(name, look.shape, frame, *pose, look.size, look.colour))  # type: ignore[arg-type]
        return tuple(found)

    def _held_by_arm(self) -> list[str]:
        return [thing for thing, (holder, _) in self._held.items() if holder == self.world.arm]

    def _let_go(self, seen: Observation, offered: float) -> None:
        """What the fingers held goes to the hand that it is offered to, or falls on the table."""
        world = self.world
        for thing in self._held_by_arm():
            if thing == world.board and self._watches[0].see(offered, seen.time_s):
                self._take(thing, world.left)
            else:
                del self._held[thing]
                x, y, _ = seen.tool.position
                world.put(thing, Pose((x, y, 0.0), LEVEL))

    def events(self) -> TaskEvents:
        """How the run went, so far as it went: an event that was not watched yet has an infinite
        distance.
        """
        return TaskEvents(*(watch.event() for watch in self._watches))

    def close(self) -> None:
        """End the simulation."""
        self.world.close()


def _distance(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))
