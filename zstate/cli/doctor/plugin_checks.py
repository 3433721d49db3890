"""The checks of plugins: what they collect while doctor does, and what they say of each robot."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol, TypeVar

from zstate._util.closeable import Closeable
from zstate._util.lazy_names import loaded
from zstate.cli.doctor.check import Check, warning
from zstate.errors import printable
from zstate.net.discovery import RobotInfo
from zstate.net.session import Session
from zstate.other_plugins import found_plugins
from zstate.plugins import built_in_plugins
from zstate.streams import StreamName
from zstate.wire.identity import WriterId

T = TypeVar("T")


class ProbedRobot(Protocol):
    """What a plugin may ask of a robot, of which doctor has collected the samples of a second or more."""

    info: RobotInfo
    """Its name, and its announced writers."""
    argument: str
    """The robot in the commands of findings, after a space; empty if the wire is that of one robot."""

    def writers(self, stream: StreamName) -> list[WriterId]:
        """The announced writers of ``stream``, the newest last."""
        ...

    def newest(self, stream: StreamName) -> dict[str, Any]:
        """The newest message of each announced writer of ``stream``, by the writer's name."""
        ...


class PluginChecks(Closeable):
    """What one plugin checks of ``robots``; ``Plugin.checks`` names a subclass.

    It is opened before samples are collected, on ``wire``, may subscribe to what it needs, and calls
    ``on_change()`` when something has arrived. Then it is asked for each robot. This one collects nothing.
    """

    def __init__(
        self, session: Session, robots: Sequence[RobotInfo], wire: str, on_change: Callable[[], object]
    ) -> None:
        self.session, self.robots, self.wire, self.on_change = session, robots, wire, on_change

    def is_complete(self, robot: RobotInfo) -> bool:
        """Whether all that is announced of ``robot`` has arrived; doctor waits for it a few seconds."""
        return True

    def has_data(self, robot: str) -> bool:
        """Whether anything has arrived of ``robot``."""
        return False

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        """The checks of the robot ``probe.info``."""
        yield from ()

    def close(self) -> None:
        """End what it has opened."""


class _Guarded(PluginChecks):
    """The checks of another package: an error in them is a warning, and costs no other check anything."""

    def __init__(self, distribution: str, open_checks: Callable[[], PluginChecks]) -> None:
        self._distribution, self._problem = distribution, ""
        self._checks: PluginChecks | None = None
        self._checks = self._attempted(open_checks, None)

    def is_complete(self, robot: RobotInfo) -> bool:
        checks = self._checks
        return checks is None or self._attempted(lambda: checks.is_complete(robot), True)

    def has_data(self, robot: str) -> bool:
        checks = self._checks
        return checks is not None and self._attempted(lambda: checks.has_data(robot), False)

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        checks, found = self._checks, list[Check]()
        if checks is not None:
            found = self._attempted(lambda: list(checks.checks(probe)), found)
        yield from found
        if self._problem:
            text = f"the checks of {self._distribution} have failed: {self._problem}"
            yield warning("plugins", text, "zstate plugins  # shows its version")

    def close(self) -> None:
        checks = self._checks
        if checks is not None:
            self._attempted(checks.close, None)

    def _attempted(self, call: Callable[[], T], otherwise: T) -> T:
        try:
            return call()
        except Exception as error:  # whatever another package's code does
            self._problem = self._problem or printable(f"{type(error).__name__}: {error}")
            return otherwise


@contextmanager
def opened_checks(
    session: Session, robots: Sequence[RobotInfo], wire: str, on_change: Callable[[], object]
) -> Generator[Sequence[PluginChecks]]:
    """The checks of all plugins, open."""

    def load(reference: str) -> PluginChecks:
        return loaded(reference)(session, robots, wire, on_change)

    with ExitStack() as opened:
        yield [
            *(opened.enter_context(load(one.checks)) for one in built_in_plugins() if one.checks),
            *(
                opened.enter_context(
                    _Guarded(one.distribution, lambda reference=one.plugin.checks: load(reference))
                )
                for one in found_plugins()
                if one.plugin.checks
            ),
        ]
