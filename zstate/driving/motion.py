"""A motion of a driver, as its commander sees it: progress, and how it has ended."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.fork_safe import fork_safe
from zstate.checks import real_numbers
from zstate.driving.errors import MotionTimeout
from zstate.driving.messages import DriverState, OutcomeName
from zstate.errors import InvalidInput
from zstate.net.queryable import check_timeout
from zstate.wire.messages import to_block

Points = Mapping[str, Sequence[float] | ArrayLike]
"""Numbers by joint, one for each time."""


class Outcome(NamedTuple):
    """How a motion has ended, and why.

    ``name`` is "reached"; "aborted" if joints left the path, missed the goal, or the renewals did not arrive;
    "replaced" by a later motion or command; "cancelled"; or "stopped", with the program in ``reason``.
    """

    name: OutcomeName
    reason: str = ""


class Motion:
    """A motion that the driver of ``robot`` has accepted. ``Commander.move`` makes it.

    ``identity`` is the session of the commander and the number of the motion, ``host_session`` that of the
    driver host. ``cancel()`` ends the motion there. Safe from any thread.
    """

    def __init__(
        self, robot: str, identity: tuple[int, int], host_session: int, cancel: Callable[[], None]
    ) -> None:
        self.robot = robot
        self._identity = identity
        self._host_session = host_session
        self._cancel = cancel
        self._progress = 0.0
        self._outcome: Outcome | None = None
        self._has_ended = fork_safe(threading.Event())
        self.is_cancelled = False
        """Whether ``cancel`` was called: the motion is not renewed any more."""

    def __repr__(self) -> str:
        state = f"{self._progress:.0%}" if self._outcome is None else self._outcome.name
        return f"<Motion of {self.robot!r}: {state}>"

    @property
    def progress(self) -> float:
        """The part of its duration that has passed, 0 to 1, by the newest state of the driver."""
        return self._progress

    @property
    def outcome(self) -> Outcome | None:
        """How it has ended; None while it is under way."""
        return self._outcome

    def wait(self, timeout_s: float) -> Outcome:
        """How the motion has ended, once it has. Raises MotionTimeout after ``timeout_s`` [s].

        The motion goes on then.
        """
        self._has_ended.wait(check_timeout(timeout_s))
        if self._outcome is None:
            raise MotionTimeout(
                f"the motion of {self.robot!r} has not ended within {timeout_s:g} s; its driver reported "
                f"{self._progress:.0%} of it last",
                progress=self._progress,
            )
        return self._outcome

    def cancel(self) -> None:
        """Brake the joints of the motion; its outcome is "cancelled". Does nothing once it has ended.

        Raises Unreachable if the driver has not confirmed it within 5 s. The motion is not renewed any more
        in any case, so that it ends as "aborted" after the driver's ttl.
        """
        if self._outcome is None:
            self.is_cancelled = True
            self._cancel()

    def update(self, state: DriverState) -> None:
        """Take progress and outcome from a state of the driver."""
        if state.session != self._host_session:
            self.abort("the driver's host has restarted")
        elif state.motion == self._identity:
            self._progress = state.progress
        for ended in state.outcomes:
            if (ended.session, ended.seq) == self._identity:
                self._progress = 1.0 if ended.name == "reached" else self._progress
                self._end(Outcome(ended.name, ended.reason))

    def abort(self, reason: str) -> None:
        """End this motion, about which the driver reports nothing any more."""
        self._end(Outcome("aborted", reason))

    def _end(self, outcome: Outcome) -> None:
        if self._outcome is None:
            self._outcome = outcome
            self._has_ended.set()


def check_by_joint(values: object, what: str) -> None:
    """Raise InvalidInput unless ``values`` are by joint."""
    if not isinstance(values, Mapping):
        raise InvalidInput(
            f"{what} are given by joint, such as {{'elbow': 0.4}}, not as {type(values).__name__}: that "
            "does not name the joints"
        )


def rows_block(numbers: Points, names: Sequence[str], times: ArrayLike, what: str) -> bytes:
    """The block of ``numbers``, (T, n) in the order of ``names``. Raises InvalidInput for other ones."""
    check_by_joint(numbers, what)
    if not names or set(numbers) != set(names):
        raise InvalidInput(
            f"{what} are of {', '.join(map(repr, numbers)) or 'no joints'}; a motion has one list for each "
            f"joint of its points: {', '.join(map(repr, names)) or 'at least one'}"
        )
    columns = [real_numbers(numbers[name], f"{what} of {name!r}") for name in names]
    count = np.shape(times)
    wrong = [
        f"{name!r} has shape {column.shape}"
        if column.ndim
        else f"{name!r} is one number, not a list: [{column}]"
        for name, column in zip(names, columns, strict=True)
        if column.shape != count
    ]
    if wrong:
        raise InvalidInput(
            f"{what} have a number for each of the {math.prod(count)} times; {', '.join(wrong)}"
        )
    return to_block(np.stack(columns, axis=1))
