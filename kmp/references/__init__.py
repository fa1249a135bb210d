"""References other than the regression of one mixture.

A reference is a normal distribution of the output at each of N inputs. A primitive imitates it.
`frames`: in coordinates that move with the task; `superposition`: several by priorities;
`gaussian_process`: for inputs of many dimensions; `correlation`: its covariances, from a reward.
"""

from kmp.references.frames import CoordinateFrame, LocalKMP

__all__ = ["CoordinateFrame", "LocalKMP"]
