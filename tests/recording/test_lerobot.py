"""LeRobotDataset v3.0 of recordings: read by pyarrow, pandas and PyAV, and by lerobot itself."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cli_runner import failure, run_cli
from helpers.recording_builder import MS, RRBOT, START, RecordingBuilder, recorded_buffer

av = pytest.importorskip("av", reason="pip install 'zstate[cameras]'")
parquet = pytest.importorskip("pyarrow.parquet", reason="pip install 'zstate[export]'")

from helpers.pictures import jpeg, video  # noqa: E402 - which needs PyAV

from zstate.cameras.messages import CompressedImage  # noqa: E402
from zstate.errors import InvalidInput  # noqa: E402
from zstate.recording.errors import RecordingError  # noqa: E402
from zstate.recording.lerobot import DatasetReport, export_lerobot  # noqa: E402

FPS = 25
PERIOD = 10**9 // FPS
PICTURES = 20
LENGTH_MS = PICTURES * 40
STEP = 12
"""The brightness of a picture is its number times this; H.264 changes it by less than half."""
KEY = "observation.images.wrist"
LEROBOT = Path(__file__).parents[1] / "helpers" / "lerobot_reader.py"


def jitter(number: int) -> int:
    """How much the stamp of a picture differs from the regular one [ns]: up to 9 ms."""
    return (number * 7 % 10 - 4) * 2 * MS if number else 0


def picture_stamp(number: int) -> int:
    return START + 5 * MS + number * PERIOD + jitter(number)


def joint(number: int) -> list[float]:
    """The positions in sample ``number``, of 100 Hz."""
    return [0.3 * np.sin(number / 11.0), 0.01 * number]


def write(
    path: Path,
    *,
    pictures: list[bytes] | None = None,
    form: Any = "jpeg",
    camera: str = "wrist",
    skip: int = -1,
) -> Path:
    """The arm for 0.8 s, and the pictures of its camera, without number ``skip``."""
    data = [jpeg(brightness=STEP * number) for number in range(PICTURES)] if pictures is None else pictures
    samples: list[tuple[int, Any]] = [
        (START + 10 * MS * k - 3 * MS, joint(k)) for k in range(LENGTH_MS // 10 + 1)
    ]
    images = [
        CompressedImage(picture_stamp(number), number, 5, "lens", form, one)
        for number, one in enumerate(data)
        if number != skip
    ]
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        for stamp, content in sorted(samples + [(one.stamp, one) for one in images], key=lambda one: one[0]):
            if isinstance(content, CompressedImage):
                builder.encoder.write_message("arm", content, stamp, camera)
            else:
                builder.joints("arm", stamp, content)
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write(tmp_path / "one.mcap")


def rows_of(folder: Path, episode: int = 0) -> dict[str, np.ndarray]:
    table = parquet.read_table(folder / f"data/chunk-000/file-{episode:03d}.parquet")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def frames_of(folder: Path, episode: int = 0) -> tuple[list[float], list[int]]:
    """The times [s] of the pictures in a video, and the numbers that their brightness tells."""
    times, numbers = [], []
    with av.open(str(folder / f"videos/{KEY}/chunk-000/file-{episode:03d}.mp4")) as container:
        for frame in container.decode(video=0):
            times.append(float(frame.pts * frame.time_base))
            numbers.append(round(float(frame.to_ndarray(format="rgb24")[..., 2].mean()) / STEP))
    return times, numbers


def info_of(folder: Path) -> Any:
    return json.loads((folder / "meta/info.json").read_text())


def export(folder: Path, *paths: Path, **options: Any) -> DatasetReport:
    return export_lerobot(paths, folder, fps=FPS, task="wave", **options)


def test_rows_are_equidistant_and_their_joints_are_those_of_the_buffer(run: Path, tmp_path: Path):
    report = export(tmp_path / "set", run)
    rows = rows_of(tmp_path / "set")
    first, last = picture_stamp(0), picture_stamp(PICTURES - 1)
    instants = first + np.arange((last - first) // PERIOD + 1) * PERIOD
    assert rows["stamp"].tolist() == instants.tolist()
    assert np.abs(rows["timestamp"] - np.arange(len(instants)) / FPS).max() < 1e-6
    assert rows["frame_index"].tolist() == rows["index"].tolist() == list(range(len(instants)))
    assert set(rows["episode_index"]) == set(rows["task_index"]) == {0}
    positions, valid = recorded_buffer(run).joint_positions_many("arm", instants)
    assert valid.all()
    assert np.array_equal(rows["observation.state"], positions.astype(np.float32))
    assert (report.robot, report.episodes, report.rows, report.refused) == ("arm", 1, len(instants), {})


@pytest.mark.parametrize("form", ["jpeg", "h264"])
def test_each_row_has_the_nearest_picture_and_its_true_stamp(tmp_path: Path, form: str):
    packets = None if form == "jpeg" else video(PICTURES, form, key_every=7, step=STEP)
    run = write(tmp_path / "one.mcap", pictures=packets, form=form)
    report = export(tmp_path / "set", run)
    rows = rows_of(tmp_path / "set")
    stamps = np.array([picture_stamp(number) for number in range(PICTURES)])
    nearest = np.abs(stamps[np.newaxis] - rows["stamp"][:, np.newaxis]).argmin(axis=1)
    assert rows["image_stamps"].tolist() == stamps[nearest].tolist()
    times, numbers = frames_of(tmp_path / "set")
    assert numbers == nearest.tolist()
    assert np.abs(np.array(times) - rows["timestamp"]).max() < 1e-4
    assert report.farthest_ns == np.abs(stamps[nearest] - rows["stamp"]).max() <= 10 * MS


def test_metadata_describes_several_recordings_as_episodes(run: Path, tmp_path: Path):
    pandas = pytest.importorskip("pandas")
    two = write(tmp_path / "two.mcap", pictures=[jpeg(brightness=200)] * 10)
    report = export(tmp_path / "set", run, two)
    folder, counts = (
        tmp_path / "set",
        [len(rows_of(tmp_path / "set", episode)["index"]) for episode in (0, 1)],
    )
    info = info_of(folder)
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", FPS, {"train": "0:2"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, sum(counts), 1)
    assert report.rows == sum(counts)
    features = info["features"]
    assert features["observation.state"] == {
        **{"dtype": "float32", "shape": [2]},
        "names": ["shoulder", "elbow"],
    }
    assert (features[KEY]["dtype"], features[KEY]["shape"]) == ("video", [48, 64, 3])
    with av.open(str(folder / info["video_path"].format(video_key=KEY, chunk_index=0, file_index=1))) as file:
        stream = file.streams.video[0]
        own = {
            "codec": stream.codec_context.name,
            "pix_fmt": stream.pix_fmt,
            "fps": float(stream.average_rate),
        }
        assert own == {name: features[KEY]["info"][f"video.{name}"] for name in own}
        assert (stream.frames, own["fps"]) == (counts[1], FPS)
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [one["length"] for one in episodes] == counts
    assert [(one["dataset_from_index"], one["dataset_to_index"]) for one in episodes] == [
        (0, counts[0]),
        (counts[0], sum(counts)),
    ]
    assert [one[f"videos/{KEY}/file_index"] for one in episodes] == [0, 1]
    assert [one[f"videos/{KEY}/from_timestamp"] for one in episodes] == [0.0, 0.0]
    assert episodes[1][f"videos/{KEY}/to_timestamp"] == pytest.approx(counts[1] / FPS)
    assert [one["tasks"] for one in episodes] == [["wave"]] * 2
    assert rows_of(folder, 1)["index"].tolist() == list(range(counts[0], sum(counts)))
    tasks = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert (tasks.index.tolist(), tasks["task_index"].tolist()) == (["wave"], [0])


def test_statistics_are_those_of_all_rows_and_of_the_pictures(run: Path, tmp_path: Path):
    export(tmp_path / "set", run, write(tmp_path / "two.mcap"))
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    states = np.concatenate([rows_of(tmp_path / "set", one)["observation.state"] for one in (0, 1)])
    state = stats["observation.state"]
    for name, expected in {
        **{"min": states.min(axis=0), "max": states.max(axis=0)},
        **{"mean": states.mean(axis=0), "std": states.std(axis=0)},
        **{"q01": np.quantile(states, 0.01, axis=0), "q90": np.quantile(states, 0.9, axis=0)},
    }.items():
        assert state[name] == pytest.approx(expected, rel=1e-5), name
    assert state["count"] == [len(states)]
    _, numbers = frames_of(tmp_path / "set")
    blue = np.array(numbers) * STEP / 255.0
    pixels = stats[KEY]
    assert np.shape(pixels["mean"]) == np.shape(pixels["q50"]) == (3, 1, 1)
    assert pixels["mean"][2][0][0] == pytest.approx(blue.mean(), abs=0.01)
    assert pixels["std"][2][0][0] == pytest.approx(blue.std(), abs=0.01)
    assert pixels["q50"][2][0][0] == pytest.approx(np.median(blue), abs=STEP / 255.0)


def test_a_video_goes_on_with_the_key_frame_after_a_lost_packet(tmp_path: Path):
    run = write(
        tmp_path / "one.mcap", pictures=video(PICTURES, "h264", key_every=5, step=STEP), form="h264", skip=7
    )
    report = export(tmp_path / "set", run)
    assert report.refused == {"no key frame": 2}  # 8 and 9
    _, numbers = frames_of(tmp_path / "set")
    assert set(numbers) & {7, 8, 9} == set()
    shown = rows_of(tmp_path / "set")["image_stamps"]
    assert [picture_stamp(number) for number in numbers] == shown.tolist()


def test_a_broken_picture_is_counted_and_replaced_by_the_next_one(tmp_path: Path):
    pictures = [jpeg(brightness=STEP * number) for number in range(PICTURES)]
    whole = pictures[6]
    middle = whole.index(b"\xff\xda")
    pictures[6] = whole[: middle + 2] + b"\x00\x03\x00" + b"\xff\xd9"  # no components in its scan
    report = export(tmp_path / "set", write(tmp_path / "one.mcap", pictures=pictures))
    assert report.refused == {"broken": 1}
    _, numbers = frames_of(tmp_path / "set")
    assert 6 not in numbers
    assert [picture_stamp(number) for number in numbers] == rows_of(tmp_path / "set")["image_stamps"].tolist()


def test_recordings_that_make_no_dataset_are_refused_with_the_reason(run: Path, tmp_path: Path):
    def text(*paths: Path, **options: Any) -> str:
        with pytest.raises((InvalidInput, RecordingError)) as caught:
            export(tmp_path / "set", *paths, **options)
        assert not list(tmp_path.glob("set*"))
        return str(caught.value)

    assert "has no pictures of 'arm'" in text(write(tmp_path / "blind.mcap", pictures=[]))
    with RecordingBuilder(tmp_path / "still.mcap", "arm") as builder:
        builder.describe("arm")
        builder.encoder.write_message(
            "arm", CompressedImage(START, 0, 5, "lens", "jpeg", jpeg()), START, "wrist"
        )
    assert "does not hold the joint_states of one robot" in text(tmp_path / "still.mcap")
    with RecordingBuilder(tmp_path / "apart.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START, [0.0, 0.0])
        late = CompressedImage(START + 10**9, 0, 5, "lens", "jpeg", jpeg())
        builder.encoder.write_message("arm", late, late.stamp, "wrist")
    assert "has no instant with all of its data" in text(tmp_path / "apart.mcap")
    assert "even width and height" in text(write(tmp_path / "odd.mcap", pictures=[jpeg(63, 48)] * PICTURES))
    other = write(tmp_path / "other.mcap", camera="head")
    assert "episodes of one dataset have the same" in text(run, other)
    large = [jpeg()] * 5 + [jpeg(128, 96)] * (PICTURES - 5)
    assert "it changes from (64, 48) to (128, 96)" in text(write(tmp_path / "large.mcap", pictures=large))


def test_a_folder_is_replaced_only_on_request_and_if_it_is_a_dataset(run: Path, tmp_path: Path):
    folder = tmp_path / "set"
    export(folder, run)
    with pytest.raises(RecordingError, match="exists; choose another name"):
        export(folder, run)
    export(folder, run, run, overwrite=True)
    assert info_of(folder)["total_episodes"] == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("text")
    with pytest.raises(RecordingError, match="no LeRobotDataset, and is not replaced"):
        export(tmp_path / "mine", run, overwrite=True)
    assert (tmp_path / "mine/thesis.txt").read_text() == "text"


def test_the_command_exports_several_recordings(run: Path, tmp_path: Path):
    two, folder = write(tmp_path / "two.mcap"), tmp_path / "set"
    output = run_cli("export", str(run), str(two), "arm", "--lerobot", str(folder), "--task", "wave").stdout
    assert " ".join(output.split()).startswith("exported 2 episodes with ")
    assert "pictures of wrist (64 x 48), at most" in " ".join(output.split())
    assert (info_of(folder)["fps"], info_of(folder)["robot_type"]) == (30, RRBOT.name)
    assert "--overwrite" in failure("export", str(run), "--lerobot", str(folder))
    assert "--lerobot writes a folder" in failure("export", str(run), "--lerobot", "x", "--csv", code=2)
    assert "name its folder" in failure("export", str(run), "--csv", "--fps", "5", code=2)
    assert "makes one file" in failure("export", str(run), str(two), "arm", "--csv", code=2)


@pytest.mark.soak
@pytest.mark.lerobot
def test_lerobot_itself_reads_rows_and_pictures(run: Path, tmp_path: Path):
    folder = tmp_path / "set"
    export(folder, run, write(tmp_path / "two.mcap"))
    command = [os.environ["ZSTATE_LEROBOT_PYTHON"], str(LEROBOT), str(folder)]
    read = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    expected = [rows_of(folder, episode) for episode in (0, 1)]
    assert (read["episodes"], read["fps"], read["task"]) == (2, FPS, "wave")
    for name in ("observation.state", "stamp", "image_stamps", "timestamp", "frame_index", "index"):
        ours = np.concatenate([rows[name] for rows in expected])
        assert np.array_equal(np.array(read["rows"][name], ours.dtype).reshape(ours.shape), ours), name
    numbers = [number for episode in (0, 1) for number in frames_of(folder, episode)[1]]
    assert [round(blue * 255 / STEP) for blue in read["blue"]] == numbers
    assert read["shape"] == [3, 48, 64]
