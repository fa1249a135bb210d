"""The status of a cell: what its newest frame decided, and why, in words with figures."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from thirdhand.contract.evidence import Evidence, Inside, Outside, Stuck, explained
from thirdhand.contract.incidents import MALFORMED, word
from thirdhand.contract.messages import Vector3
from thirdhand.contract.records import GONE_S, SIDES, Flag, Mode, Reason
from thirdhand.contract.requests import Source, Status
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.codes import READY, RETURNING
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Frame, Record, Vector
from thirdhand.core.geometry import off_target
from thirdhand.core.separation.clearance import NEAR_ITSELF
from thirdhand.core.separation.stage import Separation
from thirdhand.core.skill.model import standard_deviations
from thirdhand.core.skill.pose import CLOSED, OPEN
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.task_clock import CLOCK_S
from thirdhand.core.tool_limits import binding
from thirdhand.core.tuning import TUNING
from thirdhand.daemon.input_monitor import KEY_OF_SOURCE
from thirdhand.settings.config import Settings
from thirdhand.skills.corrections import offer_of
from thirdhand.skills.no_skill import leads_alone

MAX_MEASURED_AGE_S = 0.2  # the tool is measured by joint states up to this age
LAG_STATUSES = 10  # of the last second
LEAST_LAG_STATUSES = 3
LAGS_S = np.arange(0.0, 0.4, 0.002)  # that are tried
LEAST_LAG_S = 0.01
UNEXPLAINED_SHARE = 0.1  # of the squared errors, beyond which another cause is as likely
AT_LIMIT_RAD = 0.02  # a joint nearer to a limit than this is at the limit


class CellStatus(NamedTuple):
    """The newest frame, the controller and its state, the streams of input, and the last failure of
    the service, from which a status is made.
    """

    frame: Frame
    controller: Controller
    state: Record
    sources: dict[str, Source]
    settings: Settings
    failure: str = ""
    inside: Inside | None = None  # what an arm that is not ready is inside of
    busy: str = ""  # signs of a busy machine when the arm stopped
    clutch: str = ""  # the problem with the clutch's messages
    late_s: float = 0.0  # see `ArmLag`; 0 unless the arm is at fault
    streams: Mapping[str, Source] = MappingProxyType({})  # other input, by key

    def status(self, **more: Any) -> Status:
        """The status; `more` are the fields that the core does not know."""
        frame = self.frame
        settings = self.settings
        skill = self.controller.skill
        mode, reason = outcome(frame)
        return Status(
            cell=settings.cell,
            mode=word(mode),
            reason=word(reason) if self._has_begun else "",
            flags=tuple(map(word, self._flags)),
            tick=int(frame["tick"]),
            skill=skill.name,
            residual_risk=skill.residual_risk,
            via_points=tuple(point.name for point in skill.via_points),
            rejected=_by_cause({**self.sources, **self.streams}),
            sources=self.sources,
            streams=dict(self.streams),
            frames=settings.tracker_frames,
            trackers={
                tracker_frame: settings.hands_in(tracker_frame).base_from_tracker
                for tracker_frame in (settings.hands.frame, *settings.trackers)
            },
            joints=settings.joints.names,
            gripper={OPEN: "open", CLOSED: "closed"}.get(int(frame["gripper"]), ""),
            guided=bool(self.state["tick"] < self.state["guided_until_tick"]),
            threshold_m=round(skill.threshold, 5),
            offer=offer_of(skill),
            **self._explanation(),
            **self._hands(),
            **self._demonstrated(),
            **self._task(),
            **(self._decided() if self._has_begun else {}),
            **(self._prediction() if frame["covariance"].any() else {}),
            **more,
        )

    @property
    def _has_begun(self) -> bool:
        """True once a tick was decided."""
        return int(self.frame["tick"]) >= 0

    @property
    def _flags(self) -> Flag:
        return Flag(int(self.frame["flags"]))

    def _explanation(self) -> dict[str, Any]:
        """The fields with causes and remedies, of the incident and of faulty streams."""
        _, reason = outcome(self.frame)
        incident = Flag.STUCK if self._flags & Flag.STUCK else reason
        why = explained(incident if self._has_begun else Reason.NONE, self.evidence())

        faulty = [(key, stream) for key, stream in self.streams.items() if stream.cause]
        causes = [
            why.why,
            *(
                f"what arrives on {key} is {stream.cause}: {stream.refused}"
                for key, stream in faulty
            ),
        ]
        remedies = dict.fromkeys([why.what_to_do, *(stream.advice for _, stream in faulty)])
        return {
            "because": "; ".join(filter(None, causes)),
            "remedy": "; ".join(filter(None, remedies)),
        }

    def _hands(self) -> dict[str, Any]:
        """The fields on the hands: ages [ms], and positions and distances [m]."""
        frame = self.frame
        visible = {side: i for i, side in enumerate(SIDES) if frame["hand_ages"][i] >= 0}
        depths_m = {side: self._below_table_m(i) for side, i in visible.items()}
        ages_ms = {side: self.sources[side].age_ms for side in SIDES}
        return {
            "hand_age_ms": {side: age for side, age in ages_ms.items() if age is not None},
            "hand_distance_m": round(float(frame["hand_distance"]), 4),
            "hand_limit_m_s": round(float(frame["hand_limit"]), 4),
            "hands_m": {side: _point(frame["hands"][i]) for side, i in visible.items()},
            "below_table_m": {side: depth_m for side, depth_m in depths_m.items() if depth_m},
        }

    def _demonstrated(self) -> dict[str, Any]:
        """The fields on the hands as demonstrated: needed ones, their boxes and via-points [m]."""
        if leads_alone(self.settings):
            return {"hands": "neither"}
        skill = self.controller.skill
        low, high = skill.demonstrated
        return {
            "hands": ("left", "right", "both")[2 if skill.conductor is None else skill.conductor],
            "demonstrated_m": {
                side: (_point(low[i]), _point(high[i]))
                for i, side in enumerate(SIDES)
                if skill.conductor in (None, i)
            },
            "hands_at_m": {
                name: (_point(hands[:3]), _point(hands[3:])) for name, hands in _hands_at(skill)
            },
        }

    def _task(self) -> dict[str, Any]:
        """The fields on the progress of the task."""
        frame = self.frame
        model = self.controller.skill.model
        segment = int(frame["segment"])
        has_clock = model.clock and model.clock.weight
        return {
            "segment": model.names[segment : segment + 2] if frame["segment_belief"] else (),
            "segment_belief": round(float(frame["segment_belief"]), 3),
            "task_clock_s": round(float(self.state["task_clock"][CLOCK_S]), 2)
            if has_clock
            else None,
        }

    def _decided(self) -> dict[str, Any]:
        """The fields on the tool that the newest tick decided."""
        frame = self.frame
        limits = binding(self.settings, np.asarray(frame).reshape(1))
        return {
            "tool_m": _point(frame["tool"]),
            "setpoint_m": _point(frame["setpoint"]),
            "binding": next((name for name, _ in limits), ""),
        }

    def _below_table_m(self, side: int) -> float:
        """Depth of a hand below the table top [m]; 0 above it and beside it."""
        x, y, z = (self.frame["hands"][side] - np.array(self.settings.table.centre)).tolist()
        half_x, half_y = self.settings.table.half_size
        return round(max(0.0, -z), 4) if abs(x) < half_x and abs(y) < half_y else 0.0

    def _prediction(self) -> dict[str, Any]:
        """The fields of the status on the target and its uncertainty."""
        frame = self.frame
        tool = frame["tool_orientation"]
        target = frame["orientation"]
        turn_off_rad = off_target(
            tool, target, direction=self.settings.tool.orientation == "direction"
        )
        return {
            "target_m": _point(frame["target"]),
            "std_m": _std(frame["covariance"]),
            "turn_off_rad": round(float(turn_off_rad), 5),
            "turn_std_rad": _std(frame["orientation_covariance"]) or None,
            "closure": round(float(frame["closure"]), 3) if frame["closure"] >= 0 else None,
            "error_probability": round(float(frame["error_probability"]), 4),
            "deviation_m": round(float(frame["gate_m"]), 5),
        }

    def evidence(self) -> Evidence:
        """The figures of the incidents that may be explained."""
        settings = self.settings
        skill = self.controller.skill
        error_rad, speed = self.controller.decision.measured
        errors = np.abs(self.frame["joints"] - self.state["measured"])
        worst = int((errors / np.array(settings.joints.per_rad)).argmax())
        limit = settings.tool.fault_speed
        return Evidence(
            sources={
                name: source
                for name, source in self.sources.items()
                if not self._is_unneeded(name, source)
            },
            settings=settings,
            contested=TUNING.intake.contested_off_share,
            gate_m=(float(self.frame["gate_m"]), TUNING.intake.end_share * skill.threshold),
            measure=skill.model.measure,
            outside=self._outside(),
            inside=self.inside,
            stuck=self._stuck() if self.state["stuck"] else None,
            error_rad=(error_rad, settings.arm.fault_error_rad),
            late_s=self.late_s,
            worst_joint=(
                settings.joints.names[worst],
                float(errors[worst]),
                settings.joints.units[worst],
            ),
            measured_speed=(speed, limit) if speed > limit else None,
            commanded_speed=(speed, settings.tool.max_speed),
            failure=self.failure,
            clutch=self.clutch,
            busy=self.busy,
        )

    def _is_unneeded(self, name: str, source: Source) -> bool:
        """True for a hand that the skill does not need, and that has disappeared."""
        side = self.controller.skill.conductor
        is_gone = source.age_ms is None or source.age_ms >= 1000 * GONE_S
        return side is not None and name in SIDES and name != SIDES[side] and is_gone

    def _outside(self) -> Outside | None:
        """The first joint outside its limits, if the arm moves back into them."""
        joints = self.settings.joints
        measured = self.state["measured"].tolist()
        candidates = map(Outside, joints.names, measured, joints.lower, joints.upper, joints.units)
        returning = int(self.state["arm_ready"]) == RETURNING
        return next(
            (
                joint
                for joint in candidates
                if returning and not joint.low <= joint.value <= joint.high
            ),
            None,
        )

    def _stuck(self) -> Stuck:
        """Joints that keep the tool from its target, and the way out."""
        joints = self.settings.joints
        state = self.state
        q = self.state["joints"][0].tolist()
        at_limits = [
            name
            for name, position, low, high, per_rad in zip(
                joints.names, q, joints.lower, joints.upper, joints.per_rad, strict=True
            )
            if min(position - low, high - position) < AT_LIMIT_RAD * per_rad
        ]
        off_m = float(np.linalg.norm(self.frame["tool"] - self.frame["target"]))
        count = int(state["way_count"])
        return Stuck(off_m, tuple(at_limits), min(int(state["way_next"]) + 1, count), count)


class ArmLag:
    """The delay [s] of an arm behind its commands: the one at which the commanded path fits the
    joints measured at the last statuses best, by least squares. Between statuses, the path is the
    cubic through commanded positions and velocities; before the first one, the arm stands.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._rows: deque[tuple[Vector, ...]] = deque(maxlen=LAG_STATUSES)

    def note(self, frame: Frame, state: Record) -> None:
        """Note the joints, as commanded and as measured, unless the arm is at fault."""
        if frame["mode"] != Mode.FAULT and frame["commanded"] and state["arm_tick"] >= 0:
            times_s = self._period_s * np.array([frame["tick"], state["arm_tick"]])
            commanded = frame["joints"], frame["joint_velocities"]
            self._rows.append((times_s, *commanded, state["measured"].copy()))

    def late_s(self) -> float:
        """The lag [s]; 0 if it explains the errors badly."""
        if len(self._rows) < LEAST_LAG_STATUSES:
            return 0.0
        times_s, positions, velocities, measured = (
            np.array(part) for part in zip(*self._rows, strict=True)
        )
        squares = []
        for lag_s in LAGS_S:
            wanted = _path_at(times_s[:, 1] - lag_s, times_s[:, 0], positions, velocities)
            squares.append(float(((measured - wanted) ** 2).sum()))
        best = int(np.argmin(squares))
        is_explained = squares[best] < UNEXPLAINED_SHARE * squares[0]
        return float(LAGS_S[best]) if is_explained and LAGS_S[best] > LEAST_LAG_S else 0.0


