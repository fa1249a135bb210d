"""`thirdhand metrics`: the statuses of all cells on a network, as a page for Prometheus."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any
from wsgiref.simple_server import WSGIServer

import msgspec
import zenoh
from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from thirdhand.cli.usage import reached
from thirdhand.client import cells as served_cells
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.contract.incidents import word
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.contract.requests import Status
from thirdhand.process.progress import say
from thirdhand.workbench.cli.web_address import web_address

# a cell that does not answer within this time is down, and so is a silent client
SCRAPE_TIMEOUT_S = 2.0
MOST_REQUESTS = 64  # threads at once, of which each request takes one
Figure = tuple[str, str, float | None, dict[str, str]]  # name, explanation, value, labels


def metrics(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    address = web_address("--listen", args.listen)
    with reached(args) as session:
        registry = CollectorRegistry()
        registry.register(CellCollector(session))
        try:
            server, thread = start_http_server(address.port, address.host, registry)
        except OSError as error:
            raise ExplainedError(f"--listen {address}: {in_words(error)}") from None
        _bound(server)
        say(f"metrics for Prometheus: http://{address._replace(port=server.server_port)}/metrics")
        thread.join()
    return 0


def _bound(server: WSGIServer) -> None:
    """Close silent connections, and those beyond MOST_REQUESTS at once, without an answer."""
    server.RequestHandlerClass.timeout = SCRAPE_TIMEOUT_S  # type: ignore[attr-defined]
    server.verify_request = lambda *_: threading.active_count() < MOST_REQUESTS  # type: ignore[method-assign]
    server.handle_error = lambda *_: None  # type: ignore[method-assign]


class CellCollector(Collector):
    """The metrics of all cells at each scrape; a cell that no longer answers is down."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._seen = set[str]()

    def collect(self) -> Iterable[Metric]:
        statuses = {
            cell.name: cell.status
            for cell in served_cells(self._session, timeout_s=SCRAPE_TIMEOUT_S)
        }
        self._seen |= statuses.keys()
        return exposed({name: statuses.get(name) for name in sorted(self._seen)})


def exposed(statuses: Mapping[str, Status | None]) -> Iterable[Metric]:
    """The metrics of cells by name; names that end in `_total` are counters."""
    families: dict[str, Any] = {}
    for cell, now in statuses.items():
        up: Figure = ("up", "1 if the cell's daemon answers.", now is not None, {})
        for name, about, value, labels in (up, *([] if now is None else _figures(now))):
            if value is not None:
                kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
                family = families.setdefault(
                    name, kind(f"thirdhand_{name}", about, labels=("cell", *labels))
                )
                family.add_metric((cell, *labels.values()), float(value))
    return families.values()


def _codes(now: Status) -> Iterator[Figure]:
    """Figures of all modes, reasons and flags: 1 for those that are present, or else 0."""
    present: tuple[tuple[str, Sequence[str], Any], ...] = (
        ("mode", [now.mode], Mode),
        ("reason", [now.reason], Reason),
        ("flag", now.flags, Flag),
    )
    for kind, words, codes in present:
        for name in filter(None, map(word, codes)):
            yield kind, f"1 for each {kind} that is present.", name in words, {kind: name}


def _sources(now: Status) -> Iterator[Figure]:
    """The rate and the age of each source."""
    for name, source in now.sources.items():
        labels = {"source": name}
        about = "Messages of a source in the last second."
        yield "source_rate_hertz", about, source.rate_hz, labels
        age_s = None if source.age_ms is None else 1e-3 * source.age_ms
        yield "source_age_seconds", "Age of a source's newest accepted sample.", age_s, labels


def _figures(now: Status) -> Iterator[Figure]:
    """The figures of a status, with 0 for modes, reasons and flags that are not present."""
    yield (
        "info",
        "Version and skill of the daemon.",
        1,
        {"version": now.version, "skill": now.skill},
    )
    yield from _codes(now)
    if now.segment:
        segment = dict(zip(("begin", "end"), now.segment, strict=False))
        yield (
            "segment_probability",
            "Probability of the segment between two via-points.",
            now.segment_belief,
            segment,
        )
    yield from _durations(now)
    for cause, count in now.rejected.items():
        yield "rejected_samples_total", "Rejected samples of all sources.", count, {"cause": cause}
    yield from _sources(now)
    for process, memory_mb in now.memory_mb.items():
        yield "memory_bytes", "Resident memory of a process.", 1e6 * memory_mb, {"process": process}
    for name, about, value in (*_of_loop(now), *_of_scribe(now.scribe)):
        yield name, about, value, {}


def _durations(now: Status) -> Iterator[Figure]:
    """The percentiles of lateness, work and latency [s]."""
    about = (
        "Lateness of ticks, work in a tick, or latency from a hand's stamp to a command, over 10 s."
    )
    for name in ("lateness_us", "work_us", "latency_ms"):
        unit_s = 1e-3 if name.endswith("_ms") else 1e-6
        values = msgspec.structs.astuple(getattr(now, name))
        for percentile, value in zip(("50", "99", "100"), values, strict=True):
            yield f"{name[:-3]}_seconds", about, unit_s * value, {"percentile": percentile}


def _of_loop(now: Status) -> tuple[tuple[str, str, float | None], ...]:
    """Name, explanation and value of the loop's figures."""
    return (
        ("ticks_total", "Ticks since the start, with missed ones.", now.tick + 1),
        ("missed_deadlines_total", "Deadlines that the loop skipped.", now.missed),
        ("rate_hertz", "Ticks per second since the start.", now.rate_hz),
        ("realtime", "1 if real-time scheduling was granted.", now.realtime),
        ("memory_locked", "1 if memory is not paged out.", now.memory_locked),
        ("busy", "1 if the machine is too busy, or was when the arm stopped.", bool(now.busy)),
        ("command_heard", "1 if anybody subscribes to joint commands.", now.command_heard),
        (
            "hand_distance_meters",
            "Distance of the nearest hand from the arm, up to 3 m.",
            now.hand_distance_m,
        ),
        (
            "error_probability",
            "Probability that the tool is more than 10 cm off.",
            now.error_probability,
        ),
    )


def _of_scribe(scribe: Mapping[str, Any]) -> tuple[tuple[str, str, float | None], ...]:
    """Name, explanation and value of the recorder's figures."""
    return (
        ("recording", "1 while a recording is written.", scribe.get("state") == "recording"),
        ("lost_ticks_total", "Ticks that are not recorded.", scribe.get("lost", 0)),
        (
            "recorder_restarts_total",
            "Starts of the recorder after the first.",
            scribe.get("restarts", 0),
        ),
        ("disk_free_bytes", "Free space where it records.", _bytes(scribe.get("free_mb"))),
        ("recording_bytes_per_hour", "Recent growth.", _bytes(scribe.get("mb_per_hour"))),
    )


def _bytes(megabytes: float | None) -> float | None:
    return None if megabytes is None else 1e6 * megabytes
