"""Consistency of sources: the normalised innovation squared (NIS) with its chi-square band, and sentences.

The NIS of a reading of m numbers follows the chi-square distribution with m degrees of freedom if noise and
estimate are as their covariances state; the sum over n readings has n m (Bar-Shalom, Li, Kirubarajan,
"Estimation with applications to tracking and navigation", 2001, 5.4.2).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from statistics import NormalDist
from typing import Literal, NamedTuple

from zstate._util.format import format_duration
from zstate.errors import InvalidInput

GATE_PROBABILITY = 0.999
BAND_PROBABILITY = 0.95

WINDOW = 200
"""Readings of each source whose NIS is averaged."""

_LEAST_READINGS = 10
"""Fewer are not evidence on sigmas."""

_SMALL_FACTOR, _LARGE_FACTOR = 1.5, 4.0
"""Sigmas are called too small, or too large, from this factor on. Real noise is not white: the mean of many
readings is often outside its band."""

_REJECTED_PART = 0.1

_LONGEST_HISTORY_NS = 10_000_000_000
"""Readings that are later than that are of another clock: a longer history is no remedy."""

Fate = Literal["accepted", "rejected", "reacquired"]


class Outcome(NamedTuple):
    """What the filter did with a reading of ``dimension`` numbers, and its NIS, NaN of none.

    ``failure`` is why a rejected reading could not be used at all; its NIS is NaN then.
    """

    fate: Fate
    nis: float
    dimension: int
    failure: str = ""


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """The state of one source, by its ``name``.

    ``rate_hz`` is that of the newest readings, ``age_s`` how much older than the newest data of all sources
    its newest one is. ``nis_mean`` is the mean NIS of the last readings of ``dimension`` numbers, NaN without
    any (an IMU has none), and ``nis_band`` has 95 % of such means, if the sigmas are right. ``accepted``,
    ``rejected``, ``too_late`` and ``reacquired`` count readings. ``sentence`` is what is wrong and what to
    do; empty if nothing.
    """

    name: str
    rate_hz: float
    age_s: float
    nis_mean: float
    nis_band: tuple[float, float]
    dimension: int
    accepted: int
    rejected: int
    too_late: int
    reacquired: int
    sentence: str


@dataclass(slots=True)
class SourceRecord:
    """What is kept of one source. ``has_bounds``: its sigmas are bounds, as of slip, and may be too large."""

    has_bounds: bool = False
    stamps: deque[int] = field(default_factory=lambda: deque(maxlen=WINDOW))
    """In the order of arrival."""
    outcomes: deque[Outcome] = field(default_factory=lambda: deque(maxlen=WINDOW))
    """Outcomes of readings that are too old to be replayed; oldest first."""
    fates: Counter[Fate] = field(default_factory=Counter[Fate])
    """Counts of all of these readings."""
    too_late: int = 0
    late_ns: int = 0
    """How much too old the newest of these was, against the newest reading of all sources."""
    ahead: int = 0
    ahead_ns: int = 0
    """Readings that were refused because they are of the future, and by how much the newest of them was."""

    def keep(self, outcome: Outcome) -> None:
        """Count an outcome that is final."""
        self.outcomes.append(outcome)
        self.fates[outcome.fate] += 1

    def health(
        self,
        name: str,
        newest: int,
        recent: Iterable[Outcome],
        remark: str,
        *,
        history_s: float,
        leader: str = "",
    ) -> SourceHealth:
        """The health with the outcomes of ``recent`` readings, which may still be replayed.

        ``newest`` is the newest stamp of all sources [ns], and ``leader`` the source that has it. ``remark``
        is a sentence that the fusion has of it.
        """
        recent = list(recent)
        fates = self.fates + Counter(outcome.fate for outcome in recent)
        newest_outcomes = [*self.outcomes, *recent][-WINDOW:]
        failures = [outcome.failure for outcome in newest_outcomes if outcome.failure]
        # Wheels that bridged a pause are of dimension 0: they measure nothing.
        window = [outcome for outcome in newest_outcomes if outcome.dimension and not outcome.failure]
        dimension = window[-1].dimension if window else 0
        window = [outcome for outcome in window if outcome.dimension == dimension]
        mean = sum(outcome.nis for outcome in window) / len(window) if window else math.nan
        band = nis_band(dimension, len(window)) if window else (math.nan, math.nan)
        age_s = (newest - max(self.stamps)) * 1e-9 if self.stamps else math.inf
        sentences = [
            remark,
            _failure_text(failures, len(newest_outcomes)),
            _rejection_text(window),
            self._nis_text(mean, dimension, window),
            self._late_text(history_s, leader),
            self._ahead_text(),
        ]
        found = [text for text in sentences if text]
        return SourceHealth(
            name,
            self._rate(),
            age_s,
            mean,
            band,
            dimension,
            fates["accepted"] + fates["reacquired"],
            fates["rejected"],
            self.too_late,
            fates["reacquired"],
            f"{name}: {'; '.join(found)}" if found else "",
        )

    def _rate(self) -> float:
        span = max(self.stamps) - min(self.stamps) if self.stamps else 0
        return (len(self.stamps) - 1) / (span * 1e-9) if span else 0.0

    def _nis_text(self, mean: float, dimension: int, window: list[Outcome]) -> str:
        if len(window) < _LEAST_READINGS:
            return ""
        low, high = nis_band(dimension, 1)
        factor = math.sqrt(mean / dimension)
        numbers = f"{dimension} number{'s' * (dimension != 1)}"
        fact = f"NIS {mean:.1f} for {numbers}, expected {low:.1f} to {high:.1f}"
        if factor >= _SMALL_FACTOR:
            return f"{fact}: its sigmas are about {factor:.2g} times too small"
        if factor <= 1.0 / _LARGE_FACTOR and not self.has_bounds:
            size = f"about {1.0 / factor:.2g}" if factor > 0.0 else "far more than 10"
            return f"{fact}: its sigmas are {size} times too large"
        return ""

    def _late_text(self, history_s: float, leader: str) -> str:
        if not self.too_late:
            return ""
        count = f"{self.too_late} reading{'s' * (self.too_late != 1)}"
        if self.late_ns <= _LONGEST_HISTORY_NS:
            age = format_duration(round(history_s * 1e9))
            return f"{count} came too late, more than {age} after the newest: raise history_s"
        return (
            f"{count} came too late, the last one stamped {format_duration(self.late_ns)} before the newest "
            f"of {leader!r}: one of the two clocks is wrong, or it was sent again"
        )

    def _ahead_text(self) -> str:
        if not self.ahead:
            return ""
        return (
            f"{self.ahead} reading{'s' * (self.ahead != 1)} of the future refused, the last one stamped "
            f"{format_duration(self.ahead_ns)} after the newest of the others: its clock is ahead; "
            "synchronise the clocks (NTP, PTP), or stamp all on one machine"
        )


def _failure_text(failures: list[str], count: int) -> str:
    if not failures:
        return ""
    return f"{len(failures)} of its last {count} readings could not be used: {failures[-1]}"


def _rejection_text(window: list[Outcome]) -> str:
    rejected = sum(outcome.fate == "rejected" for outcome in window)
    if rejected <= _REJECTED_PART * len(window):
        return ""
    return f"{rejected} of its last {len(window)} readings were rejected, which contradict the other sources"


def gate(dimension: int, probability: float = GATE_PROBABILITY) -> float:
    """The NIS that such a part of the readings of ``dimension`` numbers does not exceed."""
    return chi_square_quantile(probability, dimension)


def check_gate(probability: float) -> float:
    """The same number. Raises InvalidInput unless it is above 0.5 and below 1."""
    if not 0.5 < probability < 1.0:
        raise InvalidInput(
            "the gate of a source is the part of its readings that pass if its sigmas are right, above 0.5 "
            f"and below 1, as 0.999; got {probability!r}"
        )
    return probability


def nis_band(dimension: int, count: int) -> tuple[float, float]:
    """The central interval of 95 % for the mean NIS of ``count`` readings of ``dimension`` numbers."""
    tail = 0.5 * (1.0 - BAND_PROBABILITY)
    degrees = dimension * count
    low, high = (chi_square_quantile(p, degrees) / count for p in (tail, 1.0 - tail))
    return low, high


@lru_cache(maxsize=4096)
def chi_square_quantile(probability: float, degrees: int) -> float:
    """The value that a chi-square variable of so many degrees does not exceed with ``probability``.

    Wilson and Hilferty's approximation ("The distribution of chi-square", PNAS 17 (1931)), then Newton's
    iteration on the distribution.
    """
    spread = 2.0 / (9.0 * degrees)
    x = degrees * max(1e-3, 1.0 - spread + NormalDist().inv_cdf(probability) * math.sqrt(spread)) ** 3
    half = 0.5 * degrees
    for _ in range(50):
        density = 0.5 * math.exp((half - 1.0) * math.log(0.5 * x) - 0.5 * x - math.lgamma(half))
        step = (_lower_gamma(half, 0.5 * x) - probability) / density
        x = max(0.5 * x, x - step)
        if abs(step) <= 1e-12 * x:
            break
    return x


def _lower_gamma(a: float, x: float) -> float:
    """The regularised lower incomplete gamma function P(a, x), the distribution of chi-square at 2 x.

    Series below a + 1, else Lentz's continued fraction (Press et al., "Numerical Recipes", 3rd ed., 6.2).
    """
    scale = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        n = a
        while term > 1e-17 * total:
            n += 1.0
            term *= x / n
            total += term
        return total * scale
    b = x + 1.0 - a
    c, d = math.inf, 1.0 / b
    fraction = d
    for n in range(1, 100_000):
        factor = -n * (n - a)
        b += 2.0
        d = 1.0 / (factor * d + b)
        c = b + factor / c
        fraction *= c * d
        if abs(c * d - 1.0) < 1e-16 * 4:
            break
    return 1.0 - scale * fraction