def _path_at(at_s: Vector, times_s: Vector, positions: Vector, velocities: Vector) -> Vector:
    """The cubic path (N, J) through positions and velocities (M, J) at `times_s` (M,)."""
    begin = np.clip(np.searchsorted(times_s, at_s, side="right") - 1, 0, len(times_s) - 2)
    lasts_s = (times_s[begin + 1] - times_s[begin])[:, None]
    u = np.clip((at_s - times_s[begin])[:, None] / lasts_s, 0.0, 1.0)
    first = lasts_s * velocities[begin]
    second = lasts_s * velocities[begin + 1]
    way = positions[begin + 1] - positions[begin]
    bend = 3.0 * way - 2.0 * first - second
    return np.asarray(
        positions[begin] + u * (first + u * (bend + u * (first + second - 2.0 * way)))
    )


class MeasuredArm:
    """The pose of the arm at the joints that were measured last."""

    def __init__(self, settings: Settings, urdf: str) -> None:
        self._period_s = settings.period_s
        self._names = settings.joints.names
        # Own copies, because the loop uses its arm and separation at the same time.
        self._arm = ArmStage(settings, urdf)
        self._separation = Separation(settings, urdf)

    def inside(self, state: Record) -> Inside | None:
        """What an arm that is not ready is inside of; None: nothing."""
        if state["arm_ready"] == READY or state["arm_tick"] < 0:
            return None
        depth_m, joint, thing = self._separation.intrusion(state["measured"].copy())
        if depth_m <= 0.0:
            return None
        things = {0: "the table", NEAR_ITSELF: "another part of the arm"}
        return Inside(
            self._names[max(joint, 0)], things.get(thing, f"box {thing} of [obstacles]"), depth_m
        )

    def position(self, state: Record) -> Vector3 | None:
        """The tool's position [m] in frame `base`; None if the measured joints are too old."""
        if (
            state["arm_tick"] < 0
            or (state["tick"] - state["arm_tick"]) * self._period_s >= MAX_MEASURED_AGE_S
        ):
            return None
        return _point(self._arm.at(state["measured"].copy()).position)


def outcome(frame: Frame) -> tuple[Mode, Reason]:
    """Mode and reason of a frame."""
    return Mode(int(frame["mode"])), Reason(int(frame["reason"]))


def _by_cause(sources: dict[str, Source]) -> dict[str, int]:
    """Rejected messages of all streams by cause; malformed ones by their key too."""
    counts: Counter[str] = Counter()
    for name, source in sources.items():
        for cause, count in source.rejected.items():
            counts[
                f"{MALFORMED} {KEY_OF_SOURCE.get(name, name)}" if cause == MALFORMED else cause
            ] += count
    return counts


def _std(covariance: Any) -> float:
    return round(float(standard_deviations(covariance)), 5)


def _hands_at(skill: Skill) -> list[tuple[str, Any]]:
    """Names and hands (6,) [m] of the learned via-points, in the order of the task; for a skill
    without via-points, one unnamed pair of demonstrated hands.
    """
    hands = skill.model.hands
    named_hands = (
        zip(skill.model.names, hands, strict=True) if skill.model.names else [("", hands[0])]
    )
    return [(name, row) for name, row in named_hands if np.isfinite(row).all()]


def _point(values: Any) -> Vector3:
    x, y, z = (round(v, 4) for v in values.tolist())
    return x, y, z
