"""The solution for any number of points: the cost (4) solved on features of the kernel.

With r features z(s), xi(s) = z(s) W, and W (r, D) minimises (4): an (r D x r D) system, however
many points there are. What the features leave of the kernel, the residual, is kept where it counts:
in the covariance, and at via-points.
"""

from kmp.low_rank.features import Features
from kmp.low_rank.solution import RANK, TOLERANCE, LowRank

__all__ = ["RANK", "TOLERANCE", "Features", "LowRank"]
