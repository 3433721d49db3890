"""Recovering: a complete new file of what can be read in one that was cut off or is damaged."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from zstate.errors import RecordingError
from zstate.record.blocks import MESSAGE, entries
from zstate.record.byte_file import ByteFile
from zstate.record.index import Index, Loss
from zstate.record.mcap_file import reading
from zstate.record.output import LIBRARY, Output
from zstate.record.scan import Scan
from zstate.record.strangers import refusal


@dataclass(frozen=True)
class RecoverReport:
    """What ``recover`` saved. ``messages`` counts it by topic, ``span`` is its first and last log time.

    ``was_complete`` says that nothing was wrong with the original; ``losses`` are its bytes that could
    not be read, with the reasons.
    """

    source: Path
    target: Path
    messages: Mapping[str, int]
    span: tuple[int, int] | None
    was_complete: bool
    losses: tuple[Loss, ...]

    @property
    def message_count(self) -> int:
        return sum(self.messages.values())

    @property
    def dropped_bytes(self) -> int:
        return sum(loss.length for loss in self.losses)


def recover(
    path: str | os.PathLike[str], target: str | os.PathLike[str], *, overwrite: bool = False
) -> RecoverReport:
    """Write a complete file ``target`` of what can be read of the MCAP file ``path``, which stays as it is.

    That is every message of every whole chunk, and the beginning of a chunk in whose middle the file
    ends; further its channels, schemas, metadata and attachments, all in the order of the original.
    RecordingError when it is not an MCAP file, or ``target`` exists (unless ``overwrite``) or cannot be
    written; there is no ``target`` then.
    """
    source, target = Path(path), Path(target)
    with reading(source) as file:
        if not file.starts_as_mcap:
            raise RecordingError(refusal(source, file.at(0, min(file.size, 64))), path=str(source))
        if target.exists() and target.samefile(source):
            raise RecordingError(f"{str(source)!r} cannot be recovered into itself", path=str(source))
        scan = Scan(file)
        index = scan.index()
        counts = _copy(file, scan, index, target, overwrite=overwrite)
    return RecoverReport(source, target, counts, index.span, index.complete, index.losses)


def _copy(file: ByteFile, scan: Scan, index: Index, target: Path, *, overwrite: bool) -> Counter[str]:
    header = index.header
    library = f"{LIBRARY}, recovered from {header.library}"
    output = Output(target, overwrite=overwrite, profile=header.profile, library=library)
    try:
        counts = _Copy(output, index).run(file, scan)
        output.finish()
    except BaseException:
        output.abandon()
        target.unlink(missing_ok=True)
        raise
    return counts


class _Copy:
    """The messages of one file on their way to another."""

    def __init__(self, output: Output, index: Index) -> None:
        self._output = output
        self._index = index
        self._counts: Counter[str] = Counter()

    def run(self, file: ByteFile, scan: Scan) -> Counter[str]:
        writer = self._output.writer
        for metadata in scan.metadata:
            writer.add_metadata(metadata.name, metadata.metadata)
        self._numbers = dict(self._registered())
        for piece in self._index.pieces:
            self._copy(piece.content(file))
            self._output.flush()
        for attachment in scan.attachments:
            created, logged = attachment.create_time, attachment.log_time
            writer.add_attachment(created, logged, attachment.name, attachment.media_type, attachment.data)
        return self._counts

    def _registered(self) -> Iterator[tuple[int, int]]:
        """The number of each channel in the original, and in the copy."""
        writer = self._output.writer
        schemas = {
            number: writer.register_schema(schema.name, schema.encoding, schema.data)
            for number, schema in self._index.schemas.items()
        }
        for number, channel in self._index.channels.items():
            schema = schemas.get(channel.schema_id, 0)
            yield (
                number,
                writer.register_channel(
                    channel.topic, channel.message_encoding, schema, dict(channel.metadata)
                ),
            )

    def _copy(self, data: bytes) -> None:
        for opcode, start, stop in entries(data):
            if opcode != Opcode.MESSAGE:
                continue
            number, sequence, log_time, publish_time = MESSAGE.unpack_from(data, start)
            if number in self._numbers:
                payload = data[start + MESSAGE.size : stop]
                copied = self._numbers[number]
                self._output.writer.add_message(copied, log_time, payload, publish_time, sequence)
                self._counts[self._index.channels[number].topic] += 1
