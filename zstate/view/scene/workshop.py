"""Workshop: makes drawings of shapes beside the thread that draws, which reading files would hold up."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from zstate.model.shapes import Color, Shape
from zstate.view.geometry.paths import Missing
from zstate.view.meshes import Drawing, Meshes


@dataclass(frozen=True, eq=False)
class Order:
    """A shape to be drawn in its own colours, or ``over`` all in one. Two orders are never the same.

    ``base`` is the folder of its URDF file, if the user named that.
    """

    shape: Shape
    over: Color | None = None
    base: Path | None = None


@dataclass(frozen=True, eq=False)
class Made:
    """What has become of an order; ``lacks`` are an image or a colour that are missing from it."""

    order: Order
    drawing: Drawing | Missing
    lacks: tuple[Missing, ...] = ()


class Workshop:
    """Orders go in, drawings come out. A thread works while there are orders, and ends with them."""

    def __init__(self, meshes: Meshes) -> None:
        self._meshes = meshes
        self._lock = threading.Lock()
        self._orders: list[Order] = []
        self._made: queue.SimpleQueue[Made] = queue.SimpleQueue()
        self._works = False
        self._open = 0

    @property
    def busy(self) -> bool:
        """Whether something that was ordered has not been fetched yet."""
        return self._open > 0

    def order(self, orders: list[Order]) -> None:
        """Have these made, in this order, after those that wait."""
        with self._lock:
            self._orders += orders
            self._open += len(orders)
            if self._orders and not self._works:
                self._works = True
                threading.Thread(target=self._work, name="zstate-meshes", daemon=True).start()

    def cancel(self, orders: Iterable[Order]) -> None:
        """Do not make those of the orders that are still waiting: the robot is gone."""
        unwanted = set(orders)
        with self._lock:
            kept = [order for order in self._orders if order not in unwanted]
            self._open -= len(self._orders) - len(kept)
            self._orders = kept

    def fetch(self) -> Iterator[Made]:
        """What has been made since."""
        while not self._made.empty():
            self._open -= 1
            yield self._made.get()

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._orders:
                    self._works = False
                    return
                order = self._orders.pop(0)
            self._made.put(self._make(order))

    def _make(self, order: Order) -> Made:
        try:
            drawing = self._meshes.draw(order.shape, order.over, order.base)
            texture = self._meshes.missing_texture(order.shape, order.base) if order.over is None else None
        except Exception as error:  # a file nobody foresaw must not end the drawing of all others
            return Made(order, Missing(str(order.shape.geometry), f"{type(error).__name__}: {error}"))
        lack = drawing.lack if isinstance(drawing, Drawing) else None
        return Made(order, drawing, tuple(one for one in (texture, lack) if one is not None))
