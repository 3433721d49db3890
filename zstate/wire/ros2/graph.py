"""Liveliness tokens of the ROS graph: nodes and their publishers, subscriptions, services and clients.

A token is a key. The key of a received token must be kept: ``parse_token(key).key`` differs if the other side
wrote more than is parsed here. The ``gid`` of a writer's token is in the attachment of each of its messages.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from struct import Struct
from typing import Literal, NamedTuple

from xxhash import xxh3_128_digest

from zstate.errors import MessageError
from zstate.wire.ros2.qos import Qos

Kind = Literal["MP", "MS", "SS", "SC"]
"""Message publisher, message subscription, service server, service client."""

DDS_GRAPH_EXPRESSION = "@/*/@ros2_lv/**"
"""The key expression of the tokens of all zenoh-plugin-ros2dds bridges."""

_ADMIN = "@ros2_lv"
_NODE = "NN"
_KINDS = ("MP", "MS", "SS", "SC")
_MAX_KEY_LENGTH = 8192
_NUMBER = re.compile(r"\d{1,18}", re.ASCII)
_DDS_SLASH = "§"
_TYPE_HASH = re.compile(r"typehash=([^;]+);")

_GID_BYTES = 16
_ATTACHMENT = Struct("<qqB16s")  # the third is the length of the gid, as Zenoh serialises a slice
ATTACHMENT_BYTES = _ATTACHMENT.size
_LABEL = b"sequence_number"


@dataclass(frozen=True)
class NodeToken:
    """A node. ``zid`` is the id of its Zenoh session, ``nid`` its number there, from 0 on.

    ``enclave`` and ``namespace`` begin with a slash; "/" is the root.
    """

    domain: int
    zid: str
    nid: int
    enclave: str
    namespace: str
    name: str

    @property
    def full_name(self) -> str:
        """The name of the node with its namespace."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def key(self) -> str:
        """The liveliness key."""
        return self.prefix(self.nid, _NODE)

    def prefix(self, number: int, kind: str) -> str:
        """The first nine chunks of the key of this node, or of its endpoint ``number``."""
        names = (_mangled(part) for part in (self.enclave, self.namespace, self.name))
        return "/".join([_ADMIN, str(self.domain), self.zid, str(self.nid), str(number), kind, *names])


@dataclass(frozen=True)
class EndpointToken:
    """A publisher, subscription, service or client of ``node``, numbered ``eid`` in its session.

    ``topic`` is the full name with its leading slash; ``dds_type`` as in keys, for instance
    "std_msgs::msg::dds_::String_". One counter gives out the numbers of nodes and endpoints.
    """

    node: NodeToken
    eid: int
    kind: Kind
    topic: str
    dds_type: str
    hash: str
    qos: Qos

    @property
    def zid(self) -> str:
        """The id of the node's Zenoh session."""
        return self.node.zid

    @property
    def full_name(self) -> str:
        """The name of the node with its namespace."""
        return self.node.full_name

    @property
    def key(self) -> str:
        """The liveliness key, the input of ``gid``."""
        what = (_mangled(self.topic), self.dds_type, self.hash, self.qos.encode_rmw())
        return "/".join([self.node.prefix(self.eid, self.kind), *what])


@dataclass(frozen=True)
class DdsToken:
    """A topic routed by a bridge of zenoh-plugin-ros2dds, which announces no nodes.

    ``topic`` is the Zenoh key of its messages, ``type_name`` for instance "std_msgs/msg/String";
    ``hash`` is empty if the bridge announces none.
    """

    zid: str
    kind: Literal["MP", "MS"]
    topic: str
    type_name: str
    qos: Qos
    hash: str = ""

    @property
    def full_name(self) -> str:
        """The name of the bridge; the node is unknown."""
        return f"bridge {self.zid[:8]}"

    @property
    def dds_type(self) -> str:
        """The type in the form of ``EndpointToken``; no message type if ``type_name`` has not three parts."""
        package, _, name = self.type_name.split("/") if self.type_name.count("/") == 2 else ("", "", "")
        return f"{package}::msg::dds_::{name}_"

    @property
    def key(self) -> str:
        """The liveliness key."""
        names = (part.replace("/", _DDS_SLASH) for part in (self.topic, self.type_name))
        user_data = f":typehash={self.hash};" if self.hash else ""
        return "/".join(["@", self.zid, _ADMIN, self.kind, *names, self.qos.encode_dds() + user_data])


