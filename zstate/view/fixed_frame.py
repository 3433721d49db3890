"""FixedFrame: the frame that everything is seen from."""

from __future__ import annotations

import numpy as np

from zstate.buffer.snapshot import FrameTable


class FixedFrame:
    """The frame that was chosen, while it is there; else the root that carries the most frames."""

    def __init__(self, chosen: str = "") -> None:
        self.chosen = chosen
        """What was asked for; empty for nothing in particular."""
        self._tree: FrameTable | None = None
        self._default = ""

    def of(self, tree: FrameTable) -> str:
        """Its name; empty where there is no frame at all."""
        if tree is not self._tree:
            self._tree, self._default = tree, default_fixed_frame(tree)
        return self.chosen if self.chosen in tree.index else self._default


def default_fixed_frame(tree: FrameTable) -> str:
    """The root with the most frames, of equal ones the first; empty where there is none."""
    if not tree.names:
        return ""
    return tree.names[int(np.bincount(tree.roots).argmax())]
