"""A machine that is too busy is detected, and remembered from the time at which the arm stopped."""

from __future__ import annotations

from pathlib import Path

from thirdhand.contract.evidence import Evidence, explained
from thirdhand.contract.records import Mode, Reason
from thirdhand.contract.requests import Source
from thirdhand.daemon.machine import Machine

FOLLOWS = (Mode.FOLLOW, Reason.NONE)


class Watched:
    """A machine at 500 ticks a second, of which each tenth is reported."""

    def __init__(self, folder: Path) -> None:
        self._pressure = folder / "cpu"
        self._now_s = 0.0
        self._tick = 0
        self._missed = 0
        self._waited_s = 5.0
        self.machine = Machine(self._pressure)

    def goes_on(
        self,
        seconds: float,
        *,
        missed: int = 0,
        late_ms: float = 0.3,
        waiting: float = 0.2,
    ) -> None:
        for _ in range(round(10 * seconds)):
            self._now_s = self._now_s + 0.1
            self._tick = self._tick + 50
            self._missed = self._missed + missed
            self._waited_s += 0.1 * waiting
            waited_us = round(1e6 * self._waited_s)
            self._pressure.write_text(
                f"some avg10=1.00 avg60=0.00 avg300=0.00 total={waited_us}\nfull total=0\n"
            )
            self.machine.update(
                self._now_s, tick=self._tick, missed=self._missed, late_ms=late_ms, outcome=FOLLOWS
            )


def test_each_sign_is_told_with_its_figure(tmp_path: Path) -> None:
    watched = Watched(tmp_path)
    watched.goes_on(5.0, missed=2)
    assert watched.machine.now == "40 of 1000 deadlines were missed"
    watched.goes_on(5.0, late_ms=45.0)
    assert watched.machine.now == "the loop was up to 45 ms late"
    watched.goes_on(5.0, waiting=0.95)
    assert watched.machine.now == "processes waited for a processor 95% of the time"
    watched.goes_on(5.0)
    assert watched.machine.now == ""


def test_busy_machine_is_the_cause_of_timing_incidents_only() -> None:
    """A busy machine is not named with other incidents."""
    evidence = Evidence(busy="the loop was up to 45 ms late")
    for reason in Reason:
        blamed = explained(reason, evidence).why.startswith(
            "this machine was too busy, the loop was up to 45 ms late; "
        )
        assert blamed == (reason in (Reason.STALE_HAND, Reason.ARM_ERROR, Reason.ARM_SILENT))
        assert blamed == (
            "see what else runs on this machine" in explained(reason, evidence).what_to_do
        )
    refused = Source(rate_hz=100.0, cause="wrong_frame", refused="frame 'camera'")
    assert (
        "busy" not in explained(Reason.STALE_HAND, evidence._replace(sources={"left": refused})).why
    )
    stale = Source(rate_hz=60.0, age_ms=130.0)
    for left, is_blamed in ((stale, True), (Source(rate_hz=60.0, age_ms=9.0, fresh=True), False)):
        sources = {"left": left, "right": stale}
        assert (
            "busy" in explained(Reason.STALE_HAND, evidence._replace(sources=sources)).why
        ) == is_blamed
