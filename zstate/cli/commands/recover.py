"""zstate recover: a complete file of a recording that was cut off or is damaged."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli.output.console import count_text, fail, print_wrapped

if TYPE_CHECKING:
    from zstate.recording.mcap.recover import RecoverReport


@click.command("recover")
@click.argument("file")
@click.argument("target", required=False)
@click.option("--overwrite", is_flag=True, help="Replace a TARGET that exists.")
def recover_command(file: str, target: str | None, overwrite: bool) -> None:
    """Write TARGET, a complete file of what can be read of the MCAP file FILE.

    FILE was cut off by a crash or a full disk, or is damaged, and stays as it is. TARGET is
    FILE_recovered.mcap unless given. Of a recording in several files each is recovered by itself.
    """
    from zstate.errors import RecordingError
    from zstate.recording.mcap.recover import recover

    source = Path(file)
    named = Path(target) if target else source.with_name(f"{source.stem}_recovered.mcap")
    try:
        report = recover(source, named, overwrite=overwrite)
    except RecordingError as error:
        fail(str(error).replace("overwrite=True", "--overwrite"))
    print_wrapped("\n".join(_lines(report)))


def _lines(report: RecoverReport) -> list[str]:
    topics = ", ".join(f"{topic} {count}" for topic, count in report.messages.items())
    first, last = report.span or (0, 0)
    saved = f"{count_text(report.message_count, 'message')} in {(last - first) / 1e9:.3f} s"
    lines = [f"saved {saved} into {report.target}{f' ({topics})' * bool(topics)}"]
    if report.was_complete:
        return [*lines, f"{report.source} was complete: nothing was to be saved"]
    if not report.losses:
        return [*lines, f"nothing lost: {report.source} lacked its end only"]
    return [*lines, *(f"lost {loss}" for loss in report.losses)]
