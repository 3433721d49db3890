"""Subscription to the decoded messages of one stream."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from zstate.errors import InvalidInput, MessageError
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import ANY, Stream, shortened
from zstate.wire.messages import Message
from zstate.wire.protocol import SerializedSample, Wire

_LATCHED: frozenset[Stream] = frozenset({"robot_description", "tf_static"})


class Received(NamedTuple):
    """A decoded message, with the robot and the key that it was published on."""

    robot: str
    key: str
    message: Message


def subscribe(
    session: Session,
    wire: Wire,
    robot: str,
    stream: Stream,
    on_messages: Callable[[list[Received]], object],
    *,
    on_error: Callable[[str, str], object] | None = None,
    on_withdrawn: Callable[[str], object] | None = None,
) -> StreamSubscriber | LatchedSubscriber:
    """Subscribe to ``stream`` of ``robot``, or of all robots with ``"*"``.

    ``on_messages`` is called from one thread of the subscription with the messages of each batch, oldest
    first; ``on_error(reason, text)`` for each payload that cannot be decoded; ``on_withdrawn(key)`` if a
    latched value is withdrawn.
    """
    is_latched = stream in _LATCHED

    def decode(samples: Iterable[SerializedSample]) -> Iterator[Received]:
        for sample in samples:
            # ROS cannot withdraw values: an empty payload there is a broken message.
            if is_latched and not sample.payload and not wire.shared:
                if on_withdrawn is not None:
                    on_withdrawn(sample.key)
                continue
            try:
                name = wire.robot_from_key(sample.key) if robot == ANY else robot
                for message in wire.decode(stream, sample, name):
                    yield Received(name, sample.key, message)
            except (MessageError, InvalidInput) as error:
                if on_error is not None:
                    reason = error.reason if isinstance(error, MessageError) else "foreign"
                    on_error(reason, f"{shortened(sample.key)}: {error}")

    def on_samples(samples: Iterable[SerializedSample]) -> None:
        if messages := list(decode(samples)):
            on_messages(messages)

    key = wire.expression(robot, stream)
    if is_latched:
        return LatchedSubscriber(session, key, lambda sample: on_samples((sample,)))
    return StreamSubscriber(session, key, on_samples)
