"""Rivals that use the via-points of a scene and no demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thirdhand.contract.requests import ViaPoint
from thirdhand.core.skill.via_points import neighbourhoods
from thirdhand_sim.lab.results import Array
from thirdhand_sim.lab.rivals.gaussian_process import PlacedProcess, ProcessKernel
from thirdhand_sim.lab.rivals.method import DependsOn, Observed, Predicted
from thirdhand_sim.people import Places
from thirdhand_sim.sessions import SessionDemonstration
from thirdhand_sim.teach import via_points_of

# d tool / d hands at a place at which the tool follows the left hand
FOLLOW_LEFT = np.hstack([np.eye(3), np.zeros((3, 3))])


@dataclass(frozen=True)
class NoDemonstrations:
    """Kernel regression through via-points and start only; it never holds, as it has no
    demonstrations.
    """

    ell: float = 5.0  # [1/m²] of exp(-ell |s - s'|²)
    deviation_m: float = 0.2  # deviation of the tool far from all via-points

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> NoDemonstrations:
        """Nothing is learned."""
        return self

    def place(self, places: Places) -> PlacedProcess:
        """The regression through these places."""
        inputs, outputs, std = neighbourhoods(via_points_of(places))
        kernel = ProcessKernel(self.deviation_m**2, np.full(6, 1.0 / np.sqrt(2.0 * self.ell)))
        return PlacedProcess.of(
            [kernel], [inputs], [outputs], [std**2], centre=outputs.mean(axis=0)
        )


@dataclass(frozen=True)
class LookUp:
    """The mean of the taught tools, weighted by powers of the hands' distance; it never holds."""

    power: float = 4.0
    deviation_m: float = 0.03

    def learn(self, demonstrations: Sequence[SessionDemonstration]) -> LookUp:
        """Nothing is learned."""
        return self

    def place(self, places: Places) -> PlacedLookUp:
        """The table of these places."""
        return PlacedLookUp(via_points_of(places), self)


@dataclass(frozen=True, eq=False)
class PlacedLookUp:
    """The table of four places."""

    points: tuple[ViaPoint, ...]
    method: LookUp
    depends_on = DependsOn.HANDS

    def mean(self, seen: Observed) -> Array:
        """As `PlacedModel.mean`."""
        return self._weighed(seen.hands)[0]

    def predict(self, seen: Observed) -> Predicted:
        """As `PlacedModel.predict`; the covariance is that of the weighted tools, and a
        constant.
        """
        mean, weights, tools = self._weighed(seen.hands)
        offsets = tools - mean[:, None]
        covariance = np.einsum(
            "tp,tpi,tpj->tij", weights, offsets, offsets
        ) + self.method.deviation_m**2 * np.eye(3)
        return Predicted(mean, covariance, np.zeros(len(mean), bool))

    def _weighed(self, hands: Array) -> tuple[Array, Array, Array]:
        via_hands = np.array([[*p.left, *p.right] for p in self.points])
        away = hands[:, None] - via_hands
        tools = np.array([p.tool for p in self.points]) + np.stack(
            [
                away[:, i] @ (FOLLOW_LEFT.T if p.follow == "left" else np.zeros((6, 3)))
                for i, p in enumerate(self.points)
            ],
            axis=1,
        )
        weights = 1.0 / (np.sum(away**2, axis=2) + 1e-8) ** (self.method.power / 2.0)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.einsum("tp,tpi->ti", weights, tools), weights, tools
