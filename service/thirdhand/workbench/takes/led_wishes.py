"""Calibration of a policy's wishes: how far are they from the tool that a person leads meanwhile?

While somebody leads the arm by hand, a cell whose tool wishes lead holds and records both. Each
recording counts as a take, and its wishes as predictions, see `regions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thirdhand.contract.records import Reason
from thirdhand.core.skill import SIGNS
from thirdhand.core.skill.model import NORMAL, REGION_95
from thirdhand.core.skill.step import recent
from thirdhand.core.skill.tuning import UNSURE_M
from thirdhand.recordings.recording import Recording
from thirdhand.skills.no_skill import leads_alone, no_skill
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded, with_file
from thirdhand.workbench.learning.choice import LEAST_BLOCKS
from thirdhand.workbench.learning.records import TimedErrors
from thirdhand.workbench.learning.regions import calibrated, calibrated_without

LEAST_FRAMES = 20  # of a recording in which a person leads the arm and wishes are due


class CalibratedWishes(NamedTuple):
    """The stand-in skill with the regions of a policy, and what held-out recordings show."""

    skill: StoredSkill
    rms_m: float  # error of the wishes
    held_before: float  # share of the errors within the 95 % region of the policy's own covariance
    held: float  # within that of regions from the other recordings
    wrong: float  # share of errors above UNSURE_M


def calibrated_wishes(paths: Sequence[Path], name: str) -> CalibratedWishes:
    """The calibration by recordings in which a person leads the arm. Raises SkillError and
    RecordingError.
    """
    if len(paths) < LEAST_BLOCKS:
        raise SkillError(
            f"{len(paths)} recordings given; at least {LEAST_BLOCKS} needed, each of a task that "
            "a person leads the arm through while the policy wishes"
        )
    errors = [_errors(path) for path in paths]
    persons = np.arange(len(paths))
    regions = calibrated(errors, persons)
    squares = np.concatenate([part.squares(0.0) for part in errors])
    held = np.concatenate(
        [part.squares(of.std_s) / of.scale for part, of in calibrated_without(errors, persons)]
    )
    distances = np.linalg.norm(np.concatenate([part.errors for part in errors]), axis=1)
    return CalibratedWishes(
        with_file(replace(no_skill(), name=name, regions=regions)),
        float(np.sqrt(np.mean(distances**2))),
        float(np.mean(squares < REGION_95)),
        float(np.mean(held < REGION_95)),
        float(np.mean(distances > UNSURE_M)),
    )


def _errors(path: Path) -> TimedErrors:
    """The errors of the wishes in a recording, where a person leads the arm."""
    recording = Recording.open(path).require_whole()
    settings = recording.settings
    if not leads_alone(settings):
        raise SkillError(f"{path}: a recording of a cell whose tool wishes lead alone needed")
    if decoded(recording.skill, origin=str(path)).regions != NORMAL:
        raise SkillError(f"{path}: its covariances are calibrated already; record without that")
    frames = [
        step.frame
        for step in recording.steps(whole=False)
        if step.frame is not None
        and step.frame["reason"] == Reason.GUIDED
        and not step.frame["commanded"]
        and step.frame["covariance"].any()
    ]
    if len(frames) < LEAST_FRAMES:
        raise SkillError(
            f"{path}: {len(frames)} frames in which somebody leads the arm and a wish is due; at "
            f"least {LEAST_FRAMES} needed"
        )
    moving = np.array(frames)
    trail = moving["target"][0].copy()
    velocities = np.zeros((len(frames), 3))
    passed_s = np.diff(moving["tick"], prepend=moving["tick"][0]) * settings.period_s
    for i, (target, elapsed_s) in enumerate(zip(moving["target"], passed_s, strict=True)):
        velocities[i] = recent(target, elapsed_s, trail)
    return TimedErrors(
        moving["tool"] - moving["target"],
        moving["covariance"].copy(),
        velocities,
        np.zeros((len(frames), SIGNS)),
    )
