"""Contents: what a stretch of MCAP records defines and counts."""

from __future__ import annotations

from collections import Counter

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from zstate.record.blocks import MESSAGE, entries, parsed


class Contents:
    """The schemas, channels and message counts in ``data``, and the first and last log time (0 of none)."""

    def __init__(self, data: bytes) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        times: list[int] = []
        for opcode, start, end in entries(data):
            if opcode == Opcode.MESSAGE:
                number, _, log_time, _ = MESSAGE.unpack_from(data, start)
                self.counts[number] += 1
                times.append(log_time)
            elif opcode == Opcode.SCHEMA:
                schema = parsed(Schema, data[start:end])
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parsed(Channel, data[start:end])
                self.channels[channel.id] = channel
        self.first, self.last = min(times, default=0), max(times, default=0)
