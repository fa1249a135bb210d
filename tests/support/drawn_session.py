"""A session drawn from its seed: a cell, a skill, hands and an arm, requests, missed deadlines;
then hands that rest. It is played tick by tick, with all data by which bounds are judged.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import msgspec
import numpy as np

from support.arm_geometry import ArmGeometry
from support.bounds import Session
from support.drawn_arms import KINDS, ODD_STAMPS_NS, WELL, DrawnArm
from support.drawn_cells import changes, drawn_cell, engaging_cell
from support.drawn_hands import MOTIONS, REPORTS, Report, Surroundings, both, come_to_rest
from support.drawn_policy import DrawnPolicy
from support.explained import explained_controller
from support.in_process import clutch
from support.paths import RECORDINGS
from support.starts import free_postures
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.records import SIDES, Flag, Reason
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Event, Frame, Record, Tick, Vector, order
from thirdhand.core.skill.skill import Skill
from thirdhand.core.way_out import WayOut
from thirdhand.core.wish.stage import WHOLE_REACH
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, SkillSettings, robot_description
from thirdhand.skills.skill_file import SkillError, decoded
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.made_tasks import takes
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

SEGMENTS = 7  # parts of a session, each with its own motion and report
TRACKERS_HZ = (10.0, 15.0, 20.0, 30.0, 60.0, 100.0, 240.0, 500.0)
MISSED = (1, 2, 5, 30, 49, 50, 100, 250, 499, 3000)  # ticks
WRONG_STAMPS_NS = (-(10**9), 10**9, 0, -2_000_000, 10**15)  # errors of wrong stamps
LATEST_S = 0.09
# searches for a way out: duration, time until the next one, largest number
SEARCH_S = 0.3
SEARCH_AGAIN_S = 2.0
SEARCHES = 4
# ticks
ELBOW_LINK = 4
ELBOW_EVERY = 10
# clutch: mean time between press and release, share of ticks with a message
CLUTCH_S = (0.002, 0.05, 1.0)
CLUTCH_SHARE = 0.9
# states from which the session is replayed, and ticks of each replay
STATES = 2
REPLAYED = 150


class Played(NamedTuple):
    """A session; the first differing frames of replays from kept states; and a description of the
    session.
    """

    session: Session
    replayed_otherwise: list[int]
    what_happens: list[str]


@cache
def skills() -> dict[str, Skill]:
    """Skills by name: shipped, with via-points at several positions, with random via-points,
    without segments, one of a made task, and two without a limit of the distance from
    demonstrations.
    """
    random = np.random.default_rng(5)
    base = shipped_skill()
    paper = RECORDINGS / "experiments" / "as-paper.npz"
    by_name: dict[str, Skill] = {
        "shipped": base,
        "paper": decoded(paper.read_bytes(), origin=paper.name),
    }
    demonstrations = [take.demonstration for take in takes("three", people=(0,), each=2)]
    by_name["made"] = learn(demonstrations)
    while len(by_name) < 11:
        moved = len(by_name) < 7
        try:
            points = _moved(random) if moved else _anywhere(random, base)
            by_name[f"{'taught' if moved else 'random'} {len(by_name)}"] = adapted(
                base, points, tolerance=0.05 if moved else float(random.choice([0.05, 0.2]))
            )
        except SkillError:  # the random via-points contradict each other
            continue
    return by_name | {
        f"{name}, anywhere": replace(by_name[name], threshold=math.inf)
        for name in ("shipped", "taught 3")
    }


def _moved(random: np.random.Generator) -> tuple[ViaPoint, ...]:
    """The scene's via-points, all moved by the same offset of up to 1.5 cm."""
    offset_m = random.uniform(-0.015, 0.015, 3)
    return tuple(
        msgspec.structs.replace(
            p, tool=tuple((p.tool + offset_m).tolist()), left=tuple((p.left + offset_m).tolist())
        )
        for p in Scene().via_points()
    )


