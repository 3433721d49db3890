"""Scrapes of metrics, read by Prometheus' own parser."""

from __future__ import annotations

import re
from collections.abc import Callable
from urllib.request import urlopen

import pytest
from helpers.cli_runner import Command
from helpers.processes import Child, until

from zstate.metrics.collectors import Collector, MetricFamilies

pytest.importorskip("prometheus_client", reason="pip install 'zstate[metrics]'")

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

Row = tuple[str, frozenset[tuple[str, str]]]


def parsed(text: str) -> dict[Row, float]:
    """The value of each row: by its name and its labels."""
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def row(name: str, **labels: str) -> Row:
    return name, frozenset(labels.items())


def scraped(url: str) -> dict[Row, float]:
    with urlopen(url, timeout=5.0) as answer:
        return parsed(answer.read().decode())


def collected(add: Callable[[MetricFamilies], None]) -> dict[Row, float]:
    """The rows that ``add`` adds, without a network."""
    registry = CollectorRegistry()
    registry.register(Collector(add))
    return parsed(generate_latest(registry).decode())


def url_of(command: Child | Command) -> str:
    """Where a command serves its metrics."""
    until(lambda: "metrics at " in command.stderr)
    match = re.search(r"metrics at (http://127\.0\.0\.1:\d+/metrics)", command.stderr)
    assert match
    return match[1]


def grown(url: str, grows: Row) -> dict[Row, float]:
    """A scrape that finds ``grows`` larger than one before."""
    first = scraped(url)[grows]
    until(lambda: scraped(url)[grows] > first)
    return scraped(url)


def wait_for_names(url: str, expected: list[str]) -> None:
    """Wait until the metrics of zstate with the names of their labels are there, and no others."""
    until(lambda: set(expected) <= set(_names(url)))
    assert _names(url) == expected


def _names(url: str) -> list[str]:
    return sorted(
        {
            f"{name}{{{','.join(sorted(label for label, _ in labels))}}}"
            for name, labels in scraped(url)
            if name.startswith("zstate")
        }
    )
