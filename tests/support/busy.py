"""Tests that fail while the machine is busy are run again, and counted separately if they then
pass.

If a test process waits for a processor as long as it runs, the machine is busy with processes that
the tests did not start: two workers and their daemons on two idle cores wait a third of that.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

WAITING_SHARE = 0.5  # share of the time in which a process could run; see the module's docstring
BUSY = "busy"
# times of the main thread [ns]: running, and waiting for a processor
SCHEDULED = Path("/proc/self/schedstat")


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Run a test, twice if it fails while the machine is busy."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in _reports(item, nextitem):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, str] | None:
    """Count tests that passed in their second run separately."""
    return (BUSY, "B", "BUSY") if report.when == "call" and report.passed and note(report) else None


def _reports(item: pytest.Item, nextitem: pytest.Item | None) -> list[pytest.TestReport]:
    """The reports of a test; those of its second run if the machine was too busy in the first."""
    before_ns = _scheduled_ns()
    reports = runtestprotocol(item, nextitem=nextitem, log=False)
    failures = [report for report in reports if report.failed]
    share = _waiting_share(before_ns)
    if not failures or share < WAITING_SHARE:
        return reports
    item.session._setupstate.teardown_exact(None)  # noqa: SLF001  # as a plug-in that runs tests again has to
    item._initrequest()  # type: ignore[attr-defined]  # noqa: SLF001
    rerun = runtestprotocol(item, nextitem=nextitem, log=False)
    words = (
        f"its process waited for a processor {100 * share:.0f} % of the time that it could have run"
    )
    for report in rerun:
        if any(other.failed for other in rerun):
            report.sections.append(
                (f"run twice, as {words}; the first failure", failures[0].longreprtext)
            )
        else:
            report.user_properties.append((BUSY, f"{words}; it passed when it was run again"))
    return rerun


def note(report: pytest.TestReport) -> str:
    """The reason why a passed test was run twice; empty if it was run once."""
    return str(dict(report.user_properties).get(BUSY, ""))


def _scheduled_ns() -> tuple[int, int]:
    try:
        running_ns, waiting_ns, _ = SCHEDULED.read_text(encoding="ascii").split()
    except OSError:  # not Linux, or a kernel without it
        return 0, 0
    return int(running_ns), int(waiting_ns)


def _waiting_share(before_ns: tuple[int, int]) -> float:
    """Share of the time since `before_ns` in which the process could run and waited."""
    now_ns = _scheduled_ns()
    running_ns = now_ns[0] - before_ns[0]
    waiting_ns = now_ns[1] - before_ns[1]
    return waiting_ns / max(running_ns + waiting_ns, 1)
