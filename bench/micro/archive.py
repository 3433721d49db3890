"""An archive: rate of imports, poses over all of its days, SQL, and one instant.

A recording of ``robot`` at 1 kHz, joint states without transforms, is imported. Then a synthetic archive is
made of ``robots`` for ``days``, ``seconds`` a day at ``rate`` samples a second, an import for each robot and
day. Poses of the last link in the first are looked up between the samples of all robots and days: two in each
file, which is what a file costs; then ``poses`` in all of them, and of the first robot. Then it is compacted,
and measured again. Files are in the page cache. CPU is that of the process with all of its threads; the first
of the times is with nothing read by this process.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.micro.form import Row, mean_times_us
from zstate import Archive, load_model
from zstate.archive import compact, import_recording
from zstate.archive.importer import SampleTable, listed
from zstate.archive.layout import (
    FRAMES,
    IMPORTS,
    JOINTS,
    MODELS,
    POSE,
    SUFFIX,
    WRITERS,
    folder_of,
    frames_schema,
    model_schema,
    record_schema,
    write_small,
    writers_schema,
)
from zstate.archive.storage import Store
from zstate.model.robot import RobotModel, coordinate_names
from zstate.recording.encode import RecordingEncoder
from zstate.recording.mcap.writer import RecordingWriter
from zstate.wire.messages import JointState, RobotDescription, order_digest

S = 10**9
DAY = 86_400 * S
START = 20_000 * DAY


def measure(
    *,
    robot: str = "talos",
    recorded_s: float = 30.0,
    robots: int = 10,
    days: int = 30,
    seconds: float = 60.0,
    rate: float = 100.0,
    poses: int = 2_000_000,
) -> Iterator[Row]:
    """Rows of all."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        yield from import_rows(root, load_model(robot), recorded_s)
        url = str(root / "fleet")
        model = load_model("panda")
        make_archive(
            url, model, robots=robots, days=days, samples=round(seconds * rate), period_ns=round(S / rate)
        )
        frames = model.links[0], model.links[1], model.links[-1]
        asked = Asked(url, *frames, robots, days, round(seconds * S))
        yield from archive_rows(asked, poses)
        yield Row("compaction", "s of CPU", [cpu_s_of(lambda: compact(url))])
        yield from archive_rows(asked, poses)


