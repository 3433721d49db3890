"""Clouds of lidars and depth cameras: those of the last seconds, in colours, as many points as are drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, TypeAlias, get_args

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import LookupFailed
from zstate.view.scene.world import SENSOR_COLORS, STALE_COLOR, DrawnFrames, PointNodes
from zstate.view.thinned_cloud import ThinnedCloud
from zstate.view.world_source import CLOUD_POINTS, Sensor, WorldData, WriterName

CloudColor: TypeAlias = Literal["height", "intensity", "ring", "rgb", "sensor"]
CLOUD_COLORS: tuple[CloudColor, ...] = get_args(CloudColor)

_POINT_SIZE_M = 0.015
_SPECTRUM = (48, 60, 170), (25, 140, 225), (30, 190, 130), (170, 205, 50), (250, 170, 40), (205, 40, 40)
"""The colours from the smallest to the largest value."""
_STEPS = 256
_PERCENTILES = 1.0, 99.0
"""The percentiles between which the values of a cloud get different colours."""
_WIDER = 0.1
"""How much of the range a value may be beyond it before all points are coloured again."""
_SPARE = 1.25
"""For so many times the clouds of the window there are points, so that the next few do not thin out all."""

_AT_ONCE = 200_000
"""The points of a sensor that are drawn in one picture of the page, the newest first; it takes 20 ms."""

Floats = NDArray[np.float32]
Colors = NDArray[np.uint8]

_STALE = np.array(STALE_COLOR, np.uint8)


@dataclass(eq=False)
class _DrawnCloud:
    """A node and what its colours are of; ``height`` is z in the frame in which it was placed [m]."""

    node: viser.PointCloudHandle
    points: int
    height: Floats
    intensity: Floats | None
    ring: Floats | None
    rgb: Colors | None
    is_colored: bool = False


_VALUES: Mapping[CloudColor, Callable[[_DrawnCloud], Floats | None]] = {
    "height": lambda drawn: drawn.height,
    "intensity": lambda drawn: drawn.intensity,
    "ring": lambda drawn: drawn.ring,
}


class Clouds:
    """Draws the clouds of all sensors. ``show`` uses the attributes, which the page changes.

    ``window_s`` is the time that is accumulated [s]; with 0 the newest cloud of each sensor is drawn.
    ``points`` are drawn at most, an equal share of each sensor. ``missing`` are the sensors with clouds that
    cannot be drawn, with the reason. To be used by one thread.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self.is_on = True
        self.color: CloudColor = "height"
        self.window_s = 2.0
        self.points = 200_000
        self.missing: Sequence[tuple[str, str]] = ()
        self._scene = scene
        self._drawn: dict[WriterName, SensorClouds] = {}
        self._count = 0

    @property
    def has_any(self) -> bool:
        """Whether there is a sensor with clouds."""
        return bool(self._drawn)

    @property
    def busy(self) -> bool:
        """Whether some clouds are still to be drawn."""
        return any(clouds.busy for clouds in self._drawn.values())

    def show(self, source: WorldData, buffer: TransformBuffer, place: DrawnFrames, at: int | None) -> None:
        """Draw the last clouds ``at`` a stamp [ns]; None: the newest."""
        sensors = source.clouds
        for name in self._drawn.keys() - sensors.keys():
            self._drawn.pop(name).remove()
        missing: list[tuple[str, str]] = []
        for name, sensor in sensors.items():
            if name not in self._drawn:
                color = SENSOR_COLORS[self._count % len(SENSOR_COLORS)]
                nodes = PointNodes(self._scene, f"/clouds/{self._count}", _POINT_SIZE_M)
                self._drawn[name] = SensorClouds(nodes, buffer, np.array(color, np.uint8))
                self._count += 1
            clouds = self._drawn[name]
            window_s = self.window_s if self.is_on else None
            most = self.points // len(sensors)
            clouds.show(sensor, place, at, window_s=window_s, most=most, color=self.color)
            source.limit_clouds(name, clouds.share)
            if sensor.problem is not None:
                missing.append((f"clouds of {name}", sensor.problem))
        self.missing = missing


