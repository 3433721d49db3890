"""Writes a complete copy of what can be read in a truncated or damaged MCAP file."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from zstate.recording.errors import RecordingError
from zstate.recording.mcap.file import explain_unreadable, open_errors
from zstate.recording.mcap.index import DataLoss, FileScan
from zstate.recording.mcap.records import MESSAGE, BoundedFile, iter_records
from zstate.recording.mcap.writer import LIBRARY, McapOutput


@dataclass(frozen=True)
class RecoverReport:
    """Result of ``recover``. ``messages`` counts by topic, ``span`` is the first and last log time.

    ``was_complete`` is True if the original was undamaged; ``losses`` are its unreadable bytes, with reasons.
    """

    source: Path
    target: Path
    messages: Mapping[str, int]
    span: tuple[int, int] | None
    was_complete: bool
    losses: tuple[DataLoss, ...]

    @property
    def message_count(self) -> int:
        return sum(self.messages.values())


def recover(
    path: str | os.PathLike[str], target: str | os.PathLike[str], *, overwrite: bool = False
) -> RecoverReport:
    """Write a complete file ``target`` of everything readable in the MCAP file ``path``, which is unchanged.

    That is every message of every whole chunk, the beginning of a chunk that the file ends in, and the
    channels, schemas, metadata and attachments, all in the order of the original. Raises RecordingError if
    ``path`` is not an MCAP file, or ``target`` exists (unless ``overwrite``) or cannot be written; no
    ``target`` is left then.
    """
    source, target = Path(path), Path(target)
    with open_errors(source) as file:
        if not file.has_mcap_magic:
            raise RecordingError(
                explain_unreadable(source, file.read(0, min(file.size, 64))), path=str(source)
            )
        if target.exists() and target.samefile(source):
            raise RecordingError(f"{str(source)!r} cannot be recovered into itself", path=str(source))
        scan = FileScan(file)
        index = scan.index
        library = f"{LIBRARY}, recovered from {index.header.library}"
        output = McapOutput(target, overwrite=overwrite, profile=index.header.profile, library=library)
        try:
            counts = _copy(file, scan, output)
            output.finish()
        except BaseException:
            output.abandon()
            target.unlink(missing_ok=True)
            raise
    return RecoverReport(source, target, counts, index.span, index.complete, index.losses)


def _copy(file: BoundedFile, scan: FileScan, output: McapOutput) -> Counter[str]:
    """Copy everything; the number of messages by topic."""
    index, writer = scan.index, output.writer
    for metadata in scan.metadata:
        writer.add_metadata(metadata.name, metadata.metadata)
    schemas = {
        number: writer.register_schema(schema.name, schema.encoding, schema.data)
        for number, schema in index.schemas.items()
    }
    copied = {
        number: writer.register_channel(
            channel.topic, channel.message_encoding, schemas.get(channel.schema_id, 0), dict(channel.metadata)
        )
        for number, channel in index.channels.items()
    }
    counts: Counter[str] = Counter()
    for data_range in index.ranges:
        data = data_range.content(file)
        for opcode, start, stop in iter_records(data):
            if opcode != Opcode.MESSAGE:
                continue
            number, sequence, log_time, publish_time = MESSAGE.unpack_from(data, start)
            if number in copied:
                payload = data[start + MESSAGE.size : stop]
                writer.add_message(copied[number], log_time, payload, publish_time, sequence)
                counts[index.channels[number].topic] += 1
        output.write_chunk()
    for attachment in scan.attachments:
        created, logged = attachment.create_time, attachment.log_time
        writer.add_attachment(created, logged, attachment.name, attachment.media_type, attachment.data)
    return counts
