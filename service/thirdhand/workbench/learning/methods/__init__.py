"""Methods that learn the tool's position; METHODS lists them in order of precedence.

A new method is a module of this package with a class like `Method`, and an entry in METHODS.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, Self

from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.learning.methods.inputs import HandInputs
from thirdhand.workbench.learning.methods.mixture import Mixture
from thirdhand.workbench.learning.methods.segmented import Segmented
from thirdhand.workbench.learning.records import Fitted, Options, Progress, Taught


class Method(Protocol):
    """A way to learn the tool's position from takes."""

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], options: Options) -> Self | None:
        """The method for these demonstrations and options; None if it does not apply to them."""

    def fit(self, taught: Taught, progress: Progress) -> Fitted:
        """The model of the takes, its gate, and its predictions of held-out ones of the new takes.

        Raises SkillError or ValueError if nothing can be learned.
        """


# the last one applies to all demonstrations
METHODS: tuple[type[Method], ...] = (Mixture, Segmented, HandInputs)


def method_of(demonstrations: Sequence[Demonstration], options: Options) -> Method:
    """The first of METHODS that applies to these demonstrations and options."""
    return next(
        found for method in METHODS if (found := method.of(demonstrations, options)) is not None
    )