class SensorClouds:
    """The last clouds of one sensor, a node for each; those of a stale sensor are grey.

    Each point is placed by the pose at its own stamp, once: a node does not move afterwards, unless its tree
    is not connected to the fixed frame. ``share`` is how many points of each cloud are drawn. While many are
    drawn again the sensor is ``busy``.
    """

    def __init__(self, nodes: PointNodes, buffer: TransformBuffer, color: Colors) -> None:
        self.share = CLOUD_POINTS
        self.busy = False
        self._nodes = nodes
        self._buffer = buffer
        self._color = color
        self._target = ""
        self._drawn: dict[ThinnedCloud, _DrawnCloud] = {}
        self._room = 0
        self._room_for: tuple[float, int] | None = None
        self._look: tuple[CloudColor, bool] = "height", False
        self._range: tuple[float, float] | None = None

    def show(
        self,
        sensor: Sensor[ThinnedCloud],
        place: DrawnFrames,
        at: int | None,
        *,
        window_s: float | None,
        most: int,
        color: CloudColor,
    ) -> None:
        """Draw ``most`` points of the last ``window_s`` until ``at`` [ns]; None: no clouds."""
        frame = sensor.frame
        if frame is None:
            return
        target = place.connected(frame)
        sensor.settle(self._buffer, target, at)
        clouds: Sequence[ThinnedCloud] = ()
        pose = place.pose(target)
        if window_s is not None:
            clouds = sensor.within(round(window_s * 1e9), at)
            self._share(clouds, window_s, most)
        if pose is None or frame not in place.tree.index:
            clouds = ()
        else:
            self._nodes.move(pose)
        self._draw(clouds, target)
        self._apply_colors(color, is_stale=sensor.is_stale(at))

    def remove(self) -> None:
        """Remove the clouds from the scene."""
        self._nodes.remove()

    def _share(self, clouds: Sequence[ThinnedCloud], window_s: float, most: int) -> None:
        """Divide ``most`` points among the clouds that fit into the window at their present rate."""
        count = len(clouds)
        if count > 1:
            length_s = (clouds[-1].end_stamp - clouds[0].end_stamp) / 1e9
            count = max(count, math.ceil(window_s * (count - 1) / max(length_s, 1e-3)))
        if self._room_for != (window_s, most) or not 2 * count >= self._room >= count:
            self._room_for = window_s, most
            self._room = count if count < 2 else math.ceil(_SPARE * count)
        self.share = max(most // max(self._room, 1), 1)

    def _draw(self, clouds: Sequence[ThinnedCloud], target: str) -> None:
        is_moved, self._target = target != self._target, target
        kept = set(clouds)
        for cloud, drawn in list(self._drawn.items()):
            if is_moved or cloud not in kept or drawn.points != min(len(cloud), self.share):
                self._nodes.hide(self._drawn.pop(cloud).node)
        left = _AT_ONCE
        for cloud in reversed(clouds):
            if cloud not in self._drawn and left > 0:
                self._drawn[cloud] = self._placed(cloud.thinned(self.share))
                left -= self._drawn[cloud].points
        self.busy = len(self._drawn) < len(clouds)

    def _placed(self, cloud: ThinnedCloud) -> _DrawnCloud:
        """A new node; without the points that have no pose, which are before the buffer's history."""
        try:
            placed, valid = self._buffer.place(cloud.xyz, cloud.stamps, cloud.frame, self._target)
        except LookupFailed:  # the tree has changed since
            placed, valid = cloud.xyz, np.zeros(len(cloud), np.bool_)
        points = placed[valid].astype(np.float32, copy=False)
        return _DrawnCloud(
            self._nodes.add(points, self._color),
            len(cloud),
            points[:, 2],
            None if cloud.intensity is None else cloud.intensity[valid],
            None if cloud.ring is None else cloud.ring[valid],
            None if cloud.rgb is None else cloud.rgb[valid],
        )

    def _apply_colors(self, color: CloudColor, *, is_stale: bool) -> None:
        """Colour new clouds; all of them if the range of their values grows, or by another value."""
        all_drawn = self._drawn.values()
        bare = [drawn for drawn in all_drawn if not drawn.is_colored]
        look = color, is_stale
        if look != self._look:
            self._look, self._range, bare = look, None, [*all_drawn]
        values_of = None if is_stale else _VALUES.get(color)
        if values_of is not None and self._widen([values_of(drawn) for drawn in bare]):
            bare = [*all_drawn]
        for drawn in bare:
            drawn.node.colors = _STALE if is_stale else self._colors(drawn, color)
            drawn.is_colored = True

    def _widen(self, values: Sequence[Floats | None]) -> bool:
        """Widen the range of the colours to ``values``. Returns whether it was too narrow."""
        known = [one[np.isfinite(one)] for one in values if one is not None]
        ends = [np.percentile(one, _PERCENTILES).tolist() for one in known if one.size]
        if not ends:
            return False
        low, high = min(low for low, _ in ends), max(high for _, high in ends)
        if self._range is not None:
            lowest, highest = self._range
            spare = _WIDER * (highest - lowest)
            if lowest - spare <= low and high <= highest + spare:
                return False
            low, high = min(low, lowest), max(high, highest)
        self._range = low, high
        return True

    def _colors(self, drawn: _DrawnCloud, color: CloudColor) -> Colors:
        """The colour of each point; that of the sensor if its clouds do not have the value."""
        if color == "rgb" and drawn.rgb is not None:
            return drawn.rgb
        values_of = _VALUES.get(color)
        values = None if values_of is None else values_of(drawn)
        return self._color if values is None or self._range is None else spectrum(values, *self._range)


def spectrum(values: Floats, low: float, high: float) -> Colors:
    """The colours of ``values`` (N,) from blue at ``low`` to red at ``high``: (N, 3). NaN is blue."""
    steps = np.nan_to_num((values - low) * ((_STEPS - 1) / max(high - low, 1e-9)))
    return _spectrum_table()[steps.clip(0, _STEPS - 1).astype(np.uint8)]


@cache
def _spectrum_table() -> Colors:
    """``_STEPS`` colours between those of the spectrum."""
    table = np.empty((_STEPS, 3), np.uint8)
    for channel, levels in enumerate(np.transpose(_SPECTRUM)):
        table[:, channel] = np.interp(
            np.linspace(0.0, 1.0, _STEPS), np.linspace(0.0, 1.0, len(levels)), levels
        )
    return table
