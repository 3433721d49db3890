"""Decoding of received samples, and subscription to the messages of one stream."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from zstate.errors import InvalidInput, MessageError
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.stream_registry import is_bulk, is_latched
from zstate.streams import StreamName
from zstate.wire.keys import ANY, shortened
from zstate.wire.messages import Message
from zstate.wire.protocol import SerializedSample, Wire


class Received(NamedTuple):
    """A decoded message, with the robot and the key that it was published on."""

    robot: str
    key: str
    message: Message


def decode_samples(
    wire: Wire,
    robot: str,
    stream: StreamName,
    samples: Iterable[SerializedSample],
    *,
    on_error: Callable[[str, str], object] | None = None,
    on_refused: Callable[[str], object] | None = None,
) -> Iterator[Received]:
    """The messages of ``samples`` of ``robot``, or of the robot of each key with ``"*"``.

    ``on_error(reason, text)`` and ``on_refused(key)`` are called for each payload that cannot be decoded.
    """
    for sample in samples:
        try:
            name = wire.robot_from_key(sample.key) if robot == ANY else robot
            for message in wire.decode(stream, sample, name):
                yield Received(name, sample.key, message)
        except (MessageError, InvalidInput) as error:
            if on_error is not None:
                reason = error.reason if isinstance(error, MessageError) else "foreign"
                on_error(reason, f"{shortened(sample.key)}: {error}")
            if on_refused is not None:
                on_refused(sample.key)


def subscribe(
    session: Session,
    wire: Wire,
    robots: str | Sequence[str],
    stream: StreamName,
    on_messages: Callable[[list[Received]], object],
    *,
    name: str = ANY,
    on_error: Callable[[str, str], object] | None = None,
    on_withdrawn: Callable[[str], object] | None = None,
    on_refused: Callable[[str], object] | None = None,
) -> StreamSubscriber | LatchedSubscriber:
    """Subscribe to ``stream`` of a robot, of several, or of all robots with ``"*"``: with the same threads.

    ``name`` selects one writer of a stream whose writers have names.

    ``on_messages`` is called from one thread of the subscription with the messages of each batch, oldest
    first; ``on_error(reason, text)`` and ``on_refused(key)`` for each payload that cannot be decoded, the
    latter after the messages before it; ``on_withdrawn(key)`` if a latched value is withdrawn.
    """
    names = (robots,) if isinstance(robots, str) else robots
    robot = names[0] if len(names) == 1 else ANY

    def on_samples(samples: Sequence[SerializedSample]) -> None:
        messages: list[Received] = []

        def deliver() -> None:
            if messages:
                on_messages(messages.copy())
                messages.clear()

        def refuse(key: str) -> None:
            if on_refused is not None:
                deliver()
                on_refused(key)

        for message in decode_samples(wire, robot, stream, samples, on_error=on_error, on_refused=refuse):
            messages.append(message)  # noqa: PERF402  # refuse empties the list meanwhile
        deliver()

    def on_value(sample: SerializedSample) -> None:
        # ROS cannot withdraw values: an empty payload there is a broken message.
        if sample.payload or wire.shared:
            on_samples((sample,))
        elif on_withdrawn is not None:
            on_withdrawn(sample.key)

    keys = [wire.expression(one, stream, name) for one in names]
    if is_latched(stream):
        return LatchedSubscriber(session, keys, on_value)
    return StreamSubscriber(session, keys, on_samples, is_bulk=is_bulk(stream))
