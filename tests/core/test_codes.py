"""Codes of compiled stages: plain numbers with the values of their enumerations."""

from __future__ import annotations

import enum

import pytest

from thirdhand.core import codes

PLAIN_NAMES = {
    codes.Condition: "{}",
    codes.LedBy: "BY_{}",
    codes.Start: "STARTS_{}",
    codes.ArmReady: "{}",
    codes.Stuck: "{}",
    codes.Held: "HELD_{}",
    codes.SetpointStep: "{}",
    codes.SetpointBound: "{}_BOUND",
    codes.ClockTrust: "{}",
}


@pytest.mark.parametrize("kind", PLAIN_NAMES)
def test_plain_codes_are_those_of_their_enumeration(kind: type[enum.IntEnum]) -> None:
    for member in kind:
        name = PLAIN_NAMES[kind].format(member.name).replace("NONE_BOUND", "NO_BOUND")
        assert getattr(codes, name) == member.value