def graph_expression(domain: int) -> str:
    """The key expression of all tokens of rmw_zenoh_cpp in ``domain``."""
    return f"{_ADMIN}/{domain}/**"


def gid(token_key: str) -> bytes:
    """The 16-byte identifier of an endpoint in ROS: a hash of its token's key, exactly as declared."""
    digest = xxh3_128_digest(token_key.encode())  # big-endian: high half, low half
    return digest[:7:-1] + digest[7::-1]  # rmw_zenoh_cpp: low, high, in little-endian memory order


def session_from_gid(gid: bytes) -> int:
    """The session number of a writer, from its ``gid``; a restarted writer has another one."""
    return int.from_bytes(gid[:8], "little")


def parse_token(key: str) -> NodeToken | EndpointToken | None:
    """The node or endpoint of the token ``key`` of rmw_zenoh_cpp; None if it is no such key.

    Chunks that a later version appends to an endpoint are ignored.
    """
    chunks = key.split("/") if len(key) <= _MAX_KEY_LENGTH else []
    if len(chunks) < 9 or not all(chunks) or chunks[0] != _ADMIN:
        return None
    if not all(_NUMBER.fullmatch(chunks[place]) for place in (1, 3, 4)):
        return None
    enclave, namespace, name, *topic = (chunk.replace("%", "/") for chunk in chunks[6:10])
    node = NodeToken(int(chunks[1]), chunks[2], int(chunks[3]), enclave, namespace, name)
    if chunks[5] == _NODE:
        return node
    if chunks[5] not in _KINDS or len(chunks) < 13:
        return None
    try:
        qos = Qos.parse_rmw(chunks[12])
    except MessageError:
        return None
    return EndpointToken(node, int(chunks[4]), chunks[5], topic[0], chunks[10], chunks[11], qos)


def parse_dds_token(key: str) -> DdsToken | None:
    """The publisher or subscription of a bridge's token ``key``; None for other keys."""
    chunks = key.split("/") if len(key) <= _MAX_KEY_LENGTH else []
    if len(chunks) != 7 or chunks[0] != "@" or chunks[2] != _ADMIN or chunks[3] not in ("MP", "MS"):
        return None
    topic, type_name = (chunk.replace(_DDS_SLASH, "/") for chunk in chunks[4:6])
    user_data = _TYPE_HASH.search(chunks[6])
    try:
        qos = Qos.parse_dds(chunks[6])
    except MessageError:
        return None
    return DdsToken(chunks[1], chunks[3], topic, type_name, qos, user_data[1] if user_data else "")


def _mangled(name: str) -> str:
    return name.replace("/", "%")


class Attachment(NamedTuple):
    """What rmw_zenoh_cpp sends with each message, in 33 bytes; a ROS node drops a message without it.

    ``seq`` begins at 1 and grows by one; ``source_time`` [ns since the Unix epoch] is the time of sending
    by the writer's clock; ``gid`` identifies the writer.
    """

    seq: int
    source_time: int
    gid: bytes


def pack_attachment(seq: int, source_time_ns: int, gid: bytes) -> bytes:
    """The attachment of one message. A ROS node that reads another length exits with an exception."""
    return _ATTACHMENT.pack(seq, source_time_ns, _GID_BYTES, gid)


def unpack_attachment(data: bytes | None) -> Attachment:
    """The fields of an attachment.

    Raises MessageError with the reason "no attachment" for None, and "foreign" if it is not of
    rmw_zenoh_cpp.
    """
    if data is None:
        raise MessageError(
            "no attachment: every message of rmw_zenoh_cpp has one; another program writes on this key, "
            "or a bridge that drops it",
            reason="no attachment",
        )
    if len(data) == ATTACHMENT_BYTES and data[16] == _GID_BYTES:
        seq, source_time, _length, gid = _ATTACHMENT.unpack(data)
        if seq >= 0:
            return Attachment(seq, source_time, gid)
    if _LABEL in data[: len(_LABEL) + 1]:
        raise MessageError(
            f"an attachment of {len(data)} bytes with labels, as rmw_zenoh_cpp wrote before mid 2025: "
            "upgrade it to humble 0.1.2, jazzy 0.2.4, kilted 0.6.0 or later",
            reason="foreign",
        )
    raise MessageError(
        f"an attachment of {len(data)} bytes that is not rmw_zenoh_cpp's, which has {ATTACHMENT_BYTES} "
        f"bytes, a sequence number from 0 on, and a {_GID_BYTES} before the gid; another program writes on "
        "this key",
        reason="foreign",
    )
