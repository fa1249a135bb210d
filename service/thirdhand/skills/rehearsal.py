"""Rehearsal of the compiled functions that learning calls and the loop does not."""

from __future__ import annotations

import numpy as np

from kmp import KMP, GaussianKernel, Gaussians
from kmp.arrays.immutable import frozen
from thirdhand.core.skill import ORDER
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.memory import along
from thirdhand.core.skill.model import NORMAL_WEIGHTS
from thirdhand.core.skill.segments import MOST_SEGMENTS, SEGMENT
from thirdhand.core.skill.step import recent
from thirdhand.core.skill.support import LocalErrors, error_probability
from thirdhand.core.skill.task_clock import BEGIN_AT, counted
from thirdhand.skills.recognition import all_followed, covered, recognised, stillness_of

SAMPLE_PERIOD_S = 0.01


def rehearse() -> None:
    """Compile or load these functions, on two samples of resting hands in a task of one segment."""
    hands = np.zeros((2, 6))
    still = stillness_of(hands, SAMPLE_PERIOD_S)
    along(hands, SAMPLE_PERIOD_S, 0.1, ORDER)
    counted(hands, still[:, 0], still[:, 1], SAMPLE_PERIOD_S, np.zeros((1, BEGIN_AT + 6)))

    labels = np.zeros(2, np.int64)
    # writable segments of a demonstration, and read-only ones of a skill, which are another type
    for segments in (np.ones(1, SEGMENT), frozen(np.ones(1, SEGMENT))):
        recognised(np.zeros((2, 3, 6)), SAMPLE_PERIOD_S, segments, np.zeros((2, MOST_SEGMENTS)))
        covered(hands, still, labels, segments)
        all_followed(hands, still[:, 0].copy(), labels, segments, np.zeros((2, 3)))

    recent(np.zeros(3), SAMPLE_PERIOD_S, np.zeros(3))
    reference = Gaussians(np.zeros((1, 3)), np.eye(3)[None])
    primitive = KMP.fit(hands[:1], reference, kernel=GaussianKernel(1.0), lambda_mean=1.0)
    errors = LocalErrors.of(primitive, hands, np.zeros((2, 3)), 0.1)
    model = HandsKMP(primitive, errors=errors)
    model.uncertainty(hands, model.tools(hands))
    error_probability(np.ones((3, 3)), 0.0, 0.0, np.array(NORMAL_WEIGHTS))