class Asked(NamedTuple):
    """What is looked up in an archive: ``source`` in ``target``, to which ``next_link`` has one joint."""

    url: str
    target: str
    next_link: str
    source: str
    robots: int
    days: int
    span_ns: int

    def stamps(self, each: int) -> NDArray[np.int64]:
        """So many stamps of each day."""
        offsets = np.linspace(1, self.span_ns - self.span_ns // 100, each).astype(np.int64)
        return (START + np.arange(self.days)[:, None] * DAY + offsets).ravel()

    def look_up(self, archive: Archive, stamps: NDArray[np.int64], robots: int) -> None:
        """Look up the poses of the first ``robots``. All must be known."""
        for number in range(robots):
            _, valid = archive.lookup_many(self.target, self.source, stamps, robot=f"r{number}")
            assert valid.all()


def import_rows(root: Path, model: RobotModel, seconds: float) -> Iterator[Row]:
    """Rows of one import."""
    path = root / "run.mcap"
    write_recording(path, model, round(seconds * 1000))
    begin = time.perf_counter()
    report = import_recording(str(root / "one"), path)
    took_s = time.perf_counter() - begin
    rows = report.rows[JOINTS]
    yield Row(f"import of {model.name} at 1 kHz", "x real time", [seconds / took_s])
    yield Row("its size", "B a sample", [report.size / rows], [path.stat().st_size / rows])


def write_recording(path: Path, model: RobotModel, samples: int) -> None:
    """A recording of joints that move smoothly, with noise of 1e-4."""
    dice = np.random.default_rng(1)
    with RecordingWriter(path) as writer:
        encoder = RecordingEncoder(writer, lambda reason, text: None, alone="r", programs={})
        description = RobotDescription(1, model.urdf, model.digest, model.joint_names, ())
        encoder.write_message("r", description, START)
        order, width = order_digest(model.joint_names), model.position_count
        for n in range(samples):
            angles = 0.001 * n + np.arange(width)
            positions = np.sin(angles) + dice.normal(0.0, 1e-4, width)
            rates = np.cos(angles) + dice.normal(0.0, 1e-4, width)
            state = JointState(START + n * 1_000_000, n, 1, order, positions.tobytes(), rates.tobytes())
            encoder.write_message("r", state, START + n * 1_000_000 + 1000)


def make_archive(
    url: str, model: RobotModel, *, robots: int, days: int, samples: int, period_ns: int
) -> None:
    """An archive of ``robots`` with this model, as imports of a recording a day make it."""
    store, dice, names = Store(url), np.random.default_rng(2), coordinate_names(model)
    noise = dice.normal(0.0, 1e-4, (samples, len(names)))
    times = np.arange(samples) * 0.01
    columns = {f"position.{name}": np.sin(times + n) + noise[:, n] for n, name in enumerate(names)}
    for robot in (f"r{n}" for n in range(robots)):
        for day in range(days):
            name = f"{robot}x{day}"
            with store.staging(name) as folder:
                new_path = map(folder.joinpath, map(str, count())).__next__
                table = SampleTable(new_path, JOINTS, robot, "")
                table.write(START + day * DAY + np.arange(samples) * period_ns, columns)
                pending: dict[str, Path] = {}
                rows = list(listed(table.finish(), robot, pending, name))
                facts = {"recording": name, "recorded": START + day * DAY, "imported": 0}
                row = {
                    "kind": "model",
                    "parent": robot,
                    "child": f"{robot}/{model.root}",
                    "model": model.digest,
                }
                described = {"digest": model.digest, "name": model.name, "urdf": model.urdf}
                tables: dict[str, tuple[Any, list[dict[str, Any]]]] = {
                    f"{folder_of(FRAMES, robot)}/{robot}{SUFFIX}": (
                        frames_schema(),
                        [row | dict.fromkeys(POSE)],
                    ),
                    f"{folder_of(MODELS)}/{model.digest}{SUFFIX}": (model_schema(), [described]),
                    f"{folder_of(WRITERS, robot)}/{name}{SUFFIX}": (
                        writers_schema(),
                        [{"import": name, "stream": JOINTS, "messages": samples}],
                    ),
                    f"{folder_of(IMPORTS)}/{name}{SUFFIX}": (record_schema(), [one | facts for one in rows]),
                }
                for path, (schema, content) in tables.items():
                    pending[path] = new_path()
                    write_small(pending[path], schema, content)
                for path, staged in pending.items():
                    Path(url, path).parent.mkdir(parents=True, exist_ok=True)
                    staged.replace(Path(url, path))  # without the synchronisation of an import


def archive_rows(asked: Asked, poses: int) -> Iterator[Row]:
    """Rows of an archive as it is."""
    paths = [path for path in Path(asked.url).rglob("*") if path.is_file()]
    yield Row("synthetic archive", "files", [len(paths)])
    yield Row("its size", "MB", [sum(path.stat().st_size for path in paths) / 1e6])
    yield from lookup_rows(asked, poses)
    yield from instant_rows(asked)
    yield from sql_rows(asked)


def lookup_rows(asked: Asked, poses: int) -> Iterator[Row]:
    """Rows of lookups over all days."""
    archive, files = Archive(asked.url), asked.robots * asked.days
    few, many = asked.stamps(2), asked.stamps(max(2, poses // files))
    for when in ("the first time", "again"):
        spent_s = cpu_s_of(lambda: asked.look_up(archive, few, asked.robots))
        yield Row(f"two poses in each of {files} files, {when}", "ms a file", [1e3 * spent_s / files])
    spent_s = cpu_s_of(lambda: asked.look_up(archive, many, asked.robots))
    yield Row(f"{len(many) * asked.robots} poses in all of them", "s of CPU", [spent_s])
    alone = asked.stamps(max(2, poses // asked.days))
    before, begin = time.process_time(), time.perf_counter()
    asked.look_up(archive, alone, 1)
    spent_s, took_s = time.process_time() - before, time.perf_counter() - begin
    yield Row(f"{len(alone)} poses of one robot, in {asked.days} files", "s of CPU", [spent_s])
    yield Row("the same by the clock", "s", [took_s])
    yield Row("the same", "M poses/s of CPU", [len(alone) / spent_s * 1e-6])
    buffer = archive.buffer("r0", START, START + asked.span_ns)
    stamps = np.linspace(START, START + asked.span_ns * 99 // 100, 1 << 15).astype(np.int64)
    calls = {
        source: partial(buffer.lookup_many, asked.target, source, stamps)
        for source in (asked.next_link, asked.source)
    }
    for source, times in mean_times_us(calls, 5, 3).items():
        yield Row(f"{source} in a buffer in memory", "ns a pose", [1e3 * us / len(stamps) for us in times])


def instant_rows(asked: Asked) -> Iterator[Row]:
    """Rows of lookups at one instant of the middle of the time, the archive opened for each."""
    (instant,) = asked.stamps(1)[[asked.days // 2]].tolist()

    def look_up() -> None:
        asked.look_up(Archive(asked.url), np.array([instant]), 1)

    look_up()
    yield Row("one instant", "ms", [1e3 * seconds_of(look_up) for _ in range(20)])
    yield Row("the same", "ms of CPU", [1e3 * cpu_s_of(look_up) for _ in range(20)])
    times = np.array([new_process(asked, instant) for _ in range(5)])
    for number, what in enumerate(("Python and numpy", "pyarrow", "zstate, and the lookup")):
        yield Row(f"the same in a new process: {what}", "ms of CPU", times[:, number].tolist())


def new_process(asked: Asked, instant: int) -> list[float]:
    """The CPU time of a new process that looks up a pose, by its parts [ms]."""
    code = (
        "import json, sys, time, numpy; times = [time.process_time()]\n"
        "import pyarrow.fs, pyarrow.parquet; times.append(time.process_time())\n"
        "from zstate import Archive; url, *frames, instant = json.load(sys.stdin)\n"
        "assert Archive(url).lookup_many(*frames, [instant], robot='r0')[1].all()\n"
        "print(json.dumps([*times, time.process_time()]))"
    )
    question = json.dumps([asked.url, asked.target, asked.source, instant])
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, input=question, text=True, stdout=subprocess.PIPE, check=True)
    return (np.diff(json.loads(done.stdout), prepend=0.0) * 1e3).tolist()


def sql_rows(asked: Asked) -> Iterator[Row]:
    """Rows of a connection, and of queries."""
    yield Row("DuckDB: connection with its views", "s of CPU", [cpu_s_of(Archive(asked.url).duckdb)])
    day = np.datetime64(START + asked.days // 2 * DAY, "ns").astype("datetime64[D]")
    with Archive(asked.url).duckdb() as connection:
        for what, query in (
            ("count by robot and day, from files", "SELECT robot, date, sum(rows) FROM files GROUP BY ALL"),
            ("the same, of the samples", "SELECT robot, date, count(*) FROM joint_states GROUP BY ALL"),
            (
                "mean of one robot and day",
                f"SELECT avg(stamp) FROM joint_states WHERE robot = 'r0' AND date = '{day}'",
            ),
        ):
            times = [cpu_s_of(connection.sql(query).fetchall) for _ in range(3)]
            yield Row(f"DuckDB: {what}", "s of CPU", times)


def cpu_s_of(call: Callable[[], object]) -> float:
    """The CPU time of a call, of all threads [s]."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def seconds_of(call: Callable[[], object]) -> float:
    """How long a call takes [s]."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin
