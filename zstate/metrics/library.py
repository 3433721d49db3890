"""What of prometheus-client is used here, or what to install."""

from __future__ import annotations

from zstate.errors import LibraryMissing

try:
    from prometheus_client import CollectorRegistry, ProcessCollector, exposition
    from prometheus_client.core import (
        CounterMetricFamily,
        GaugeMetricFamily,
        HistogramMetricFamily,
        InfoMetricFamily,
        Metric,
    )
    from prometheus_client.registry import Collector
except ImportError as error:
    raise LibraryMissing(
        f"metrics need prometheus-client, which cannot be loaded ({error}): pip install 'zstate[metrics]'"
    ) from None

__all__ = [
    "Collector",
    "CollectorRegistry",
    "CounterMetricFamily",
    "GaugeMetricFamily",
    "HistogramMetricFamily",
    "InfoMetricFamily",
    "Metric",
    "ProcessCollector",
    "exposition",
]
