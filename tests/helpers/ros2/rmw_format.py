"""The wire format of rmw_zenoh_cpp, implemented independently of zstate, as the reference of these tests.

Imports only the standard library and xxhash, so that it runs with and without zstate.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import xxhash

ATTACHMENT = struct.Struct("<qqB16s")
QOS = {"volatile": "::,10:,:,:,,", "latched": ":1:,1:,:,:,,"}


class Attachment(NamedTuple):
    """The attachment of each message: sequence number, stamp and gid of its publisher."""

    seq: int
    stamp: int
    gid: bytes

    @classmethod
    def parse(cls, raw: bytes) -> Attachment:
        """Raises ValueError for bytes that make an rmw_zenoh_cpp node drop the message, or abort."""
        if len(raw) != ATTACHMENT.size:
            raise ValueError(f"the attachment has {len(raw)} bytes, not {ATTACHMENT.size}")
        seq, stamp, length, gid = ATTACHMENT.unpack(raw)
        if length != 16:
            raise ValueError(f"the gid in the attachment has {length} bytes, not 16")
        return cls(seq, stamp, gid)

    def pack(self) -> bytes:
        return ATTACHMENT.pack(self.seq, self.stamp, 16, self.gid)


def gid(token: str) -> bytes:
    """The identity of the publisher that declared ``token``."""
    number = xxhash.xxh3_128_intdigest(token.encode())
    return struct.pack("<QQ", number & (2**64 - 1), number >> 64)


def dds_name(type_name: str) -> str:
    """The form of ``sensor_msgs/msg/JointState`` in keys."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    return f"{domain}/{topic.strip('/')}/{dds_name(type_name)}/{type_hash}"


def node_token(domain: int, zid: str, node_id: int, namespace: str, node: str) -> str:
    ids = f"{node_id}/{node_id}"
    return f"@ros2_lv/{domain}/{zid}/{ids}/NN/%/{_mangled(namespace)}/{node}"


def endpoint_token(node: str, eid: int, kind: str, topic: str, described: tuple[str, str, str]) -> str:
    """``kind`` is MP for a publisher, MS for a subscription; ``node`` is the token of its node.

    ``described`` are the type's name, its hash and the QoS.
    """
    admin, domain, zid, nid, _, _, *names = node.split("/")
    head = "/".join([admin, domain, zid, nid, str(eid), kind, *names])
    type_name, type_hash, qos = described
    return f"{head}/{_mangled(topic)}/{dds_name(type_name)}/{type_hash}/{qos}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")
