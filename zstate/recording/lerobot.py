"""Export of recordings as a LeRobotDataset v3.0: joint states and pictures at a constant rate.

Each recording is one episode. Its rows are the instants ``start + k / fps``, from when the joint states and
all cameras have begun until the first of them ends:

=============================  ========================================================================
column                         content
=============================  ========================================================================
``observation.state``          the positions of the joints at the instant, interpolated as in lookups
``observation.images.CAMERA``  the picture whose stamp is nearest to it, in an mp4 for each episode
``stamp``                      the instant [ns]
``image_stamps``               the stamp of each camera's picture [ns], in the order of their names
``timestamp``                  k / fps [s]: lerobot finds the picture by it, so that rows are equidistant
=============================  ========================================================================

and ``frame_index``, ``episode_index``, ``index`` and ``task_index``. The files are those of lerobot 0.6: data
in Parquet, ``meta/info.json``, ``meta/stats.json``, ``meta/tasks.parquet`` and ``meta/episodes``.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zstate._util.format import SECOND_NS
from zstate._util.refusals import Refusals
from zstate.clock import format_stamp
from zstate.errors import InvalidInput, MessageError
from zstate.recording.errors import RecordingError
from zstate.recording.export import arrow
from zstate.recording.recording import Recording

if TYPE_CHECKING:
    from zstate.cameras.codecs import Pixels, VideoDecoder
    from zstate.cameras.messages import CompressedImage
    from zstate.cameras.video_file import Mp4File

Stamps = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]
Statistics = dict[str, Any]

_VERSION = "v3.0"
_STATE, _IMAGES = "observation.state", "observation.images."
_FILES_PER_CHUNK = 1000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA_PATH = f"data/{_FILE}.parquet"
_VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
_EPISODES_PATH = f"meta/episodes/{_FILE}.parquet"
_INFO_PATH = "meta/info.json"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_LEVELS = np.arange(256) / 255.0
_PIXEL_STEP = 4
"""Every so many rows and columns of pixels are counted for the statistics."""


@dataclass
class DatasetReport:
    """What was exported: ``rows`` of ``episodes``, and the width and height [px] of each camera's pictures.

    ``farthest_ns`` is the largest time between a row and one of its pictures; ``refused`` counts messages
    left out, by reason.
    """

    robot: str = ""
    episodes: int = 0
    rows: int = 0
    joint_count: int = 0
    cameras: dict[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    farthest_ns: int = 0
    refused: Counter[str] = field(default_factory=Counter[str])


def export_lerobot(
    paths: Sequence[Path],
    folder: Path,
    robot: str | None = None,
    *,
    fps: int = 30,
    task: str = "",
    overwrite: bool = False,
    on_progress: Callable[[str], object] = lambda text: None,
) -> DatasetReport:
    """Write recordings of ``robot``, by default of the only one with joint states, each an episode.

    ``task`` is what the robot does in all of them. The folder appears when it is complete.

    Raises RecordingError if it exists (with ``overwrite``: unless it is such a dataset) or cannot be written,
    LibraryMissing without pyarrow or the libraries of cameras, and InvalidInput for a recording without joint
    states, without pictures or without an instant that has both, for instants at which a joint has no
    position, and for episodes with different joints or cameras.
    """
    if fps < 1:
        raise InvalidInput(f"a dataset has 1 row a second or more; got fps={fps}")
    with _new_folder(folder, overwrite=overwrite) as incomplete:
        dataset = _Dataset(incomplete, fps, task, on_progress)
        for path in paths:
            with Recording(path) as recording:
                dataset.add(recording, robot)
        dataset.finish()
    return dataset.report


@contextmanager
def _new_folder(folder: Path, *, overwrite: bool) -> Generator[Path, None, None]:
    """A folder that is at ``folder`` when the context ends without an exception."""
    if folder.exists() and not overwrite:
        text = f"{str(folder)!r} exists; choose another name, or pass overwrite=True"
        raise RecordingError(text, path=str(folder))
    if folder.exists() and not (folder / _INFO_PATH).exists():
        text = f"{str(folder)!r} is no LeRobotDataset, and is not replaced; choose another name"
        raise RecordingError(text, path=str(folder))
    incomplete = folder.with_name(f"{folder.name}.part")
    try:
        incomplete.mkdir(parents=True)
        yield incomplete
        if folder.exists():
            shutil.rmtree(folder)
        incomplete.replace(folder)
    except OSError as error:
        text = f"{str(folder)!r} cannot be written: {error.strerror or error}"
        raise RecordingError(text, path=str(folder)) from error
    finally:
        shutil.rmtree(incomplete, ignore_errors=True)


class _Dataset:
    """A dataset that grows by an episode with each recording."""

    def __init__(self, folder: Path, fps: int, task: str, on_progress: Callable[[str], object]) -> None:
        self.report = DatasetReport()
        self._folder, self._fps, self._task, self._on_progress = folder, fps, task, on_progress
        self._arrow, self._parquet = arrow()
        self._robot_type = ""
        self._features: dict[str, dict[str, Any]] = {}
        self._rows: list[Columns] = []
        self._histograms: list[dict[str, NDArray[np.int64]]] = []
        self._episodes: list[dict[str, Any]] = []

    def add(self, recording: Recording, robot: str | None) -> None:
        """Append the episode of ``recording``."""
        name, refusals = str(recording.info.path), Refusals("message for the dataset")
        reader = recording.joint_state_reader(robot, refusals.count)
        if reader.model is None:
            raise InvalidInput(
                f"positions of {reader.robot!r} are interpolated by its model, and {name!r} has no "
                "robot_description that fits its joint states"
            )
        joints = [batch.trajectory.stamps for batch in reader.batches() if len(batch.trajectory)]
        if not joints:
            raise InvalidInput(f"no joint state of {reader.robot!r} in {name!r} can be used")
        cameras: dict[str, list[int]] = {}
        for camera, picture in _pictures(recording, reader.robot, lambda reason, text: None):
            cameras.setdefault(camera, []).append(picture.stamp)
        if not cameras:
            raise InvalidInput(
                f"{name!r} has no pictures of {reader.robot!r}, and a dataset has those of one camera or "
                "more: record while `zstate camera` or a CameraPublisher runs"
            )
        stamps = {camera: np.array(cameras[camera], np.int64) for camera in sorted(cameras)}
        grid = self._grid(name, np.concatenate(joints), stamps)
        buffer = recording.buffer(around=grid)
        positions, valid = buffer.joint_positions_many(reader.robot, grid)
        if not valid.all():
            missing = int((~valid).sum())
            raise InvalidInput(
                f"{name!r} has no position of a joint of {reader.robot!r} at {missing} of {len(grid)} "
                f"instants, first at {format_stamp(int(grid[~valid][0]))}: a dataset has no gaps; record "
                "without a pause"
            )
        names = buffer.joint_states(reader.robot, 0, 0).coordinates
        self._on_progress(f"{name}: {len(grid)} rows")
        pictures = self._write_videos(recording, reader.robot, stamps, grid, refusals)
        self._check_same(name, reader.robot, names, {camera: one.size for camera, one in pictures.items()})
        self._robot_type = reader.model.name
        self._write_rows(positions, grid, pictures)
        self.report.refused += refusals.counts

    def _grid(self, name: str, joints: Stamps, cameras: Mapping[str, Stamps]) -> Stamps:
        """The instants of the rows [ns]."""
        spans = {"joint states": joints} | {f"pictures of {camera!r}": one for camera, one in cameras.items()}
        start, end = (
            max(int(one.min()) for one in spans.values()),
            min(int(one.max()) for one in spans.values()),
        )
        if end < start:
            text = "; ".join(
                f"{what} from {format_stamp(int(one.min()))} to {format_stamp(int(one.max()))}"
                for what, one in spans.items()
            )
            raise InvalidInput(f"{name!r} has no instant with all of its data: {text}; their clocks differ")
        count = (end - start) * self._fps // SECOND_NS + 1
        return start + np.round(np.arange(count) * (SECOND_NS / self._fps)).astype(np.int64)

    def _write_videos(
        self,
        recording: Recording,
        robot: str,
        cameras: Mapping[str, Stamps],
        grid: Stamps,
        refusals: Refusals,
    ) -> dict[str, _CameraRows]:
        """Write the video of each camera; its rows."""
        with ExitStack() as opened:
            found: dict[str, _CameraRows] = {}
            for camera, stamps in cameras.items():
                path = self._path(_VIDEO_PATH, video_key=_IMAGES + camera)
                found[camera] = opened.enter_context(_CameraRows(path, stamps, grid, self._fps))
            for camera, picture in _pictures(recording, robot, refusals.count):
                found[camera].add(picture, refusals.count)
            for camera, rows in found.items():
                rows.finish(camera)
        return found

    def _path(self, form: str, **names: str) -> Path:
        """The file of this episode."""
        path = self._folder / form.format(**self._place(), **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _place(self) -> dict[str, int]:
        """Where the files of this episode are."""
        chunk, file = divmod(self.report.episodes, _FILES_PER_CHUNK)
        return {"chunk_index": chunk, "file_index": file}

    def _check_same(
        self, name: str, robot: str, joints: Sequence[str], cameras: dict[str, tuple[int, int]]
    ) -> None:
        """Take over what all episodes have in common. Raises InvalidInput if this one differs."""
        features: dict[str, dict[str, Any]] = {
            _STATE: _feature("float32", list(joints)),
            **{_IMAGES + camera: _video_feature(size, self._fps) for camera, size in cameras.items()},
            "stamp": _feature("int64", ["stamp"]),
            "image_stamps": _feature("int64", list(cameras)),
            "timestamp": _feature("float32", None),
            **{
                one: _feature("int64", None)
                for one in ("frame_index", "episode_index", "index", "task_index")
            },
        }
        if self._features and (features, robot) != (self._features, self.report.robot):
            before = self.report
            raise InvalidInput(
                f"{name!r} has {robot!r} with the joints {', '.join(joints)} and the cameras {cameras}; the "
                f"first episode has {before.robot!r} with {', '.join(self._features[_STATE]['names'])} and "
                f"{before.cameras}: episodes of one dataset have the same"
            )
        self._features = features
        self.report.robot, self.report.joint_count, self.report.cameras = robot, len(joints), cameras

    def _write_rows(
        self, positions: NDArray[np.float64], grid: Stamps, cameras: Mapping[str, _CameraRows]
    ) -> None:
        """Write the table of the episode, and note its metadata."""
        episode, before, count = self.report.episodes, self.report.rows, len(grid)
        pictures = np.stack([rows.shown for rows in cameras.values()], axis=1)
        numbers = np.arange(count)
        columns: Columns = {
            _STATE: positions.astype(np.float32),
            "stamp": grid[:, np.newaxis],
            "image_stamps": pictures,
            "timestamp": (numbers / self._fps).astype(np.float32)[:, np.newaxis],
            "frame_index": numbers[:, np.newaxis],
            "episode_index": np.full((count, 1), episode),
            "index": (before + numbers)[:, np.newaxis],
            "task_index": np.zeros((count, 1), np.int64),
        }
        table = self._arrow.table({name: self._column(values) for name, values in columns.items()})
        self._parquet.write_table(table, self._path(_DATA_PATH))
        histograms = {_IMAGES + camera: rows.histogram for camera, rows in cameras.items()}
        place = self._place()
        self._episodes.append(
            {
                "episode_index": episode,
                "tasks": [self._task],
                "length": count,
                "dataset_from_index": before,
                "dataset_to_index": before + count,
                **{f"data/{name}": number for name, number in place.items()},
                **{f"videos/{key}/{name}": number for key in histograms for name, number in place.items()},
                **{f"videos/{key}/from_timestamp": 0.0 for key in histograms},
                **{f"videos/{key}/to_timestamp": count / self._fps for key in histograms},
                **{
                    f"stats/{feature}/{name}": values
                    for feature, statistics in _all_statistics([columns], [histograms], count).items()
                    for name, values in statistics.items()
                },
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._rows.append(columns)
        self._histograms.append(histograms)
        self.report.episodes, self.report.rows = episode + 1, before + count
        farthest = int(np.abs(pictures - grid[:, np.newaxis]).max())
        self.report.farthest_ns = max(self.report.farthest_ns, farthest)

    def _column(self, values: NDArray[Any]) -> Any:
        """A column of numbers, or of lists of a fixed length."""
        flat = self._arrow.array(values.ravel())
        count = values.shape[1]
        return flat if count == 1 else self._arrow.FixedSizeListArray.from_arrays(flat, count)

    def finish(self) -> None:
        """Write the metadata."""
        report = self.report
        info = {
            "codebase_version": _VERSION,
            "fps": self._fps,
            "features": self._features,
            "total_episodes": report.episodes,
            "total_frames": report.rows,
            "total_tasks": 1,
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": _DATA_PATH,
            "video_path": _VIDEO_PATH,
            "robot_type": self._robot_type,
            "splits": {"train": f"0:{report.episodes}"},
        }
        episodes = self._folder / _EPISODES_PATH.format(chunk_index=0, file_index=0)
        episodes.parent.mkdir(parents=True)
        self._write_json(_INFO_PATH, info)
        self._write_json("meta/stats.json", _all_statistics(self._rows, self._histograms, report.rows))
        self._parquet.write_table(self._arrow.Table.from_pylist(self._episodes), episodes)
        tasks = self._arrow.table({"task_index": [0], "task": [self._task]})
        # pandas takes the texts as the index of the rows by this note.
        columns = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
            for name, kind, stored in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ]
        note = json.dumps({"index_columns": ["task"], "column_indexes": [], "columns": columns})
        tasks = tasks.replace_schema_metadata({"pandas": note})
        self._parquet.write_table(tasks, self._folder / "meta/tasks.parquet")

    def _write_json(self, name: str, content: Mapping[str, Any]) -> None:
        (self._folder / name).write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")


class _CameraRows:
    """The pictures of one camera for the rows at ``grid``: to each the one of ``stamps`` that is nearest.

    In place of one that cannot be decoded a row has the next one that can, at the end the last one. A context
    manager.
    """

    def __init__(self, path: Path, stamps: Stamps, grid: Stamps, fps: int) -> None:
        self._path, self._fps = path, fps
        self._rows = np.bincount(_nearest(stamps, grid), minlength=len(stamps))
        self._number = self._due = 0
        self._decoder: VideoDecoder | None = None
        self._last: tuple[int, Pixels] | None = None
        self._video: Mp4File | None = None
        self.size = (0, 0)
        self.shown: list[int] = []
        """The stamp of the picture of each row [ns]."""
        self.histogram = np.zeros((3, 256), np.int64)
        """How often each level of red, green and blue is in the pictures."""

    def __enter__(self) -> _CameraRows:
        return self

    def __exit__(self, *_: object) -> None:
        if self._video is not None:
            self._video.close()

    def add(self, picture: CompressedImage, refuse: Callable[[str, str], None]) -> None:
        """Write the rows of the next picture."""
        count = int(self._rows[self._number])
        self._number += 1
        self._due += count
        if not count and picture.size is not None:
            return  # a still one that no row shows; those of a video need each other
        try:
            pixels = self._decoded(picture)
        except MessageError as error:
            refuse(error.reason, str(error))
            return
        self._last = picture.stamp, pixels
        self._write(self._due)

    def _decoded(self, picture: CompressedImage) -> Pixels:
        from zstate.cameras.codecs import VideoDecoder, decode_still  # noqa: PLC0415 - cameras are a plugin

        if picture.size is not None:
            return decode_still(picture.data, picture.format)
        if self._decoder is None or self._decoder.form != picture.format:
            self._decoder = VideoDecoder(picture.format)
        return self._decoder.decode(picture.data)

    def _write(self, count: int) -> None:
        """Write the last picture ``count`` times."""
        from zstate.cameras.video_file import Mp4File  # noqa: PLC0415 - cameras are a plugin

        assert self._last is not None
        stamp, pixels = self._last
        size = pixels.shape[1], pixels.shape[0]
        if self._video is None:
            self._video, self.size = Mp4File(self._path, size, self._fps), size
        if size != self.size:
            raise InvalidInput(
                f"a camera's pictures in a dataset have one size; at {format_stamp(stamp)} it changes from "
                f"{self.size} to {size}: export the parts of the recording by themselves"
            )
        for _ in range(count):
            self._video.write(pixels)
            self.histogram += _histogram(pixels)
        self.shown += [stamp] * count
        self._due -= count

    def finish(self, camera: str) -> None:
        """Write the rows that are left. Raises InvalidInput if no picture could be decoded."""
        if self._last is None:
            raise InvalidInput(f"no picture of the camera {camera!r} can be decoded")
        self._write(self._due)


def _pictures(
    recording: Recording, robot: str, refuse: Callable[[str, str], None]
) -> Iterator[tuple[str, CompressedImage]]:
    """The pictures of all cameras of ``robot`` with ascending stamps, each with its camera.

    The packets of a video begin with a key frame, and after a lost one again.
    """
    from zstate.cameras.codecs import PacketOrder  # noqa: PLC0415 - cameras are a plugin
    from zstate.cameras.messages import CompressedImage  # noqa: PLC0415

    orders: dict[str, PacketOrder] = {}
    newest: dict[str, int] = {}
    for writer, message, _ in recording.measurements("image", robot, refuse=refuse):
        assert isinstance(message, CompressedImage)
        camera = writer.edge_writer or writer.stream
        order = orders.get(camera)
        if order is None or order.form != message.format:
            order = orders[camera] = PacketOrder(message.format)
        try:
            order.begins(message.data, (message.session, message.seq))
        except MessageError as error:
            refuse(error.reason, f"{camera!r}: {error}")
            continue
        if camera in newest and message.stamp <= newest[camera]:
            order.skip()
            text = f"{camera!r}: a picture with the stamp {message.stamp} after {newest[camera]}"
            refuse("not later", text)
            continue
        newest[camera] = message.stamp
        yield camera, message


def _nearest(stamps: Stamps, instants: Stamps) -> NDArray[np.intp]:
    """The index of the one of ascending ``stamps`` that is nearest to each of ``instants``."""
    after = np.searchsorted(stamps, instants).clip(0, len(stamps) - 1)
    before = (after - 1).clip(0)
    return np.where(instants - stamps[before] < stamps[after] - instants, before, after)


def _feature(dtype: str, names: list[str] | None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [1 if names is None else len(names)], "names": names}


def _video_feature(size: tuple[int, int], fps: int) -> dict[str, Any]:
    from zstate.cameras.video_file import CODEC, PIXEL_FORMAT  # noqa: PLC0415 - cameras are a plugin

    width, height = size
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": CODEC,
        "video.pix_fmt": PIXEL_FORMAT,
        "video.fps": fps,
        "video.channels": 3,
        "is_depth_map": False,
        "has_audio": False,
    }
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": info,
    }


def _all_statistics(
    rows: Sequence[Columns], histograms: Sequence[Mapping[str, NDArray[np.int64]]], count: int
) -> dict[str, Statistics]:
    """The statistics of each feature over several episodes of ``count`` rows in all."""
    numbers = {name: np.concatenate([one[name] for one in rows]) for name in rows[0]}
    pixels = {name: np.sum([one[name] for one in histograms], axis=0) for name in histograms[0]}
    found = {name: _statistics(values) for name, values in numbers.items()}
    return found | {name: _pixel_statistics(one, count) for name, one in pixels.items()}


def _statistics(values: NDArray[Any]) -> Statistics:
    """Those of each column of ``values``."""
    found = {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0, dtype=np.float64),
        "std": values.std(axis=0, dtype=np.float64),
        **{name: np.quantile(values, level, axis=0) for name, level in _QUANTILES.items()},
    }
    return {name: one.tolist() for name, one in found.items()} | {"count": [len(values)]}


def _pixel_statistics(histogram: NDArray[np.int64], count: int) -> Statistics:
    """Those of red, green and blue from 0 to 1, each (3, 1, 1)."""
    weights = histogram / histogram.sum(axis=1, keepdims=True)
    shares = weights.cumsum(axis=1)
    mean = weights @ _LEVELS
    found = {
        "min": _LEVELS[(histogram > 0).argmax(axis=1)],
        "max": _LEVELS[255 - (histogram[:, ::-1] > 0).argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(weights @ _LEVELS**2 - mean**2, 0.0)),
        **{name: _LEVELS[(shares >= level).argmax(axis=1)] for name, level in _QUANTILES.items()},
    }
    return {name: one.reshape(3, 1, 1).tolist() for name, one in found.items()} | {"count": [count]}


def _histogram(pixels: Pixels) -> NDArray[np.int64]:
    sparse = pixels[::_PIXEL_STEP, ::_PIXEL_STEP].reshape(-1, 3)
    return np.stack([np.bincount(channel, minlength=256) for channel in sparse.T])
