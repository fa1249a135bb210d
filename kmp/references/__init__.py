"""References that one mixture cannot give.

In task frames, superposed by priority, by Gaussian processes, with correlations from a reward.

A reference is N inputs and a normal distribution of the output at each: what a primitive imitates.
"""

from kmp.references.correlation import Correlation, Improvement, improve
from kmp.references.frames import CoordinateFrame, LocalKMP
from kmp.references.gaussian_process import gaussian_process_reference
from kmp.references.superposition import superposed

__all__ = [
    "CoordinateFrame",
    "Correlation",
    "Improvement",
    "LocalKMP",
    "gaussian_process_reference",
    "improve",
    "superposed",
]