def _anywhere(random: np.random.Generator, skill: Skill) -> tuple[ViaPoint, ...]:
    """Up to six via-points with the tool anywhere in the workspace."""
    out = []
    for number in range(random.integers(1, 7)):
        left, right = script_hands()[random.integers(len(script_hands()))] + random.normal(
            0.0, 0.02, (2, 3)
        )
        turn = random.normal(size=4)
        out.append(
            ViaPoint(
                name=f"point {number}",
                left=tuple(left.tolist()),
                right=tuple(right.tolist()),
                tool=tuple(random.uniform(*skill.workspace).tolist()),
                std=float(10.0 ** random.uniform(-5.0, -1.0)),
                radius=float(random.choice([0.0, 0.001, 0.03, 0.1])),
                follow=str(random.choice(["none", "left", "right"])),
                orientation=tuple((turn / np.linalg.norm(turn)).tolist())
                if random.random() < 0.4
                else None,
                gripper=str(random.choice(["open", "closed"])) if random.random() < 0.3 else None,
            )
        )
    return tuple(out)


@cache
def script_hands() -> Vector:
    """Positions of both hands (M, 2, 3) in the scripted task."""
    script = HandScript(Scene(), seed=0)
    return np.array(
        [[hand[:3] for hand in script.sample(t)] for t in np.linspace(0.0, script.duration_s, 25)]
    )


def play(
    seed: int,
    arm: str,
    *,
    wild_ticks: int,
    quiet_s: float,
    most_quiet_ticks: int,
    engages: bool = False,
    skill: SkillSettings | None = None,
) -> Played:
    """The session of a seed: ticks in which anything may happen, then hands that come to rest. In a
    cell that `engages`, the setpoint begins slowly, and a clutch is pressed and released. Settings
    of the `skill` that let wishes lead bring a policy.
    """
    random = np.random.default_rng(seed)
    settings = drawn_cell(random, arm)
    if engages:
        settings = engaging_cell(random, settings)
    if skill is not None:
        settings = msgspec.structs.replace(settings, skill=skill)
    urdf = robot_description(settings)
    hz = settings.rate_hz
    player = _Player(random, settings, urdf, wild_ticks)
    for _ in range(wild_ticks + min(round(quiet_s * hz), most_quiet_ticks)):
        player.step()
    return Played(
        player.session(),
        player.replayed_otherwise(),
        [f"drawn: {changes(settings, arm)}", *player.what],
    )


