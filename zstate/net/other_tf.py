"""Subscription to /tf besides joint states, on the ROS wires."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from zstate._util.closeable import Closeable
from zstate.streams import StreamName
from zstate.wire.identity import Announcement


class OtherTfSubscription(Closeable):
    """A listener's subscription to /tf besides joint states, while others than state publishers write it.

    A state publisher writes there what its model and the joint states contain; zstate's own does not even
    compute it without a subscriber.
    """

    def __init__(self, subscribe: Callable[[], Closeable]) -> None:
        self._subscribe = subscribe
        self._writers: set[Announcement] = set()
        self._subscription: Closeable | None = None

    def on_writer(self, announced: Announcement, *, alive: bool) -> None:
        """Subscribe or unsubscribe, if this writer makes a difference."""
        (self._writers.add if alive else self._writers.discard)(announced)
        streams: dict[str, set[StreamName]] = {}
        for one in self._writers:
            streams.setdefault(one.node, set()).add(one.stream)
        if not any(one.stream == "tf" and not _is_state_publisher(one, streams) for one in self._writers):
            self.close()
        elif self._subscription is None:
            self._subscription = self._subscribe()

    def close(self) -> None:
        """Unsubscribe."""
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            subscription.close()


def _is_state_publisher(announced: Announcement, streams: Mapping[str, Collection[StreamName]]) -> bool:
    """Whether it is of a node with the model that writes joint states, or is named robot_state_publisher.

    ``streams`` are those of each node; the nodes behind a zenoh-plugin-ros2dds bridge are not known.
    """
    written = streams[announced.node]
    is_named_so = announced.writer.program.endswith("/robot_state_publisher")
    return (
        bool(announced.node) and "robot_description" in written and ("joint_states" in written or is_named_so)
    )
