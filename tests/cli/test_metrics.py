"""`thirdhand metrics`: a scrape, parsed by Prometheus's own client, and the alerts on it."""

from __future__ import annotations

import contextlib
import re
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import yaml
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from support.cell import Tracker, serving, until
from support.cell_commands import started
from support.paths import ROOT
from support.statuses import holding
from thirdhand.client import Client
from thirdhand.contract.records import Mode, Reason
from thirdhand.contract.requests import Percentiles, Source, Status
from thirdhand.daemon.launch import free_port
from thirdhand.workbench.cli.metrics import exposed

RULES = ROOT / "examples" / "thirdhand.rules.yml"
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def samples(text: str) -> Samples:
    """The values of a scraped page by name and labels, without the cell."""
    values = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = frozenset(
                (name, value) for name, value in sample.labels.items() if name != "cell"
            )
            assert (sample.name, labels) not in values
            values[sample.name, labels] = sample.value
    return values


def value(found: Samples, name: str, **labels: str) -> float | None:
    return found.get((f"thirdhand_{name}", frozenset(labels.items())))


@contextlib.contextmanager
def page(endpoint: str) -> Iterator[str]:
    """The address of the page that `thirdhand metrics` serves, until the context ends."""
    with started("metrics", "--listen", "127.0.0.1:0", "--connect", endpoint) as process:
        url_match = re.search(r"http://127\.0\.0\.1:\d+/metrics", process.stderr.readline())
        assert url_match is not None
        yield url_match[0]


def test_metrics_are_those_of_the_status(tmp_path: Path) -> None:
    """Scrapes fail while there is no daemon, and return with it."""
    network = f"[network]\nlisten = ['tcp/127.0.0.1:{free_port()}']\n"
    arguments = ("--joints", "assumed", "--record", str(tmp_path / "records"))

    def scrape() -> Samples:
        with urllib.request.urlopen(address, timeout=20) as reply:
            assert reply.headers["Content-Type"].startswith("text/plain")
            return samples(reply.read().decode())

    with contextlib.ExitStack() as closing:
        with serving(tmp_path, *arguments, network=network) as daemon:
            address = closing.enter_context(page(daemon.endpoint))
            with Tracker(daemon.session):
                daemon.session.put("thirdhand/hands/left", b"no message")
                now = daemon.until(
                    lambda now: now["mode"] == "follow" and now["scribe"]["state"] == "recording"
                )
                scraped = scrape()
            later = Client(daemon.session).status()
            assert value(scraped, "up") == 1
            assert value(scraped, "info", version=later.version, skill=later.skill) == 1
            assert [value(scraped, "mode", mode=mode) for mode in ("hold", "follow", "fault")] == [
                0,
                1,
                0,
            ]
            assert value(scraped, "reason", reason="operator") == 0
            assert now["tick"] < (value(scraped, "ticks_total") or 0) <= later.tick + 1
            assert value(scraped, "rejected_samples_total", cause="malformed hands/left") == 1
            assert 0 < (value(scraped, "lateness_seconds", percentile="50") or 0) < 1
            assert 0 < (value(scraped, "work_seconds", percentile="99") or 0) < 1
            assert 0 < (value(scraped, "latency_seconds", percentile="100") or 0) < 10
            assert 20e6 < (value(scraped, "memory_bytes", process="scribe") or 0) < 5e9
            assert 20e6 < (value(scraped, "memory_bytes", process="daemon") or 0) < 5e9
            assert (value(scraped, "disk_free_bytes") or 0) > 0
            assert value(scraped, "recording") == 1
            daemon.process.kill()
            daemon.process.wait(20)
        assert scrape() == {("thirdhand_up", frozenset()): 0.0}
        with serving(tmp_path, *arguments, network=network):
            until(lambda: value(scrape(), "up") == 1, "it did not connect again", within_s=30)


PERCENTILES = Percentiles(1.0, 2.0, 4.0)
STATUS = msgspec.structs.replace(
    holding("lab/one", 99),
    reason="stale_hand",
    flags=("stuck",),
    missed=7,
    skill='a "skill"\\',
    rejected={"jumped": 3},
    lateness_us=PERCENTILES,
    latency_ms=PERCENTILES,
    scribe={
        "state": "recording",
        "lost": 5,
        "restarts": 1,
        "free_mb": 1000,
        "mb_per_hour": 500.0,
    },
    version="0.1.0",
    sources={"left": Source(rate_hz=100.0, age_ms=20.0), "right": Source()},
    segment=("handover", "carry"),
    segment_belief=0.75,
    error_probability=0.5,
    memory_mb={"daemon": 100.0},
)


def exposition(statuses: dict[str, Status | None]) -> str:
    """The page for statuses of cells by name."""

    class Given(Collector):
        def collect(self) -> Iterator[Metric]:
            return iter(exposed(statuses))

    registry = CollectorRegistry()
    registry.register(Given())
    return generate_latest(registry).decode()


def test_each_figure_has_its_unit_and_a_silent_cell_is_down() -> None:
    scraped = samples(exposition({"lab/one": STATUS}))
    expected = {
        ("ticks_total",): 100,
        ("missed_deadlines_total",): 7,
        ("memory_locked",): 0,
        ("lateness_seconds", ("percentile", "99")): 2e-6,
        ("latency_seconds", ("percentile", "100")): 4e-3,
        ("source_age_seconds", ("source", "left")): 0.02,
        ("source_age_seconds", ("source", "right")): None,
        ("segment_probability", ("begin", "handover"), ("end", "carry")): 0.75,
        ("disk_free_bytes",): 1e9,
        ("recording_bytes_per_hour",): 5e8,
        ("memory_bytes", ("process", "daemon")): 1e8,
        ("lost_ticks_total",): 5,
        ("flag", ("flag", "stuck")): 1,
        ("flag", ("flag", "unsure")): 0,
        ("info", ("version", "0.1.0"), ("skill", 'a "skill"\\')): 1,
    }
    for (name, *labels), figure in expected.items():
        assert value(scraped, name, **dict(labels)) == (
            None if figure is None else pytest.approx(figure)
        ), name
    for kind, codes in (("mode", Mode), ("reason", Reason)):
        states = [state for (name, _), state in scraped.items() if name == f"thirdhand_{kind}"]
        assert (len(states), sum(states)) == (len(codes) - (codes is Reason), 1)
    two = exposition({"lab/one": STATUS, "lab/two": None})
    assert 'thirdhand_up{cell="lab/two"} 0.0' in two
    assert two.count('"lab/two"') == 1
    assert two.count("# TYPE thirdhand_up gauge") == 1


def test_the_alerts_use_metrics_that_exist() -> None:
    rules = [
        rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]
    ]
    exported = {name for name, _ in samples(exposition({"lab/one": STATUS}))}
    named = {name for rule in rules for name in re.findall(r"thirdhand_\w+", rule["expr"])}
    assert len(rules) == 11
    assert len(named) > 8
    assert named <= exported
