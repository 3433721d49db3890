"""zstate recover: a complete copy of a recording that was cut off or is damaged."""

from __future__ import annotations

from pathlib import Path

import click

from zstate.cli.output.console import count_text, fail, print_wrapped


@click.command("recover")
@click.argument("file")
@click.argument("target", required=False)
@click.option("--overwrite", is_flag=True, help="Replace an existing TARGET.")
def recover_command(file: str, target: str | None, overwrite: bool) -> None:
    """Copy everything that can be read of the MCAP file FILE into TARGET, a complete file.

    For a FILE that is damaged, or cut off by a crash or a full disk; it is not changed. TARGET is
    FILE_recovered.mcap by default. Recover each file of a split recording by itself.
    """
    from zstate.recording.errors import RecordingError
    from zstate.recording.mcap.recover import recover

    source = Path(file)
    path = Path(target) if target else source.with_name(f"{source.stem}_recovered.mcap")
    try:
        report = recover(source, path, overwrite=overwrite)
    except RecordingError as error:
        fail(str(error).replace("overwrite=True", "--overwrite"))
    topics = ", ".join(f"{topic} {count}" for topic, count in report.messages.items())
    first, last = report.span or (0, 0)
    saved = f"{count_text(report.message_count, 'message')} in {(last - first) / 1e9:.3f} s"
    lines = [f"saved {saved} into {report.target}{f' ({topics})' * bool(topics)}"]
    if report.was_complete:
        lines.append(f"{report.source} was complete: nothing to recover")
    elif not report.losses:
        lines.append(f"nothing lost: only the end of {report.source} was missing")
    else:
        lines += [f"lost {loss}" for loss in report.losses]
    print_wrapped("\n".join(lines))
