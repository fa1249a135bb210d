"""The status of a cell: what its newest frame decided, and why, in words with their figures."""

from __future__ import annotations

from typing import Any, NamedTuple

from service.config import Settings
from service.contract.incidents import MALFORMED, SOURCE_NAMES, remedy
from service.contract.messages import Vector3
from service.contract.records import SIDES, Flag, Mode, Reason
from service.contract.requests import Source, Status
from service.core.controller import RETURNING, Controller
from service.core.frame import Frame, Record
from service.core.intake.intake import REST_S
from service.core.intake.plausibility import SCATTERED_M, SETTLED
from service.core.rotation import off_target
from service.core.skill.model import standard_deviations
from service.core.skill.pose import CLOSED, OPEN
from service.daemon.input_monitor import KEYS, frames


class CellStatus(NamedTuple):
    """What a status tells of: the newest frame, the controller that made it and its state, what
    comes in, and what of the service failed last.
    """

    frame: Frame
    controller: Controller
    state: Record
    sources: dict[str, Source]
    settings: Settings
    failure: str = ""

    def status(self, **more: Any) -> Status:
        """The status; `more` are the fields that the core knows nothing of."""
        frame, sources, settings = self.frame, self.sources, self.settings
        begun, seen, aimed = int(frame["tick"]) >= 0, frame["hand_ages"] >= 0, bool(frame["covariance"].any())
        skill, (mode, word) = self.controller.skill, outcome(frame)
        low, high = skill.demonstrated
        return Status(
            cell=settings.cell,
            mode=mode,
            reason=word if begun else "",
            because=self.because() if begun else "",
            remedy=self.remedy(word) if begun else "",
            flags=tuple(str(flag.name).lower() for flag in Flag(int(frame["flags"]))),
            tick=int(frame["tick"]),
            skill=skill.name,
            places=tuple(point.name for point in skill.via_points),
            rejected=_by_cause(sources),
            sources=sources,
            frames=frames(settings),
            joints=settings.joints.names,
            hand_age_ms={side: age for side in SIDES if (age := sources[side].age_ms) is not None},
            hand_distance_m=round(float(frame["hand_distance"]), 4),
            hand_limit_m_s=round(float(frame["hand_limit"]), 4),
            hands_m={side: _point(frame["hands"][i]) for i, side in enumerate(SIDES) if seen[i]},
            demonstrated_m={side: (_point(low[i]), _point(high[i])) for i, side in enumerate(SIDES)},
            tool_m=_point(frame["tool"]) if begun else None,
            setpoint_m=_point(frame["setpoint"]) if begun else None,
            target_m=_point(frame["target"]) if aimed else None,
            std_m=_std(frame["covariance"]) if aimed else None,
            turn_off_rad=self._turned() if aimed else None,
            turn_std_rad=(_std(frame["orientation_covariance"]) or None) if aimed else None,
            gripper={OPEN: "open", CLOSED: "closed"}.get(int(frame["gripper"]), ""),
            closure=round(float(frame["closure"]), 3) if aimed and frame["closure"] >= 0 else None,
            deviation_m=round(float(frame["deviation"]), 5) if aimed else None,
            threshold_m=round(skill.threshold, 5),
            **more,
        )

    def _turned(self) -> float:
        """By how much the tool is turned from its target, or points elsewhere [rad]."""
        tool, target = self.frame["tool_orientation"], self.frame["orientation"]
        return round(float(off_target(tool, target, direction=self.settings.tool.orientation == "direction")), 5)

    def remedy(self, word: str) -> str:
        """What to do about a reason; where it comes of rejected samples, about these."""
        needed = {"no_hands": SIDES, "stale_hand": SIDES, "arm_not_ready": ("arm",)}.get(word, ())
        culprit = next((self.sources[source] for source in needed if _is_refused(self.sources.get(source))), None)
        return remedy(word if culprit is None else culprit.cause)

    def because(self) -> str:
        """The reason for mode hold or fault in words, with its figures."""
        frame, sources, settings = self.frame, self.sources, self.settings
        error_rad, speed = self.controller.measured
        match Reason(int(frame["reason"])):
            case Reason.NO_HANDS | Reason.STALE_HAND:
                return "; ".join(_silence(side, sources[side]) for side in SIDES if not sources[side].fresh)
            case Reason.FAR_FROM_DEMONSTRATIONS:
                skill = self.controller.skill
                off, most = 100 * float(frame["deviation"]), 100 * skill.threshold
                return f"{skill.model.measure} is {off:.1f} cm, {most:.1f} accepted"
            case Reason.TWO_SOURCES:
                return _contest(sources)
            case Reason.ARM_NOT_READY:
                return self._not_ready()
            case Reason.ARM_ERROR:
                return f"a joint was {error_rad:.3f} rad off, {settings.arm.fault_error_rad:g} accepted"
            case Reason.ARM_SILENT:
                return f"no joint states for {settings.arm.silent_ms:g} ms"
            case Reason.TOOL_SPEED:
                max_speed = settings.tool.fault_speed
                if speed > max_speed:
                    return f"the tool was measured at {speed:.2f} m/s, {max_speed:g} accepted"
                return f"a command came to {speed:.2f} m/s, {settings.tool.max_speed:g} accepted"
            case Reason.SERVICE:
                return self.failure
        return ""

    def _not_ready(self) -> str:
        source, joints = self.sources.get("arm"), self.settings.joints
        if source is None:
            return ""
        if _is_refused(source):
            return f"what comes of the arm is rejected as {source.cause}: {source.refused}"
        if not source.fresh:
            return "no joint states came yet" if source.age_ms is None else f"no joint states for {_ago(source.age_ms)}"
        measured = self.state["measured"].tolist()
        for name, at, low, high in zip(joints.names, measured, joints.lower, joints.upper, strict=True):
            if int(self.state["arm_ready"]) == RETURNING and not low <= at <= high:
                return f"{name} at {at:.3f} rad is outside {low:g} to {high:g}, and is moved back"
        return f"the arm has not told one posture for {REST_S:g} s"


