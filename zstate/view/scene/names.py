"""Names: a label at each frame, hung on its node, so that nothing is sent when that moves."""

from __future__ import annotations

from typing import Literal

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, Mask
from zstate.view.scene.nodes import Nodes

_SIZE = 0.85
# So many labels of one size on the screen hide all else: they are then as large as things are [m].
_MANY = 40
_HEIGHT_M = 0.028
_SAME_PLACE_M = 0.004


class Names:
    """Draws them while they are on, without the robot's name where only one robot is there.

    Frames in one place, such as the axes of a wrist, have one label with a line for each: labels over
    each other cannot be read.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._labels: dict[str, tuple[str, viser.LabelHandle]] = {}
        self._drawn: tuple[bool, int, bytes] | None = None

    def show(self, on: bool, moment: FramePoses, nodes: Nodes) -> None:
        """Put one at each frame that has a place."""
        joined = _joined(moment, nodes.shown) if on else np.zeros(0, dtype=np.bool_)
        drawn = (on, nodes.version, joined.tobytes())
        if drawn == self._drawn:
            return
        self._drawn = drawn
        texts = _texts(moment, nodes.shown, joined) if on else {}
        size = "scene" if len(texts) > _MANY else "screen"
        for frame in self._labels.keys() - nodes.paths.keys():
            del self._labels[frame]
        for frame, path in nodes.paths.items():
            self._show(frame, path, texts.get(frame), size)

    def _show(self, frame: str, path: str, text: str | None, size: Literal["screen", "scene"]) -> None:
        there, label = self._labels.get(frame, ("", None))
        if label is not None and there != path:
            del self._labels[frame]  # it went with the node that it hung on
            label = None
        if label is not None:
            label.visible = text is not None
            label.text = label.text if text is None else text
            label.font_size_mode = size
        elif text is not None:
            label = self._scene.add_label(
                f"{path}/name",
                text,
                font_size_mode=size,
                font_screen_scale=_SIZE,
                font_scene_height=_HEIGHT_M,
                anchor="bottom-left",
            )
            self._labels[frame] = (path, label)


def _joined(moment: FramePoses, shown: Mask) -> Mask:
    """Which frames are where their parents are."""
    parents = moment.tree.parents
    near: NDArray[np.bool_] = np.linalg.norm(moment.poses[:, :3], axis=1) < _SAME_PLACE_M
    return near & moment.known & (parents >= 0) & shown & shown[parents]


def _texts(moment: FramePoses, shown: Mask, joined: Mask) -> dict[str, str]:
    """The label of each frame that has one."""
    names = moment.tree.names
    robots = {name.partition("/")[0] for name in names if "/" in name}
    lines: dict[int, list[str]] = {}
    hosts: list[int] = []
    for row, name in enumerate(names):
        hosts.append(hosts[int(moment.tree.parents[row])] if joined[row] else row)
        if shown[row]:
            called = name if len(robots) > 1 else name.partition("/")[2] or name
            lines.setdefault(hosts[row], []).append(called)
    return {names[row]: "\n".join(called) for row, called in lines.items()}
