"""The low rank solution: the cost (4) minimised over r features of the kernel.

k(s, s') = z(s)^T z(s') + residual with features z (r,), so xi(s) = W^T z(s) with W (r, D) from an
(r D x r D) system for any number of points. The residual is included in the covariance and between
via-points. Fine and Scheinberg 2001; Rasmussen and Williams 2006, sections 8.1 and 8.3.
"""

from kmp.low_rank.features import FLOOR, Features
from kmp.low_rank.solution import RANK, TOLERANCE, LowRank

__all__ = ["FLOOR", "RANK", "TOLERANCE", "Features", "LowRank"]
