"""The interface of methods that predict the tool: a method learns a model from demonstrations, the
model is placed in a scene, and the placed model predicts from the hands.

To add a rival, write a class or function in this package, and add it to the methods of an
experiment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from thirdhand.core.skill.model import CHI_SQUARE
from thirdhand.core.skill.skill import Skill
from thirdhand_sim.lab.results import Array

Scene_contra = TypeVar("Scene_contra", contravariant=True)
Mask = NDArray[np.bool_]


class DependsOn(Enum):
    """The input of a prediction, which determines the motion of the predicted tool."""

    HANDS = "the hands now"
    PAST = "the hands until now"


class Observed(NamedTuple):
    """Both hands as the service estimates them, one row for each sample, in the order of time."""

    times: Array  # (T,) [s]
    hands: Array  # (T, 6) [m]
    velocities: Array  # (T, 6) [m/s]
    stillness: Array  # (T, 2) of each hand, from 0 to 1

    @staticmethod
    def resting(hands: Array, times: Array | float = 0.0) -> Observed:
        """Hands (T, 6) [m] at rest."""
        shape = len(hands)
        return Observed(
            np.broadcast_to(times, shape), hands, np.zeros((shape, 6)), np.ones((shape, 2))
        )


class Predicted(NamedTuple):
    """The predicted tool: means (T, 3) [m], covariances (T, 3, 3) [m²] or None, True (T,) where the
    method holds and where it reports uncertainty, the squared Mahalanobis distances of the regions
    of LEVELS, and the probabilities (T,) of an error.
    """

    mean: Array
    covariance: Array | None = None
    held: Mask | None = None
    uncertain: Mask | None = None
    radii: tuple[float, ...] = CHI_SQUARE
    probability: Array | None = None


class PlacedModel(Protocol):
    """A model in a scene."""

    @property
    def depends_on(self) -> DependsOn:
        """The input of the prediction."""

    def predict(self, seen: Observed) -> Predicted:
        """The tool for observed hands."""

    def mean(self, seen: Observed) -> Array:
        """The means only (T, 3) [m]."""


class RivalModel(Protocol[Scene_contra]):
    """The result of learning from demonstrations."""

    def place(self, scene: Scene_contra) -> PlacedModel | Skill:
        """The model, or a skill of the service, in a scene."""


Learn: TypeAlias = Callable[[Sequence[Any]], RivalModel[Any]]
"""From demonstrations to a model."""


class RivalMethod(Protocol):
    """A way to learn, with its parameters."""

    def learn(self, demonstrations: Sequence[Any]) -> RivalModel[Any]:
        """The model of demonstrations."""


@dataclass(frozen=True)
class Law:
    """A model that ignores the scene, and predicts by a function."""

    predict: Callable[[Observed], Predicted]
    depends_on: DependsOn = DependsOn.PAST

    def place(self, scene: object) -> Law:
        """The model itself, which ignores the places."""
        return self

    def mean(self, seen: Observed) -> Array:
        """As `PlacedModel.mean`."""
        return self.predict(seen).mean