class _Player:
    """A controller, its surroundings, and the session so far."""

    def __init__(
        self, random: np.random.Generator, settings: Settings, urdf: str, wild_ticks: int
    ) -> None:
        self.random = random
        self.settings = settings
        self.urdf = urdf
        self.quiet_from = wild_ticks
        self._has_clutch = settings.hands.clutch == "key"
        self.geometry = ArmGeometry(settings, urdf)
        self.name = str(random.choice(list(skills())))
        self.skill = skills()[self.name]
        skill_hands = (
            self.skill.hands.reshape(-1, 2, 3) if random.random() < 0.5 else np.empty((0, 2, 3))
        )
        posture = np.array(settings.arm.posture)
        is_assumed = settings.arm.source == "assumed"
        if not is_assumed and random.random() < 0.4:
            posture = free_postures(settings, 1, int(random.integers(10**6)))[0]
        capsules, tool = self.geometry.place(posture[None])
        self.around = Surroundings(
            random, settings.period_s, np.concatenate([skill_hands, script_hands()]), tool[0]
        )
        self.elbow = int(np.flatnonzero(self.geometry.links == ELBOW_LINK)[0])
        self.around.elbow = capsules[0, self.elbow, 0]
        follows = is_assumed or random.random() < 0.5
        self.arm = None if is_assumed else DrawnArm(WELL, posture, settings, random)
        self.wild_arm = WELL if follows else str(random.choice(KINDS))
        self.segments = [
            (MOTIONS[random.integers(len(MOTIONS))], self._report()) for _ in range(SEGMENTS)
        ]
        self.every = max(1, round(settings.rate_hz / random.choice(TRACKERS_HZ)))
        self.noise_m = float(random.choice([0.0, 0.0005, 0.002]))
        self.p_miss = random.choice([0.0, 0.0, 0.0005, 0.005])
        self.p_late = random.choice([0.0, 0.0, 0.1, 0.5])
        self.p_wrong_stamp = random.choice([0.0, 0.0, 0.01, 0.1])
        self.p_hold = random.choice([0.0, 0.003, 0.01])
        self.clutch_s = float(random.choice(CLUTCH_S)) if self._has_clutch else 0.0
        self.is_pressed = False
        self.p_reset = random.choice([0.001, 0.02])
        self.skill_every = int(random.choice([0, 0, 0, 0, 50, 500, 7]))
        self.changes_to = [
            name for name in skills() if random.random() < 0.5 or name.startswith("taught")
        ]
        self.kept_at = set(random.integers(1, wild_ticks, STATES).tolist())
        self.controller = explained_controller(settings, self.skill, urdf=urdf)
        self.policy = DrawnPolicy.of(random, settings, self.skill.orientation)
        self.motion = iter(())
        self.report = both
        self.index = self.asked = self.searches = 0
        self.later: list[tuple[int, Event]] = []
        self.ticks: list[Tick] = []
        self.frames: list[Frame] = []
        self.hands: list[Vector] = []
        self.still_s: list[Vector] = []
        self.measured: list[Vector] = []
        self.skills: list[Skill] = []
        self.what = [
            f"skill {self.name}, arm {self.wild_arm}, {settings.rate_hz / self.every:.0f} samples "
            "a second"
        ]
        self.kept: list[tuple[int, Skill, Record]] = []
        self.way_out: WayOut | None = None

    def _report(self) -> Report:
        return REPORTS[self.random.integers(len(REPORTS))]

    def step(self) -> None:
        """Play one tick."""
        number = len(self.frames)
        random = self.random
        is_quiet = number >= self.quiet_from
        self.index += 1
        if not is_quiet and random.random() < self.p_miss:
            self.index += int(random.choice(MISSED))
        inbox = self._hands(number, is_quiet)
        if self.arm is not None:
            self.arm.kind = WELL if is_quiet else self.wild_arm
            inbox += self.arm.events(number, self._stamp_ns())
        inbox += self._requests_at_rest(number) if is_quiet else self._requests(number)
        inbox += self._clutch(is_quiet) if self._has_clutch else []
        if self.policy is not None:
            now_s = self.index * self.settings.period_s
            inbox += self.policy.events(now_s, self._stamp_ns(), is_quiet=is_quiet)
        if not is_quiet and random.random() < 0.3:
            random.shuffle(inbox)
        inbox += [event for due, event in self.later if due <= number]
        self.later = [(due, event) for due, event in self.later if due > number]
        self.ticks.append(Tick(self.index, tuple(inbox), self._stamp_ns()))
        frame = self.controller.step(self.ticks[-1])
        self._remember(number, frame)
        self.around.tool = frame["tool"]
        if self.arm is not None:
            self.arm.follow(frame)
        if number % ELBOW_EVERY == 0:
            self.around.elbow = self.geometry.place(frame["joints"][None])[0][0, self.elbow, 0]

    def _remember(self, number: int, frame: Frame) -> None:
        """Keep the frame and a few states: copying a state takes as long as a tick."""
        self.skills.append(self.controller.skill)
        before = self.frames[-1] if self.frames else frame
        self.frames.append(frame)
        begins = (
            not before["joint_velocities"].any() and (frame["joints"] != before["joints"]).any()
        )
        is_stuck = frame["flags"] & Flag.STUCK or frame["reason"] == Reason.BLOCKED
        if not (begins or is_stuck or number in self.kept_at):
            self.measured.append(self.measured[-1] if self.measured else frame["joints"])
            return
        state = self.controller.state
        self.measured.append(state["measured"].copy())
        if number in self.kept_at:
            self.kept.append((number, self.controller.skill, state))
        if is_stuck and not state["way_count"]:
            self._look_for_a_way(number, frame, state)

    def _stamp_ns(self) -> int:
        return self.index * (10**9 // self.settings.rate_hz) + 1

    def _hands(self, number: int, is_quiet: bool) -> list[Event]:
        """Move the hands, and report them in this tick or later."""
        random = self.random
        around = self.around
        length = -(-self.quiet_from // SEGMENTS)
        if number == self.quiet_from:
            self.motion = come_to_rest(around)
            self.report = both
        elif not is_quiet and number % length == 0:
            motion, self.report = self.segments[number // length]
            self.motion = motion(around)
            self.what.append(
                f"from frame {number}: {motion.__name__}, reported as {self.report.__name__}"
            )
        before = around.hands
        around.hands = next(self.motion)
        moved = (around.hands != before).any(axis=1)
        still_s = self.still_s[-1] if self.still_s else np.zeros(2)
        self.still_s.append(np.where(moved, 0.0, still_s + self.settings.period_s))
        self.hands.append(around.hands)
        out = []
        if number % self.every == 0:
            for side, hand in self.report(around.hands, number * self.settings.period_s, random):
                stamp_ns = self._stamp_ns()
                position = hand + random.normal(0.0, self.noise_m, 3)
                if not is_quiet and random.random() < self.p_wrong_stamp:
                    wrong = stamp_ns + np.array(WRONG_STAMPS_NS)
                    stamp_ns = int(
                        [*wrong, *ODD_STAMPS_NS][random.integers(len(wrong) + len(ODD_STAMPS_NS))]
                    )
                pose = PoseStamped(stamp_ns, "base", tuple(position.tolist()), (0.0, 0.0, 0.0, 1.0))
                event = Event(f"hands/{side}", b"", pose)
                if not is_quiet and random.random() < self.p_late:
                    self.later.append(
                        (number + 1 + int(random.integers(around.ticks(LATEST_S))), event)
                    )
                else:
                    out.append(event)
        return out

    def _requests(self, number: int) -> list[Event]:
        """Orders at any time, and other skills."""
        random = self.random
        out = []
        if random.random() < self.p_hold:
            out.append(order("hold" if random.random() < 0.5 else "resume"))
        if random.random() < self.p_reset:
            out.append(order("reset"))
        if random.random() < 0.0001:
            out.append(order("fault"))
        if number % 700 == 0:
            out.append(order("resume"))
        names = getattr(self.controller.skill.model, "names", ())
        if names and random.random() < 0.0005:
            out.append(order("segment", str(random.choice(names))))
        if self.skill_every and number % self.skill_every == 0:
            out.append(Event("skill", b"", skills()[str(random.choice(self.changes_to))]))
        return out

    def _clutch(self, is_quiet: bool) -> list[Event]:
        """The clutch is pressed and released for `clutch_s` on average, with a message in most
        ticks; in the quiet part it is pressed.
        """
        if self.random.random() < self.settings.period_s / self.clutch_s:
            self.is_pressed = not self.is_pressed
        self.is_pressed = self.is_pressed or is_quiet
        return [clutch(self.is_pressed)] if is_quiet or self.random.random() < CLUTCH_SHARE else []

    def _requests_at_rest(self, number: int) -> list[Event]:
        """Load the first skill again, and resume and reset."""
        since = number - self.quiet_from
        out = [Event("skill", b"", self.skill), order("resume")] if since == 0 else []
        return out + ([order("resume"), order("reset")] if since % 500 == 250 else [])

    def _look_for_a_way(self, number: int, frame: Frame, state: Record) -> None:
        """Plan a way out as the daemon does for a stuck tool."""
        if self.searches == SEARCHES or (
            self.searches and number - self.asked < self.around.ticks(SEARCH_AGAIN_S)
        ):
            return
        self.asked = number
        self.searches = self.searches + 1
        self.way_out = self.way_out or WayOut(self.settings, self.urdf)
        hands = np.array(frame["hands"])
        postures = self.way_out.find(
            state["joints"][0].copy(), frame["target"].copy(), frame["orientation"].copy(), hands
        )
        event = order("way", json.dumps([posture.tolist() for posture in postures]))
        self.later.append((number + self.around.ticks(SEARCH_S), event))

    def replayed_otherwise(self) -> list[int]:
        """Play a part of the session again from each kept state."""
        out = []
        for number, skill, state in self.kept:
            controller = Controller(self.settings, skill, state, urdf=self.urdf)
            for k in range(number + 1, min(number + REPLAYED, len(self.ticks))):
                if controller.step(self.ticks[k]).tobytes() != self.frames[k].tobytes():
                    out.append(k)
                    break
        return out

    def session(self) -> Session:
        """The data by which bounds are judged."""
        receiving = {
            skill.digest: [any(p.follow == side for p in skill.via_points) for side in SIDES]
            for skill in self.skills
        }
        return Session(
            settings=self.settings,
            geometry=self.geometry,
            frames=np.array(self.frames),
            measured=np.array(self.measured),
            boxes=np.array(
                [WHOLE_REACH if self.policy else skill.workspace for skill in self.skills]
            ),
            receiving=np.array([receiving[skill.digest] for skill in self.skills]),
            hands=np.array(self.hands),
            still_s=np.array(self.still_s),
            noise_m=self.noise_m,
            quiet_from=self.quiet_from,
            arm_follows=self.wild_arm == WELL,
            deadlines_kept=self.p_miss == 0.0,
        )
