"""The histories that the buffer is made of: the C extension's where it is used, else the reference.

Both behave the same; ``zstate.buffer.compiled`` does the same for paths.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from zstate.extension import kernel

if TYPE_CHECKING or kernel == "reference":
    from zstate.buffer.history import History, insert_together
else:
    import numpy as np
    from numpy.typing import NDArray

    from zstate import _kernel
    from zstate._kernel import insert_together
    from zstate.buffer.history import View

    class History(_kernel.History):
        """``zstate.buffer.history.History`` over memory of the extension."""

        __slots__ = ("_arrays",)

        def replace(self, stamps: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
            super().replace(np.ascontiguousarray(stamps), np.ascontiguousarray(rows))

        @property
        def view(self) -> View:
            """What a reader in Python may rely on; these arrays cannot be written to."""
            block, first, end = self.window
            arrays = getattr(self, "_arrays", (None,))
            if arrays[0] is not block:
                # Made once for each block: waiting readers look after every insert.
                stamps = np.frombuffer(block, np.int64, block.capacity)
                rows = np.frombuffer(block, np.float64, offset=stamps.nbytes)
                arrays = self._arrays = (block, stamps, rows.reshape(block.capacity, block.width))
            return View(arrays[1], arrays[2], first, end)


__all__ = ["History", "insert_together"]
