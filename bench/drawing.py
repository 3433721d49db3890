"""Style, labels and files shared by all plots of a report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

import matplotlib as mpl
import matplotlib.ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

P = ParamSpec("P")
F = TypeVar("F")

INK, FAINT, GRID = "#222222", "#767676", "#E4E4E4"


@dataclass(frozen=True)
class LineStyle:
    """Colour, marker and dashes of one subject in every plot."""

    color: str
    marker: str = "o"
    dashes: str = "-"


# Okabe and Ito's colours, which are distinguishable with colour blindness; members of a family differ by
# marker and dashes.
LINE_STYLES: Mapping[str, LineStyle] = {
    "zstate_peer": LineStyle("#0072B2"),
    "zstate_router": LineStyle("#0072B2", "s", "--"),
    "zstate_ros2": LineStyle("#56B4E9", "D"),
    "zstate_mtls": LineStyle("#56B4E9", "^", "--"),
    "ros1": LineStyle("#D55E00"),
    "ros1_cpp": LineStyle("#D55E00", "s", "--"),
    "ros1_default": LineStyle("#E69F00", "v"),
    "ros2": LineStyle("#CC79A7"),
    "cyclone": LineStyle("#009E73"),
    "raw_zenoh": LineStyle("#888888"),
    "raw_zenoh_router": LineStyle("#888888", "s", "--"),
}
UNKNOWN_STYLE = LineStyle("#000000", "x")
NEAR = 1.2
ROLE_SHADES = (1.0, 0.62, 0.34)
"""Opacity of the CPU bars of writer, reader and other processes, in the subject's colour."""


def line_style(subject: str) -> LineStyle:
    """The line style of a subject."""
    return LINE_STYLES.get(subject, UNKNOWN_STYLE)


STYLE: Mapping[str, object] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["Inter", "Helvetica Neue", "Arial", "Liberation Sans", "DejaVu Sans"],
    "font.size": 10.5,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 12,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#BBBBBB",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "grid.color": GRID,
    "lines.linewidth": 2.0,
    "lines.markersize": 6.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "zstate",  # the same figures give the same file
}
"""Fonts and lines; text stays text in SVG."""


def styled(draw: Callable[P, F]) -> Callable[P, F]:
    """Runs ``draw`` with ``STYLE``, independent of the user's matplotlib style."""

    @wraps(draw)
    def drawn(*arguments: P.args, **options: P.kwargs) -> F:
        with mpl.rc_context(STYLE):
            return draw(*arguments, **options)

    return drawn


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Writes the figure as SVG and PNG; returns both paths."""
    paths = [folder / f"{name}.svg", folder / f"{name}.png"]
    with mpl.rc_context(STYLE):
        figure.savefig(paths[0], bbox_inches="tight", metadata={"Date": None})
        figure.savefig(paths[1], bbox_inches="tight", dpi=160)
    return paths


def add_footnote(figure: Figure, text: str) -> None:
    """Writes a small explanation below the figure."""
    figure.text(0.0, -0.02, text, fontsize=8.5, color=FAINT, va="top", ha="left")


def label_ends(axes: Axes, ends: Sequence[tuple[float, float, str, str]], gap: float = 0.052) -> None:
    """Writes each line's name at its end without overlap; ``ends`` are x, y, text and colour."""
    axes.autoscale_view()  # otherwise the positions of points are not known yet
    to_axes = axes.transAxes.inverted()
    placed = [
        (to_axes.transform(axes.transData.transform((x, y))), text, color) for x, y, text, color in ends
    ]
    placed.sort(key=lambda one: one[0][1])
    heights = spread([float(at[1]) for at, _, _ in placed], gap)
    for (at, text, color), height in zip(placed, heights, strict=True):
        axes.annotate(
            text,
            xy=(float(at[0]), float(at[1])),
            xytext=(1.035, height),
            xycoords="axes fraction",
            textcoords="axes fraction",
            color=color,
            va="center",
            fontsize=9.5,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": color,
                "alpha": 0.45,
                "lw": 0.7,
                "shrinkA": 1,
                "shrinkB": 5,
                "relpos": (0, 0.5),
            },
        )


def spread(heights: Sequence[float], gap: float) -> list[float]:
    """Moves ascending heights to be at least ``gap`` apart, each cluster about its mean."""
    clusters: list[list[float]] = []
    for height in heights:
        clusters.append([height])
        while len(clusters) > 1 and _bottom(clusters[-1], gap) < _top(clusters[-2], gap) + gap:
            last = clusters.pop()
            clusters[-1].extend(last)
    return [_bottom(cluster, gap) + n * gap for cluster in clusters for n in range(len(cluster))]


def _bottom(cluster: Sequence[float], gap: float) -> float:
    return sum(cluster) / len(cluster) - 0.5 * gap * (len(cluster) - 1)


def _top(cluster: Sequence[float], gap: float) -> float:
    return _bottom(cluster, gap) + gap * (len(cluster) - 1)


def plain_ticks(axes: Axes, which: str, ticks: Sequence[float], text: str = "{:g}") -> None:
    """Sets exactly these ticks; a label is omitted if it is too close to the one before on a log axis."""
    labels: list[str] = []
    last = 0.0
    for tick in ticks:
        is_clear = tick > NEAR * last
        labels.append(text.format(tick) if is_clear else "")
        last = tick if is_clear else last
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(matplotlib.ticker.FixedLocator(list(ticks)))
    axis.set_major_formatter(matplotlib.ticker.FixedFormatter(labels))
    axis.set_minor_locator(matplotlib.ticker.NullLocator())
