"""A client of the page that sends what a test tells it to."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from websockets.sync.connection import Connection

    from zstate.view.server import ViewServer

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 10.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0.0, 0.0, 1.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class Browser:
    """A connection; its first message is its camera, as the page's is."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.send(CAMERA)

    def send(self, message: object) -> None:
        self._connection.send(msgspec.msgpack.encode(message))

    def update(self, widget: Any, **updates: object) -> None:
        self.send({"type": "GuiUpdateMessage", "uuid": widget._impl.uuid, "updates": updates})


@contextmanager
def browser(page: ViewServer) -> Generator[Browser]:
    """A connection to ``page``, closed at the end."""
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    address = f"ws://127.0.0.1:{page.port}"
    protocol = [Subprotocol(f"viser-v{viser.__version__}")]
    with connect(address, subprotocols=protocol, compression=None, max_queue=None) as connection:
        yield Browser(connection)
