"""The package of somebody else in tests/plugins/battery, as if it were installed here for some time."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from zstate import other_plugins, stream_registry
from zstate.streams import Stream
from zstate.wire import native

BATTERY_FOLDER = Path(__file__).parents[1] / "plugins" / "battery"


@contextmanager
def battery_installed() -> Iterator[Stream]:
    """The row of the stream ``battery``, which this process finds within the context."""
    with pytest.MonkeyPatch.context() as installed:
        installed.setattr(sys, "path", [str(BATTERY_FOLDER), *sys.path])
        forget_plugins()
        try:
            yield stream_registry.stream_named("battery")
        finally:
            forget_plugins()


def forget_plugins() -> None:
    """Forget the plugins that were found, as in a new process."""
    other_plugins.found_plugins.cache_clear()
    stream_registry._REGISTRY.forget()
    for cached in (
        stream_registry.edge_streams,
        stream_registry.latched_streams,
        stream_registry.measured_streams,
    ):
        cached.cache_clear()
    native.encoding_of.cache_clear()
