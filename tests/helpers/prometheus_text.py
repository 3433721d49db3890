"""Scrapes of metrics, read by Prometheus' own parser."""

from __future__ import annotations

from urllib.request import urlopen

import pytest

pytest.importorskip("prometheus_client", reason="pip install 'zstate[metrics]'")

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

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


def collected(collector: Collector) -> dict[Row, float]:
    """The rows of a collector, without a network."""
    registry = CollectorRegistry()
    registry.register(collector)
    return parsed(generate_latest(registry).decode())
