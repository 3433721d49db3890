"""zstate export: a recording as a table."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_status, print_wrapped, size_text
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from zstate.recording.export import ExportReport, TableFormat
    from zstate.recording.stores import OpenedPath

_LINE_S = 2.0
_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)


def _read_stamps(file: str) -> NDArray[np.int64]:
    from zstate.clock import check_stamp, check_stamps

    try:
        lines = Path(file).read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"{file!r} cannot be read: {error}") from None
    for number, line in enumerate(lines, 1):
        if not all(_INTEGER.fullmatch(word) for word in line.split()):
            text = f"line {number} of {file!r} is {line.strip()!r}; stamps are integers of nanoseconds"
            raise InvalidInput(text)
    stamps = [int(word) for line in lines for word in line.split()]
    if not stamps:
        raise InvalidInput(f"{file!r} has no stamp")
    return check_stamps([check_stamp(stamp) for stamp in stamps])


@click.command("export")
@click.argument("file", metavar="RECORDING")
@click.argument("rest", nargs=-1, metavar="[RECORDING]... [ROBOT]")
@click.option(
    "--pose",
    "poses",
    nargs=2,
    multiple=True,
    metavar="TARGET SOURCE",
    help="Also the pose of frame SOURCE in frame TARGET; may be repeated.",
)
@click.option(
    "--rate",
    type=options.RATE,
    help="A row HZ times a second, interpolated; default: the samples as recorded.",
)
@click.option(
    "--stamps",
    type=options.Checked("FILE", _read_stamps),
    help="A row for each stamp in FILE, integers of nanoseconds, interpolated.",
)
@click.option(
    "--stream",
    metavar="NAME",
    help="Instead: the messages of a stream of measurements, one row each; of clouds a row for each point.",
)
@click.option(
    "--frame", metavar="FRAME", help="Place the points of --stream in FRAME, each at its own instant."
)
@click.option("--csv", "kind", flag_value="csv", help="Write comma-separated values.")
@click.option("--parquet", "kind", flag_value="parquet", help="Write Parquet.")
@click.option("--ply", "kind", flag_value="ply", help="Write each cloud of --stream as PLY, into a folder.")
@click.option(
    "--lerobot",
    metavar="DIR",
    help="Instead: pictures and joint states of one or more RECORDINGs as a LeRobotDataset, each an episode.",
)
@click.option(
    "--fps", type=click.IntRange(min=1), metavar="N", help="With --lerobot: rows a second; default: 30."
)
@click.option("--task", metavar="TEXT", help="With --lerobot: what the robot does.")
@click.option(
    "--output",
    metavar="FILE",
    help="Default: RECORDING with the suffix of the format; with --stream .NAME before it.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@options.window_options
def export_command(
    *,
    file: str,
    rest: tuple[str, ...],
    poses: tuple[tuple[str, str], ...],
    rate: float | None,
    stamps: NDArray[np.int64] | None,
    stream: str | None,
    frame: str | None,
    kind: TableFormat | Literal["ply"] | None,
    lerobot: str | None,
    fps: int | None,
    task: str | None,
    output: str | None,
    overwrite: bool,
    window: tuple[int, int] | None,
) -> None:
    """Write the joint states of ROBOT in RECORDING, and poses of frames, as a table with one row for each
    instant.

    ROBOT may be left out if only one robot has joint states.
    Columns are stamp [ns], position.JOINT, velocity.JOINT and effort.JOINT as far as recorded, and
    TARGET.SOURCE.x to .qw of each --pose; numbers that are not known are NaN. At --rate or --stamps,
    positions are interpolated as in lookups, and velocities and efforts are left out.
    If drivers published some of the joints each, each of their samples is a row, with the positions of
    the other drivers interpolated, and without efforts. Parquet needs pyarrow: pip install 'zstate[export]'.

    With --stream, columns are stamp [ns], robot, writer, and the fields of the messages, nested ones in
    JSON; of ROBOT, by default of all robots. The package that brings the stream must be installed here.
    The default format is then --csv.

    RECORDING may also be an archive, with ROBOT and a window; the default output is then ROBOT.csv and so
    on.

    With --lerobot, rows are --fps a second: the joint positions interpolated at each instant, and the
    picture of each camera that is nearest to it. ROBOT is then the last argument that is no file.
    lerobot opens the folder DIR. Needs pip install 'zstate[cameras,export]'.

    \b
    zstate export run.mcap --parquet                         # run.parquet
    zstate export run.mcap panda --csv --rate 50 --pose panda_link0 panda_hand
    zstate export run.mcap --parquet --stamps images.txt --output images.parquet
    zstate export run.mcap --stream battery                  # run.battery.csv
    zstate export run.mcap --stream cloud --parquet          # run.cloud.parquet, a row for each point
    zstate export run.mcap --stream cloud --ply              # run.cloud.ply/diffbot.lidar.STAMP.ply
    zstate export run.mcap --stream cloud --ply --frame map  # all of them in one frame
    zstate export s3://plant/fleet robot17 --at 2026-11-20T14:03 --csv    # a minute of an archive
    zstate export ep1.mcap ep2.mcap --lerobot stack --task "stack the cubes"
    """
    if lerobot is not None:
        if poses or rate is not None or stamps is not None or stream or frame or kind or output or window:
            raise click.UsageError(
                "--lerobot writes a folder of its own, without --pose, --rate, --stamps, --stream, --output, "
                "windows of archives and the other formats"
            )
        _export_lerobot((file, *rest), lerobot, fps or 30, task or "", overwrite=overwrite)
        return
    if fps is not None or task is not None:
        raise click.UsageError("--fps and --task are those of a dataset: name its folder with --lerobot DIR")
    if len(rest) > 1:
        raise click.UsageError(f"one RECORDING makes one file; got also {', '.join(rest[:-1])}")
    from zstate.recording.errors import RecordingError
    from zstate.recording.export import Exporter
    from zstate.recording.recording import Recording
    from zstate.recording.stores import opened_path

    robot = rest[0] if rest else None
    if stream is not None:
        if poses or rate is not None or stamps is not None:
            raise click.UsageError(
                "--stream exports messages as recorded, without --pose, --rate and --stamps"
            )
        with opened_path(file, robot, window) as opened:
            _export_stream(opened, robot, stream, kind or "csv", output, frame=frame, overwrite=overwrite)
        return
    if frame is not None:
        raise click.UsageError("--frame places points: name their stream, such as --stream cloud")
    if kind is None:
        raise click.UsageError("Missing option '--csv' or '--parquet'.")
    if kind == "ply":
        raise click.UsageError("--ply writes points: name their stream, such as --stream cloud")
    if rate is not None and stamps is not None:
        raise click.UsageError("--rate and --stamps exclude each other: both choose the rows")
    start = time.monotonic()
    with (
        opened_path(file, robot, window) as opened,
        Recording(opened.path, None if poses else robot) as recording,  # frames may be of other robots
    ):
        path = Path(output) if output else opened.named.with_suffix(f".{kind}")
        exporter = Exporter(
            recording, robot, rate_hz=rate, stamps=stamps, poses=poses, on_progress=ExportProgress()
        )
        try:
            report = exporter.write(path, kind, overwrite=overwrite)
        except RecordingError as error:
            fail(str(error).replace("overwrite=True", "--overwrite"))
        print_wrapped(summary(report, path, time.monotonic() - start))


def _export_stream(
    opened: OpenedPath,
    robot: str | None,
    stream: str,
    kind: TableFormat | Literal["ply"],
    output: str | None,
    *,
    frame: str | None,
    overwrite: bool,
) -> None:
    from zstate.recording.errors import RecordingError
    from zstate.recording.recording import Recording
    from zstate.recording.stream_export import export_points, export_stream
    from zstate.stream_registry import stream_named

    path = Path(output) if output else opened.named.with_suffix(f".{stream}.{kind}")
    with Recording(opened.path, robot) as recording:
        try:
            if kind == "ply":
                count, refused = export_points(recording, stream, path, frame=frame, overwrite=overwrite)
            else:
                count, refused = export_stream(
                    *(recording, stream, path, kind), frame=frame, overwrite=overwrite
                )
        except RecordingError as error:
            fail(str(error).replace("overwrite=True", "--overwrite"))
    items = count_text(
        count, "file" if kind == "ply" else "row" if stream_named(stream).columns else "message"
    )
    files = [*path.iterdir()] if kind == "ply" else [path]
    losses = ", ".join(f"{count_text(count, 'message')} left out ({why})" for why, count in refused.items())
    where = f"{path} ({size_text(sum(one.stat().st_size for one in files))})"
    print_wrapped(f"exported {items} of {stream} into {where}; {losses or 'nothing missing'}")


def _export_lerobot(names: Sequence[str], folder: str, fps: int, task: str, *, overwrite: bool) -> None:
    from zstate.recording.errors import RecordingError
    from zstate.recording.lerobot import export_lerobot

    *others, last = names
    robot = last if others and not Path(last).exists() else None
    paths = [Path(name) for name in (others if robot else names)]
    start = time.monotonic()
    try:
        report = export_lerobot(
            *(paths, Path(folder), robot),
            fps=fps,
            task=task,
            overwrite=overwrite,
            on_progress=print_status,
        )
    except RecordingError as error:
        fail(str(error).replace("overwrite=True", "--overwrite"))
    size = sum(one.stat().st_size for one in Path(folder).rglob("*") if one.is_file())
    cameras = ", ".join(f"{name} ({width} x {height})" for name, (width, height) in report.cameras.items())
    losses = [f"{count_text(count, 'message')} left out ({why})" for why, count in report.refused.items()]
    print_wrapped(
        f"exported {count_text(report.episodes, 'episode')} with {count_text(report.rows, 'row')} of "
        f"{report.robot} at {fps} fps in {time.monotonic() - start:.1f} s into {folder} ({size_text(size)}): "
        f"{count_text(report.joint_count, 'joint')}, pictures of {cameras}, at most "
        f"{report.farthest_ns * 1e-6:.1f} ms from their rows; {', '.join(losses) or 'nothing missing'}"
    )


class ExportProgress:
    """Prints a status line every two seconds."""

    def __init__(self) -> None:
        self._due = time.monotonic() + _LINE_S

    def __call__(self, read: int, recorded: int) -> None:
        if time.monotonic() >= self._due:
            print_status(f"read {read} of {count_text(recorded, 'sample')}")
            self._due = time.monotonic() + _LINE_S


def summary(report: ExportReport, path: Path, took_s: float) -> str:
    """What was exported, and what is missing in it."""
    columns = f"{' and '.join(report.kinds)} of {count_text(report.joint_count, 'joint')}"
    if report.unknown_poses:
        columns += f", {count_text(len(report.unknown_poses), 'pose')}"
    duration_s = (report.last - report.first) * 1e-9
    where = f"{path} ({size_text(path.stat().st_size)})"
    missing = {f"{source!r} in {target!r}": count for (target, source), count in report.unknown_poses.items()}
    missing["interpolated joints"] = report.unknown_joints
    losses = [f"{count_text(count, 'row')} without {what}" for what, count in missing.items() if count]
    losses += [
        f"{count_text(count, 'sample')} left out ({reason})" for reason, count in report.refused.items()
    ]
    text = f"exported {count_text(report.rows, 'row')} of {report.robot} over {duration_s:.3f} s"
    return f"{text} in {took_s:.1f} s into {where}: {columns}; {', '.join(losses) or 'nothing missing'}"