def outcome(frame: Frame) -> tuple[str, str]:
    """Mode and reason of a frame."""
    reason = Reason(int(frame["reason"]))
    return Mode(int(frame["mode"])).name.lower(), "" if reason is Reason.NONE else reason.name.lower()


def _is_refused(source: Source | None) -> bool:
    """Whether something comes of a source, and nothing of it is accepted."""
    return source is not None and source.rate_hz > 0 and not source.fresh and bool(source.cause)


def _silence(side: str, source: Source) -> str:
    """Since when a hand is not there, and what of it is rejected instead."""
    seen = "has not been seen yet" if source.age_ms is None else f"was last seen {_ago(source.age_ms)} ago"
    why = f", as what comes is rejected as {source.cause}: {source.refused}" if _is_refused(source) else ""
    return f"the {SOURCE_NAMES[side]} {seen}{why}"


def _contest(sources: dict[str, Source]) -> str:
    """Whose samples contradict each other, or scatter, and by how much."""
    side, source = max(sources.items(), key=lambda item: item[1].contested)
    when = "in the last second" if source.rate_hz else "before it ended"
    if source.contested > SETTLED:
        return f"{SOURCE_NAMES[side]}: {source.contested:.0%} of what came {when} contradicts the rest"
    side, source = max(sources.items(), key=lambda item: item[1].scatter_mm or 0.0)
    return (
        f"{SOURCE_NAMES[side]}: what came {when} scatters by {source.scatter_mm:.0f} mm an axis, "
        f"{1e3 * SCATTERED_M:.0f} accepted"
    )


def _ago(age_ms: float) -> str:
    return f"{age_ms:.0f} ms" if age_ms < 1000 else f"{age_ms / 1000:.1f} s"


def _by_cause(sources: dict[str, Source]) -> dict[str, int]:
    """What was rejected of all sources, by cause; what was malformed by its key."""
    counts: dict[str, int] = {}
    for name, source in sources.items():
        for cause, count in source.rejected.items():
            told = f"{MALFORMED} {KEYS[name]}" if cause == MALFORMED else cause
            counts[told] = counts.get(told, 0) + count
    return counts


def _std(covariance: Any) -> float:
    return round(float(standard_deviations(covariance)), 5)


def _point(values: Any) -> Vector3:
    x, y, z = (round(v, 4) for v in values.tolist())
    return x, y, z
