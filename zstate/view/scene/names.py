"""Names: a label at each frame, hung on its node, so that nothing is sent when that moves."""

from __future__ import annotations

import viser

from zstate.view.scene.nodes import Nodes

_SIZE = 0.85


class Names:
    """Draws them while they are ``on``: without the robot's name where only one robot is there."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._labels: dict[str, tuple[str, viser.LabelHandle]] = {}
        self._drawn = (False, -1)

    def show(self, on: bool, nodes: Nodes) -> None:
        """Put one at each frame that has a place."""
        if self._drawn == (on, nodes.version):
            return
        self._drawn = (on, nodes.version)
        texts = _texts(list(nodes.paths))
        for frame in self._labels.keys() - nodes.paths.keys():
            del self._labels[frame]
        for frame, path in nodes.paths.items():
            self._show(frame, path, texts[frame], on and nodes.is_shown(frame))

    def _show(self, frame: str, path: str, text: str, visible: bool) -> None:
        there, label = self._labels.get(frame, ("", None))
        if label is None or there != path:
            if visible:
                label = self._scene.add_label(
                    f"{path}/name", text, font_screen_scale=_SIZE, anchor="bottom-left"
                )
                self._labels[frame] = (path, label)
            return
        label.visible = visible
        label.text = text


def _texts(frames: list[str]) -> dict[str, str]:
    """What each is called on the picture."""
    robots = {frame.partition("/")[0] for frame in frames if "/" in frame}
    if len(robots) > 1:
        return {frame: frame for frame in frames}
    return {frame: frame.partition("/")[2] or frame for frame in frames}
