"""RosImageListener: raw pictures of a ROS 2 topic, to be encoded and published."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate._util.inbox import Inbox
from zstate._util.refusals import Refusals
from zstate.cameras.ros2 import decode_raw_image
from zstate.errors import InvalidInput, MessageError
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import check_robot, shortened
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import ros_options
from zstate.wire.ros2.options import check_token
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import IMAGE


@dataclass(frozen=True, eq=False)
class RosImage:
    """A raw picture: stamp [ns], frame as the robot calls it, and uint8 RGB (H, W, 3) or gray (H, W)."""

    stamp: int
    frame: str
    pixels: NDArray[np.uint8]


class RosImageListener(Closeable):
    """Receives the sensor_msgs/Image of ``topic``, such as "/wrist/image_raw". The newest wins.

    ``for image in listener`` and ``async for image in listener`` return RosImages, without those that a newer
    one has replaced unread, and end with ``close()``. Publish them as the pictures of ``robot``::

        for image in listener:
            publisher.publish(image.pixels, image.stamp)

    Encodings are rgb8, bgr8, rgba8, bgra8 and mono8. ``refused`` counts others, and broken messages, by
    reason; the first of each is logged. ``wire`` is "ros2", with options after a colon. A context manager.

    Raises InvalidInput for a name that is no topic, and for other wires.
    """

    def __init__(self, session: Session, robot: str, topic: str, *, wire: str = "ros2") -> None:
        kind, _, text = wire.partition(":")
        if kind != "ros2":
            raise InvalidInput(f"raw pictures are read on the wire 'ros2', not {wire!r}")
        if not topic.startswith("/"):
            raise InvalidInput(f"a topic begins with a slash, as '/wrist/image_raw' does; got {topic!r}")
        for token in topic[1:].split("/"):
            check_token("topic", token, "")
        self.topic = topic
        options = ros_options(text)
        self._names = FrameNames(options, check_robot(robot))
        self._refusals = Refusals("picture")
        self.refused: dict[str, int] = self._refusals.counts
        self._unread: Inbox[RosImage] = Inbox(1, session.check)
        key = f"{options.domain}{topic}/{IMAGE.dds}/*"
        self._subscriber = StreamSubscriber(session, key, self._on_samples, is_bulk=True)

    def __repr__(self) -> str:
        return f"<RosImageListener of {self.topic!r}>"

    def _on_samples(self, samples: list[SerializedSample]) -> None:
        for sample in samples:
            if sample.size:
                self._refusals.count("too large", f"{shortened(sample.key)}: {sample.size} bytes")
                continue
            try:
                self._unread.add([RosImage(*decode_raw_image(sample.payload, self._names))])
            except MessageError as error:
                self._refusals.count(error.reason, f"{shortened(sample.key)}: {error}")

    def __iter__(self) -> Iterator[RosImage]:
        return iter(self._unread)

    def __aiter__(self) -> AsyncIterator[RosImage]:
        return aiter(self._unread)

    def close(self) -> None:
        """Stop listening; iterations end. A second call does nothing."""
        self._subscriber.close()
        self._unread.close()
