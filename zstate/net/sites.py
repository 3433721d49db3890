"""Sites: routers that thin what leaves on their uplink, and announce it.

A thinned stream has gaps in its sequence numbers that are no losses; tools distinguish the two by the tokens
of sites.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote, unquote

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import InvalidInput
from zstate.net.presence import CAPACITY, announce, confirmed_tokens
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.net.streams import Receiver
from zstate.stream_registry import find_stream
from zstate.streams import StreamName
from zstate.wire.keys import Chunk, Key, check_robot, shortened

if TYPE_CHECKING:
    from zstate.net.topic_statistics import Window

_TOKEN_LENGTH = 4000
"""The length of the names in one token. Keys may be longer, but each router keeps them."""

UPLINK_OF = "uplink of "
"""What the names of the rules of an uplink begin with, before that of the site."""

_MOST = 1.25
"""The largest ratio of a measured to the thinned rate."""

_NO_RATE = "none"


def _write_rates(rates_hz: Mapping[StreamName, float]) -> str:
    return ",".join(f"{stream}={rate_hz!r}" for stream, rate_hz in rates_hz.items()) or _NO_RATE


def _read_rates(chunk: str) -> dict[StreamName, float]:
    pairs = [] if chunk == _NO_RATE else [pair.partition("=") for pair in chunk.split(",")]
    try:
        rates_hz = {stream: float(rate) for stream, _, rate in pairs}
    except ValueError:
        rates_hz = {"": 0.0}
    if not all(stream.isidentifier() and 0.0 < rate < math.inf for stream, rate in rates_hz.items()):
        raise InvalidInput(f"{shortened(chunk)!r} is not a list of rates such as 'joint_states=5.0,imu=1.0'")
    return rates_hz


def _write_robots(robots: Sequence[str]) -> str:
    return ",".join(quote(robot, safe="") for robot in robots)


def _read_robots(chunk: str) -> tuple[str, ...]:
    return tuple(check_robot(unquote(name)) for name in chunk.split(","))


def _check_site(name: str) -> str:
    return check_robot(name, "site")


SITE_TOKEN = Key[str, Mapping[StreamName, float], Sequence[str]](
    "zstate/@site/<site>/<rates>/<robots>",
    site=Chunk(_check_site, _check_site),
    rates=Chunk(_write_rates, _read_rates),
    robots=Chunk(_write_robots, _read_robots),
)
"""The liveliness token of the router of a site, which thins what leaves on its uplink.

Of each of the robots, these streams pass at these rates [Hz], and no other samples. A site with many robots
has several tokens.
"""


class Thinning(NamedTuple):
    """What the router of ``site`` lets pass of one stream of one robot: ``rate_hz``; nothing if it is 0."""

    site: str
    rate_hz: float

    def explains(self, window: Window | None) -> bool:
        """Whether the site makes the gaps in these samples: within it more of them arrive.

        By their stamps: a link that stalls passes them on in a burst.
        """
        rate_hz = None if window is None else window.stamped_hz
        return rate_hz is not None and rate_hz <= _MOST * self.rate_hz

    def __str__(self) -> str:
        how = f"thinned to {self.rate_hz:g} Hz" if self.rate_hz else "held back"
        return f"{how} on purpose by site {self.site!r}"


class Sites(NamedTuple):
    """The announced sites: the rates of streams [Hz] and the robots of each, by its name."""

    rates_hz: Mapping[str, Mapping[StreamName, float]]
    robots: Mapping[str, frozenset[str]]

    def site_of(self, robot: str) -> str | None:
        """The site that ``robot`` is behind; None if no site announces it."""
        return next((site for site, robots in self.robots.items() if robot in robots), None)

    def text_of(self, robot: str) -> str:
        """The site of ``robot``, and what leaves it; empty if no site announces the robot."""
        site = self.site_of(robot)
        if site is None:
            return ""
        leaving = [f"{stream} at {rate_hz:g} Hz" for stream, rate_hz in self.rates_hz[site].items()]
        return f"{site!r}, from which {' and '.join(leaving) or 'no sample'} leave"

    def thinning(self, robot: str, stream: StreamName) -> Thinning | None:
        """How ``stream`` of ``robot`` is thinned; None without a site, or without samples."""
        site, row = self.site_of(robot), find_stream(stream)
        if site is None or row is None or not row.is_sampled:
            return None
        return Thinning(site, self.rates_hz[site].get(stream, 0.0))

    def periods_s(self, stream: StreamName) -> dict[str, float]:
        """The periods at which samples of ``stream`` pass, by robot; without those of which none pass."""
        return {
            robot: 1.0 / rate_hz
            for site, robots in self.robots.items()
            if (rate_hz := self.rates_hz[site].get(stream))
            for robot in robots
        }


NO_SITES = Sites({}, {})


class SiteAnnouncement(Closeable):
    """Announces the site ``name`` with its ``robots`` and the rates at which streams pass, until closed."""

    def __init__(
        self, session: Session, name: str, rates_hz: Mapping[StreamName, float], robots: Sequence[str]
    ) -> None:
        passing = {stream: rate_hz for stream, rate_hz in rates_hz.items() if rate_hz}
        with ExitStack() as opening:
            for group in _groups(robots):
                opening.enter_context(announce(session, SITE_TOKEN.key(name, passing, group)))
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Withdraw it. A second call does nothing."""
        self._opened.close()


def _groups(robots: Sequence[str]) -> Iterator[list[str]]:
    """``robots``, as many together as fit into one token."""
    group: list[str] = []
    for robot in robots:
        if group and sum(map(len, group)) + len(group) + len(robot) > _TOKEN_LENGTH:
            yield group
            group = []
        group.append(robot)
    if group:
        yield group


def discover_sites(session: Session) -> Sites:
    """The sites that are announced now. Takes a few milliseconds, and up to a second on a slow link."""
    return sites_from_tokens(confirmed_tokens(session, SITE_TOKEN.expression()))


def sites_from_tokens(tokens: Iterable[str]) -> Sites:
    """The sites in liveliness ``tokens``; others are left out."""
    rates_hz: dict[str, dict[StreamName, float]] = {}
    robots: dict[str, frozenset[str]] = {}
    for token in sorted(tokens):
        with suppress(InvalidInput):
            site, rates, names = SITE_TOKEN.parse(token)
            rates_hz.setdefault(site, {}).update(rates)
            robots[site] = robots.get(site, frozenset()) | frozenset(names)
    return Sites(rates_hz, robots)


class SiteWatch(Receiver):
    """Calls ``on_change(sites)`` in ``thread`` with the announced sites, now and after each change."""

    def __init__(self, session: Session, thread: ServiceThread, on_change: Callable[[Sites], object]) -> None:
        self._tokens: set[str] = set()
        self._on_change = on_change
        declare = partial(session.zenoh.liveliness().declare_subscriber, history=True)
        super().__init__(session, [SITE_TOKEN.expression()], declare, CAPACITY, thread=thread)

    def _on_batch(self, batch: list[zenoh.Sample]) -> None:
        for sample in batch:
            is_put = sample.kind == zenoh.SampleKind.PUT
            (self._tokens.add if is_put else self._tokens.discard)(str(sample.key_expr))
        self._on_change(sites_from_tokens(self._tokens))
