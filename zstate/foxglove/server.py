"""Server of Foxglove's WebSocket protocol: channels, their messages, parameters and time.

Text frames are JSON objects with an ``op``. Binary frames begin with an opcode, and are little endian:

======  ============  =======================================================================
opcode  from server   then
======  ============  =======================================================================
1       message data  u32 subscription id of the client, u64 time [ns], payload
2       time          u64 simulated time [ns]
======  ============  =======================================================================

The protocol's names are ``foxglove.sdk.v1`` and, in older clients, ``foxglove.websocket.v1``; what is served
here is the same in both. The server of foxglove-sdk is not used: it checks neither the origin of a page nor a
token, so any page open in a browser on this host could read the robots, and a check in front of it would
leave its own port open. It also drops messages for slow clients without a count.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, NamedTuple, cast

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from zstate._util.bounded import BoundedQueue
from zstate._util.closeable import Closeable
from zstate.errors import printable
from zstate.recording.storage import ChannelType
from zstate.web_access import AccessCheck, end_openings, is_websocket, listen

PORT = 8765
SUBPROTOCOLS = (Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1"))

ORIGINS = ("https://app.foxglove.dev", "file://")
"""Foxglove in a browser, and desktop programs made with Electron; browsers send "null" for files."""

BACKLOG = 1024
"""Messages that wait for one client; the oldest are dropped beyond it. Bulk data has a queue of its own."""
BACKLOG_BYTES = 1 << 25
"""Limit of the bytes of each of the two, if that is reached first; a cloud that is larger waits alone."""

_MESSAGE = struct.Struct("<BIQ")
_TIME = struct.Struct("<BQ")
_WARNING, _ERROR = 1, 2
_WARN_PERIOD_S = 1.0
_CLOSE_TIMEOUT_S = 0.3
_JOIN_WITHIN_S = 0.9
_MAX_REQUEST_BYTES = 1 << 20
_MAX_REFUSALS = 1000
"""Different refusals that are reported, each once."""
_MAX_CLIENTS = 64
_MAX_WATCHED = 4096
"""Parameters that a client may watch; those of a robot are few."""
_MAX_NAME = 256

# websockets logs a traceback for each connection that a client opens and drops.
_SILENT = logging.getLogger("zstate.foxglove.http")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class ServedChannel(NamedTuple):
    """A topic of messages; its ``number`` is never used for another topic."""

    number: int
    topic: str
    type: ChannelType

    @property
    def advertisement(self) -> dict[str, object]:
        """The channel as clients receive it."""
        return {
            "id": self.number,
            "topic": self.topic,
            "encoding": self.type.encoding,
            "schemaName": self.type.name,
            "schemaEncoding": self.type.schema_encoding,
            "schema": self.type.definition,
        }


class ServedMessage(NamedTuple):
    """A message of the channel ``number``, received at ``stamp`` [ns].

    With a ``key`` it is latched: later subscribers receive it, until the next one of the same key. Bulk data
    (``Stream.bulk``) gives way to the others.
    """

    number: int
    payload: bytes
    stamp: int
    key: str = ""
    is_bulk: bool = False


@dataclass(frozen=True, slots=True)
class ServerStats:
    """Counts since the server opened: messages ``sent`` to clients, and ``dropped`` for slow ones."""

    clients: int
    sent: int
    dropped: int


class FoxgloveServer(Closeable):
    """Serves channels at ``host``; a context manager. All methods may be called from any thread.

    ``port`` None is the first free one from 8765 on; 0 is any. ``url`` is the address to open, with the token
    that is needed beyond loopback. Pages of ``origins`` may connect as well as those of Foxglove.
    ``on_readers()`` is called after a client has subscribed or unsubscribed, ``on_event(text)`` for clients
    that come, leave or are refused; both from the thread of the server.

    There are 64 clients at most. Each has queues of its own: a client that reads slowly loses its oldest
    messages, which are counted, and delays no other. Clouds and pictures are sent when nothing else waits,
    and are lost before states are. It always receives the newest latched message of each key. A client that
    does not answer a ping within 20 s is disconnected.

    Raises InvalidInput if ``host`` or ``port`` cannot be used.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int | None = None,
        *,
        origins: Sequence[str] = (),
        on_readers: Callable[[], object] = lambda: None,
        on_event: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._socket = listen(host, port, PORT)
        self.port: int = self._socket.getsockname()[1]
        allowed = (*ORIGINS, *origins)
        self.access = AccessCheck.at(host, self.port, origins=allowed, command="zstate foxglove")
        self.on_readers = on_readers
        self._on_event = on_event
        self._readers: Counter[int] = Counter()
        self._channels: dict[int, ServedChannel] = {}
        self._latched: dict[tuple[int, str], ServedMessage] = {}
        self._parameters: dict[str, str] = {}
        self._clients: dict[ServerConnection, _Client] = {}
        self._has_time = False
        self._session = time.time_ns()
        self._sent = self._dropped = 0
        self._refused: set[str] = set()
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="zstate foxglove", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The address to open in Foxglove."""
        return self.access.url("ws")

    @property
    def stats(self) -> ServerStats:
        """Counts so far."""
        clients = list(self._clients.values())
        return ServerStats(
            len(clients),
            self._sent + sum(client.sent for client in clients),
            self._dropped + sum(client.dropped for client in clients),
        )

    def is_read(self, number: int) -> bool:
        """Whether a client has subscribed to a channel."""
        return number in self._readers

    def advertise(self, channel: ServedChannel) -> None:
        """Add a channel."""

        def add() -> None:
            if channel.number not in self._channels:
                self._channels[channel.number] = channel
                self._broadcast({"op": "advertise", "channels": [channel.advertisement]})

        self._call(add)

    def unadvertise(self, number: int) -> None:
        """Remove a channel with its subscriptions. Its latched messages are kept for its return."""

        def remove() -> None:
            if self._channels.pop(number, None) is not None:
                self._broadcast({"op": "unadvertise", "channelIds": [number]})
                for client in self._clients.values():
                    self._end_subscription(client, number)

        self._call(remove)

    def send(self, messages: Sequence[ServedMessage]) -> None:
        """Send messages to the clients that have subscribed to their channels: bulk data last."""

        def put() -> None:
            for message in messages:
                if message.key:
                    self._latched[message.number, message.key] = message
                for client in self._clients.values():
                    if message.number in client.subscriptions:
                        client.put(message)

        if messages:
            self._call(put)

    def unlatch(self, number: int, key: str) -> None:
        """Stop sending a latched message to later subscribers."""
        self._call(lambda: self._latched.pop((number, key), None))

    def set_parameter(self, name: str, value: str | None) -> None:
        """Set a parameter, or remove it (None)."""

        def update() -> None:
            if self._parameters.get(name) == value:
                return
            if value is None:
                del self._parameters[name]
            else:
                self._parameters[name] = value
            for client in self._clients.values():
                if name in client.watched:
                    client.control(_parameter_values({name: value}))

        self._call(update)

    def set_time(self, stamp: int) -> None:
        """Broadcast the simulated time; from the first call on, it is the time of all clients."""

        def update() -> None:
            if not self._has_time:
                self._has_time = True
                self._session += 1  # clients start again with the other clock
                self._broadcast(self._server_info())
            for client in self._clients.values():
                client.put_time(stamp)

        self._call(update)

    def close(self) -> None:
        """Disconnect all clients and stop, within a second. A second call does nothing."""
        self._call(self._end.set)
        self._thread.join(_JOIN_WITHIN_S)
        self._socket.close()

    def _call(self, function: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        async with serve(
            self._handle,
            sock=self._socket,
            process_request=self._process_request,
            subprotocols=SUBPROTOCOLS,
            compression=None,
            logger=_SILENT,
            close_timeout=_CLOSE_TIMEOUT_S,
            max_size=_MAX_REQUEST_BYTES,
        ) as server:
            await self._end.wait()
            await end_openings(server)

    def _process_request(self, connection: ServerConnection, request: Request) -> Response | None:
        denied = self.access.check(request.path, request.headers)
        if denied is not None:
            # Any page can take the origin "null", in a sandboxed frame.
            is_site = denied.origin not in ("", "null")
            hint = f"; --allow-origin {denied.origin} allows it" if is_site else ""
            self._on_refusal(connection, denied.text, hint)
            return connection.respond(denied.status, denied.text + "\n")
        if not is_websocket(request.headers):
            text = f"This is no page. Open {self.access.url('ws')} in Foxglove, as a Foxglove WebSocket.\n"
            return connection.respond(HTTPStatus.UPGRADE_REQUIRED, text)
        if len(self._clients) >= _MAX_CLIENTS:
            text = f"{_MAX_CLIENTS} clients are connected, which is the limit"
            self._on_refusal(connection, text)
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, text + "\n")
        return None

    def _on_refusal(self, connection: ServerConnection, text: str, hint: str = "") -> None:
        """Report each text once."""
        if text not in self._refused and len(self._refused) < _MAX_REFUSALS:
            self._refused.add(text)
            self._on_event(printable(f"refused {_name_of(connection)}: {text}{hint}"))

    async def _handle(self, connection: ServerConnection) -> None:
        client = self._clients[connection] = _Client(connection)
        name = _name_of(connection)
        client.control(self._server_info())
        advertisements = [channel.advertisement for channel in self._channels.values()]
        if advertisements:
            client.control({"op": "advertise", "channels": advertisements})
        self._on_event(f"{name} connected")
        sending = asyncio.create_task(client.send_all())
        try:
            with suppress(ConnectionClosed):
                async for request in connection:
                    for answer in self._answers(client, request):
                        await connection.send(json.dumps(answer))
        finally:
            sending.cancel()
            del self._clients[connection]
            for number in list(client.subscriptions):
                self._end_subscription(client, number)
            self._sent += client.sent
            self._dropped += client.dropped
            lost = f"; {client.dropped} messages were dropped, it read too slowly" if client.dropped else ""
            self._on_event(f"{name} disconnected{lost}")

    def _answers(self, client: _Client, request: str | bytes) -> Iterable[dict[str, object]]:
        """The answers to a request of ``client``."""
        try:
            fields = json.loads(request) if isinstance(request, str) else None
            if not isinstance(fields, dict):
                yield _status(_ERROR, "a request is a JSON object in a text frame")
                return
            yield from self._answer(client, cast("dict[str, Any]", fields))
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError, struct.error) as error:
            yield _status(_ERROR, f"an invalid request: {error!r}")

    def _answer(self, client: _Client, fields: dict[str, Any]) -> Iterable[dict[str, object]]:
        match fields.get("op"):
            case "subscribe":
                for one in fields["subscriptions"]:
                    problem = self._subscribe(client, int(one["channelId"]), int(one["id"]))
                    if problem:
                        yield _status(_ERROR, problem)
            case "unsubscribe":
                for number in client.channels_of(set(fields["subscriptionIds"])):
                    self._end_subscription(client, number)
            case "getParameters" | "setParameters" as op:
                names: list[str] = fields.get("parameterNames", [])
                if op == "setParameters":
                    names = [one["name"] for one in fields["parameters"]]
                    yield _status(_WARNING, "the parameters are those of the robots, and are not set here")
                values = {name: self._parameters.get(name) for name in names or self._parameters}
                answer = _parameter_values({name: value for name, value in values.items() if value})
                yield answer if fields.get("id") is None else {**answer, "id": fields["id"]}
            case "subscribeParameterUpdates":
                watched = client.watched | {str(name) for name in fields["parameterNames"]}
                if len(watched) > _MAX_WATCHED or max(map(len, watched), default=0) > _MAX_NAME:
                    limits = f"{_MAX_WATCHED} parameters, each with a name of {_MAX_NAME} characters"
                    yield _status(_ERROR, f"a client may watch {limits}; the request is ignored")
                else:
                    client.watched = watched
            case "unsubscribeParameterUpdates":
                client.watched.difference_update(map(str, fields["parameterNames"]))
            case op:
                yield _status(_ERROR, f"the operation {op!r} is not supported")

    def _subscribe(self, client: _Client, number: int, subscription: int) -> str:
        """Subscribe ``client`` to a channel; the reason if that is not possible."""
        if number not in self._channels:
            return f"there is no channel {number}"
        if number in client.subscriptions or client.channels_of({subscription}):
            return f"channel {number} or subscription {subscription} is subscribed already"
        _MESSAGE.pack(1, subscription, 0)  # raises for a number of another size
        client.subscriptions[number] = subscription
        self._readers[number] += 1
        for message in self._latched.values():
            if message.number == number:
                client.put(message)
        self.on_readers()
        return ""

    def _end_subscription(self, client: _Client, number: int) -> None:
        if client.subscriptions.pop(number, None) is not None:
            self._readers[number] -= 1
            self._readers += Counter()  # only those above zero
            self.on_readers()

    def _server_info(self) -> dict[str, object]:
        capabilities = ["parameters", "parametersSubscribe", *(("time",) if self._has_time else ())]
        return {
            "op": "serverInfo",
            "name": "zstate",
            "capabilities": capabilities,
            "metadata": {},
            "sessionId": str(self._session),
        }

    def _broadcast(self, fields: dict[str, object]) -> None:
        for client in self._clients.values():
            client.control(fields)


class _Client:
    """A connection with its subscriptions, and what waits to be sent."""

    def __init__(self, connection: ServerConnection) -> None:
        self.subscriptions: dict[int, int] = {}
        """The subscription of each channel."""
        self.watched: set[str] = set()
        self.sent = self.dropped = 0
        self._connection = connection
        self._controls: deque[str] = deque()
        self._latched: OrderedDict[tuple[int, str], ServedMessage] = OrderedDict()
        self._samples = BoundedQueue[ServedMessage](BACKLOG, BACKLOG_BYTES)
        self._bulk = BoundedQueue[ServedMessage](BACKLOG, BACKLOG_BYTES)
        self._time: int | None = None
        self._warned_at = 0.0
        self._has_work = asyncio.Event()

    def channels_of(self, subscriptions: set[int]) -> list[int]:
        """The channels of these subscriptions."""
        return [number for number, one in self.subscriptions.items() if one in subscriptions]

    def control(self, fields: dict[str, object]) -> None:
        """Queue a JSON object, which is never dropped."""
        self._controls.append(json.dumps(fields))
        self._has_work.set()

    def put_time(self, stamp: int) -> None:
        """Queue the time; only the newest is sent."""
        self._time = stamp
        self._has_work.set()

    def put(self, message: ServedMessage) -> None:
        """Queue a message; of latched ones only the newest of each key is kept."""
        if message.key:
            self._latched[message.number, message.key] = message
        else:
            queue = self._bulk if message.is_bulk else self._samples
            if lost := queue.append(message, min(len(message.payload), BACKLOG_BYTES)):
                self.dropped += lost
                self._warn()
        self._has_work.set()

    def _warn(self) -> None:
        if time.monotonic() - self._warned_at >= _WARN_PERIOD_S:
            self._warned_at = time.monotonic()
            text = f"this client reads too slowly: {self.dropped} messages were dropped so far"
            self.control({**_status(_WARNING, text), "id": "dropped"})

    async def send_all(self) -> None:
        """Send what is queued, until cancelled or disconnected."""
        with suppress(ConnectionClosed):
            while True:
                await self._has_work.wait()
                frame = self._next_frame()
                if frame is None:
                    self._has_work.clear()
                else:
                    await self._connection.send(frame)

    def _next_frame(self) -> str | bytes | None:
        if self._controls:
            return self._controls.popleft()
        if self._time is not None:
            stamp, self._time = self._time, None
            return _TIME.pack(2, stamp)
        while self._latched or self._samples or self._bulk:
            if self._latched:
                _, message = self._latched.popitem(last=False)
            else:
                message = (self._samples or self._bulk).popleft()
            subscription = self.subscriptions.get(message.number)
            if subscription is not None:
                self.sent += 1
                return _MESSAGE.pack(1, subscription, max(message.stamp, 0)) + message.payload
        return None


def _name_of(connection: ServerConnection) -> str:
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "a client"


def _status(level: int, text: str) -> dict[str, object]:
    return {"op": "status", "level": level, "message": text}


def _parameter_values(values: dict[str, str | None]) -> dict[str, object]:
    parameters = [
        {"name": name} if value is None else {"name": name, "value": value} for name, value in values.items()
    ]
    return {"op": "parameterValues", "parameters": parameters}
