"""Memories that do not grow with what strangers say."""

from __future__ import annotations

from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")

MOST = 4096


def remember(known: dict[K, V], key: K, value: V) -> None:
    """Put it last into ``known``, which forgets what was put there first when it holds more than 4096."""
    known.pop(key, None)
    known[key] = value
    while len(known) > MOST:
        del known[next(iter(known))]
