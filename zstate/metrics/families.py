"""Families: metrics under way to a scrape, row by row."""

from __future__ import annotations

from collections.abc import Iterator

from zstate.metrics.histogram import Histogram
from zstate.metrics.library import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

MOST_ROBOTS = 500
"""Names come from the network: so many robots have rows of their own, by name; more are only counted."""


class Families:
    """Rows of metrics, put together by name. Rows of one name and the same labels add up."""

    def __init__(self) -> None:
        self._rows: dict[tuple[str, str, str], dict[tuple[tuple[str, str], ...], float]] = {}
        self._histograms: dict[tuple[str, str], dict[tuple[tuple[str, str], ...], Histogram]] = {}

    def count(self, name: str, text: str, value: float, **labels: str) -> None:
        """A counter, which only grows; ``_total`` is added to its name."""
        self._add("counter", name, text, value, labels)

    def gauge(self, name: str, text: str, value: float, **labels: str) -> None:
        """A value that goes up and down."""
        self._add("gauge", name, text, value, labels)

    def histogram(self, name: str, text: str, histogram: Histogram, **labels: str) -> None:
        """How often each size was seen."""
        self._histograms.setdefault((name, text), {})[tuple(labels.items())] = histogram

    def _add(self, kind: str, name: str, text: str, value: float, labels: dict[str, str]) -> None:
        rows = self._rows.setdefault((kind, name, text), {})
        row = tuple(labels.items())
        rows[row] = rows.get(row, 0.0) + value

    def __iter__(self) -> Iterator[Metric]:
        for (kind, name, text), rows in self._rows.items():
            named = [label for label, _ in next(iter(rows))]
            make = CounterMetricFamily if kind == "counter" else GaugeMetricFamily
            family = make(name, text, labels=named)
            for row, value in rows.items():
                family.add_metric([label for _, label in row], value)
            yield family
        for (name, text), histograms in self._histograms.items():
            family = HistogramMetricFamily(name, text, labels=[label for label, _ in next(iter(histograms))])
            for row, histogram in histograms.items():
                buckets, total = histogram.read()
                family.add_metric([label for _, label in row], buckets, total)
            yield family
