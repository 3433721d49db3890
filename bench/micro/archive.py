"""An archive: rate of imports, poses over all of its days, SQL, and one instant.

A recording of ``robot`` at 1 kHz, joint states without transforms, is imported. Then a synthetic archive is
made of ``robots`` for ``days``, ``seconds`` a day at ``rate`` samples a second, an import for each robot and
day. Poses of the last link in the first are looked up at ``poses`` stamps between the samples, evenly over
all robots and days; then it is compacted. Files may be in the page cache; the first of the times is with
nothing read by this process.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from bench.micro.form import Row
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
        size = sum(path.stat().st_size for path in Path(url).rglob("*") if path.is_file())
        yield Row("synthetic archive", "MB", [size / 1e6])
        yield from lookup_rows(url, model, robots=robots, days=days, span_ns=round(seconds * S), poses=poses)
        yield from sql_rows(url)
        yield Row("compaction", "s", [seconds_of(lambda: compact(url))])
        yield from sql_rows(url)


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


def lookup_rows(
    url: str, model: RobotModel, *, robots: int, days: int, span_ns: int, poses: int
) -> Iterator[Row]:
    """Rows of lookups over all days, and at one instant."""
    each = max(2, poses // (robots * days))
    offsets = np.linspace(1, span_ns - span_ns // 100, each).astype(np.int64)
    stamps = (START + np.arange(days)[:, None] * DAY + offsets).ravel()
    target, source = model.links[0], model.links[-1]

    def look_up(archive: Archive) -> None:
        for number in range(robots):
            _, valid = archive.lookup_many(target, source, stamps, robot=f"r{number}")
            assert valid.all()

    archive = Archive(url)
    count = robots * len(stamps)
    yield Row(f"{count} poses, the first time", "s", [seconds_of(lambda: look_up(archive))])
    before = time.process_time()
    yield Row("the same again", "s", [seconds_of(lambda: look_up(archive))])
    yield Row("poses a second of CPU", "M/s", [count / (time.process_time() - before) * 1e-6])

    def one_instant() -> None:
        instant = int(stamps[len(stamps) // 2])
        assert Archive(url).lookup_many(target, source, [instant], robot="r0")[1].all()

    yield Row(
        "one instant, the archive opened for it", "ms", [1e3 * seconds_of(one_instant) for _ in range(20)]
    )


def sql_rows(url: str) -> Iterator[Row]:
    """Rows of counts by robot and day."""
    yield Row("DuckDB: connection with its views", "ms", [1e3 * seconds_of(Archive(url).duckdb)])
    with Archive(url).duckdb() as connection:
        for what, query in (
            ("files", "SELECT robot, date, sum(rows) FROM files GROUP BY ALL"),
            ("joint_states", "SELECT robot, date, count(*) FROM joint_states GROUP BY ALL"),
        ):
            times = [1e3 * seconds_of(connection.sql(query).fetchall) for _ in range(5)]
            yield Row(f"DuckDB: count by robot and day, of {what}", "ms", times)


def seconds_of(call: Callable[[], object]) -> float:
    """How long a call takes [s]."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin
