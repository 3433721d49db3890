"""Workshop: makes drawings of shapes beside the thread that draws, which reading files would hold up."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass

from zstate.model.shapes import Color, Shape
from zstate.view.geometry.paths import Missing
from zstate.view.meshes import Drawing, Meshes


@dataclass(frozen=True, eq=False)
class Order:
    """A shape to be drawn in its own colours, or ``over`` all in one. Two orders are never the same."""

    shape: Shape
    over: Color | None = None


@dataclass(frozen=True, eq=False)
class Made:
    """What has become of an order; ``texture`` is an image that is missing from it."""

    order: Order
    drawing: Drawing | Missing
    texture: Missing | None = None


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
            drawing = self._meshes.draw(order.shape, order.over)
            texture = self._meshes.missing_texture(order.shape) if order.over is None else None
        except Exception as error:  # a file nobody foresaw must not end the drawing of all others
            return Made(order, Missing(str(order.shape.geometry), f"{type(error).__name__}: {error}"))
        return Made(order, drawing, texture)
