"""Silences: which robots say nothing, with a label that says so at each one's root."""

from __future__ import annotations

import viser

from zstate.buffer.snapshot import FrameTable
from zstate.view.scene.nodes import Nodes


class Silences:
    """The text of each silent robot, and its label."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._texts: dict[str, str] = {}
        self._labels: dict[str, tuple[str, viser.LabelHandle]] = {}
        self._tree: FrameTable | None = None
        self._firsts: dict[str, str] = {}

    def set(self, robot: str, text: str | None) -> None:
        """A robot is silent, which ``text`` says, or is not: None."""
        if text is None:
            self._texts.pop(robot, None)
        else:
            self._texts[robot] = text

    def is_silent(self, robot: str) -> bool:
        """Whether that was said last."""
        return robot in self._texts

    def frames(self, tree: FrameTable) -> frozenset[str]:
        """The frame of each silent robot that its label hangs on: the first, for parents stand first."""
        if tree is not self._tree:
            self._tree, self._firsts = tree, {}
            for name in tree.names:
                self._firsts.setdefault(name.partition("/")[0], name)
        return frozenset(self._firsts[robot] for robot in self._texts if robot in self._firsts)

    def show(self, nodes: Nodes) -> None:
        """Draw the labels at the first frame of each silent robot."""
        for robot in self._labels.keys() - self._texts.keys():
            path, label = self._labels.pop(robot)
            if path == self._path(robot, nodes):
                label.remove()
        for robot, text in self._texts.items():
            self._show(robot, f"{robot}: {text}", self._path(robot, nodes))

    def _show(self, robot: str, text: str, path: str | None) -> None:
        there, label = self._labels.get(robot, (None, None))
        if path is None:
            self._labels.pop(robot, None)
        elif label is None or there != path:
            label = self._scene.add_label(f"{path}/silence", text, anchor="top-center")
            self._labels[robot] = (path, label)
        else:
            label.text = text

    def _path(self, robot: str, nodes: Nodes) -> str | None:
        return nodes.paths.get(self._firsts.get(robot, ""))
