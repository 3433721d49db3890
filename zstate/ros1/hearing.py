"""Hearing: all that is said about one robot, message by message."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import Protocol

from zstate._util.refusals import Refusals
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.wire.messages import JointState, RobotDescription, StaticTransforms
from zstate.wire.native import NativeWire


class Hearer(Protocol):
    """Who hears it. What it raises, InvalidInput or MessageError, is counted."""

    def describe(self, description: RobotDescription) -> None:
        """What the robot is."""
        ...

    def place(self, writer: str, statics: StaticTransforms | None) -> None:
        """All static edges of ``writer``; None when it takes them back."""
        ...

    def move(self, state: JointState) -> None:
        """Where its joints are."""
        ...


class Hearing(Closing):
    """Calls ``hearer`` with the messages of ``robot``, each stream on a thread of its own."""

    def __init__(self, session: Session, robot: str, hearer: Hearer, refusals: Refusals) -> None:
        self._hearer = hearer
        self._refusals = refusals
        self._wire = wire = NativeWire()
        with ExitStack() as opening:
            for stream in ("robot_description", "tf_static", "joint_states"):
                on_withdrawn = self._on_withdrawn if stream == "tf_static" else None
                opening.enter_context(
                    subscribe(
                        session,
                        wire,
                        robot,
                        stream,
                        self._on_messages,
                        on_error=refusals.count,
                        on_withdrawn=on_withdrawn,
                    )
                )
            self._opened = opening.pop_all()

    def _on_messages(self, received: list[Received]) -> None:
        for _, key, message in received:
            try:
                if isinstance(message, JointState):
                    self._hearer.move(message)
                elif isinstance(message, StaticTransforms):
                    self._hearer.place(self._wire.statics_writer(key), message)
                elif isinstance(message, RobotDescription):
                    self._hearer.describe(message)
            except (MessageError, InvalidInput) as error:  # noqa: PERF203 - the other messages may be good
                reason = error.reason if isinstance(error, MessageError) else "bad numbers"
                self._refusals.count(reason, f"{key}: {error}")

    def _on_withdrawn(self, key: str) -> None:
        with suppress(InvalidInput):  # a key without a writer's name
            self._hearer.place(self._wire.statics_writer(key), None)

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._opened.close()
