"""Residual risks of a skill: what remains after all that the service does, and may be accepted by
somebody who takes the responsibility (ISO 12100). The figures in a skill's file hold both.
"""

from __future__ import annotations

import msgspec

from thirdhand.contract.printable import printable

OPTION = "--accept-residual-risk"  # of `thirdhand learn`
LONGEST_ACCEPTER = 64  # [characters] of the person who accepts


class ResidualRisk(msgspec.Struct, frozen=True):
    """The residual risks in a skill's figures, and who accepted them; empty if nobody did."""

    residual: tuple[str, ...] = ()
    accepted_by: str = ""

    @staticmethod
    def of(figures: str) -> ResidualRisk:
        """The risks in the figures (JSON) of a skill. Raises msgspec.ValidationError."""
        return msgspec.json.decode(figures or "{}", type=ResidualRisk)

    @property
    def accepted(self) -> str:
        """The accepted risks and the person, in words; empty if there are none."""
        is_accepted = bool(self.residual and self.accepted_by)
        return (
            printable(f"accepted by {self.accepted_by}: {'; '.join(self.residual)}") * is_accepted
        )

    @property
    def refusal(self) -> str:
        """The reason why the skill is not served, with the remedy; empty if it is."""
        if self.accepted_by or not self.residual:
            return ""
        return (
            f"nobody has accepted its residual risk: {'; '.join(self.residual)}. Who takes the "
            f"responsibility learns it again with {OPTION} NAME"
        )
