"""The frames of a robot in an archive: its model and static edges, and a buffer of them."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from zstate.archive.files import Files
from zstate.archive.layout import EDGES, FRAMES, JOINTS, MODELS, PARTS, POSE, SUFFIX, folder_of
from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer, feed_of
from zstate.buffer.stored_samples import load_poses
from zstate.buffer.tracks import JointTrack
from zstate.model.robot import RobotModel, coordinate_names
from zstate.model.urdf import parse_urdf
from zstate.transform import Transform

Track = tuple[str, str]
"""What one file has samples of: its stream, and its key (``layout``)."""


@lru_cache(maxsize=16)
def _parsed(urdf: str, robot: str) -> RobotModel:
    return parse_urdf(urdf, f"the URDF of {robot!r}")


@dataclass(frozen=True, eq=False)
class Scene:
    """The frames of ``robot`` while the same recording, or recordings alike, went on.

    ``model`` is None without a usable one. ``parts`` are the keys of drivers by the joints that they move.
    """

    robot: str
    model: RobotModel | None
    statics: tuple[tuple[Transform, str | None], ...]
    parts: Mapping[str, str]

    @classmethod
    def read(cls, files: Files, robot: str, digest: str) -> Scene:
        """The scene with the ``digest``. Raises RecordingError for files that cannot be read."""
        model: RobotModel | None = None
        statics: list[tuple[Transform, str | None]] = []
        parts: dict[str, str] = {}
        for row in files.ledger.table(f"{folder_of(FRAMES, robot)}/{digest}{SUFFIX}").to_pylist():
            if row["kind"] == "static":
                pose = tuple(row[name] for name in POSE)
                edge = Transform.trusted(row["parent"], row["child"], pose, None, "static")
                statics.append((edge, row["writer"]))
            elif row["kind"] == "model":
                ((urdf,),) = (
                    files.ledger.table(f"{folder_of(MODELS)}/{row['model']}{SUFFIX}")
                    .column("urdf")
                    .to_pylist(),
                )
                model = _parsed(urdf, robot)
            else:
                parts[row["child"]] = row["parent"]
        return cls(robot, model, tuple(statics), parts)

    def buffer(self, edges: Iterable[tuple[str, str]]) -> SceneBuffer:
        """A buffer of the frames, and of the moving ``edges``, which have a placeholder each."""
        buffer = TransformBuffer(RECORDING_HISTORY_S)
        feed = feed_of(buffer)
        feed.set_recording()
        feed.name_robot(self.robot)
        tracks: dict[Track, JointTrack] = {}
        if self.model is not None:
            tracks[JOINTS, ""] = whole = buffer.add_robot(self.model, self.robot)
            for key in dict.fromkeys(self.parts.values()):
                tracks[PARTS, key] = feed.add_part(whole, key.split(" "))
            if self.parts:
                feed.assign_joints(whole, {joint: tracks[PARTS, key] for joint, key in self.parts.items()})
        for transform, writer in self.statics:
            buffer.insert_static(transform, writer=writer)
        for edge in edges:
            load_poses(feed, edge, np.zeros(1, np.int64), np.array([[0.0] * 6 + [1.0]]), None)
        return SceneBuffer(self, buffer, tracks)


@dataclass(frozen=True, eq=False)
class SceneBuffer:
    """A ``buffer`` of a ``scene``, with its joint tracks by the files that have their samples."""

    scene: Scene
    buffer: TransformBuffer
    tracks: Mapping[Track, JointTrack]

    def needed(self, target: str, source: str) -> dict[Track, set[str]]:
        """The tracks that lookups read, and of joints the coordinates. Raises as ``TransformBuffer.plan``."""
        found: dict[Track, set[str]] = {}
        model = self.scene.model
        for _, frame in self.buffer.path_frames(target, source):
            if frame is None or frame.kind not in ("pose", "joint"):
                continue
            if frame.kind == "pose":
                found[EDGES, frame.name] = set()
            elif model is not None and frame.joint is not None:
                key = self.scene.parts.get(frame.joint, "")
                track = PARTS if key else JOINTS, key
                found.setdefault(track, set()).update(coordinate_names(model.part([frame.joint])))
        return found
