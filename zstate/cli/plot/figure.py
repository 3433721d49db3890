"""Curves as a figure of Matplotlib."""

# pyright: reportUnknownMemberType=false
# Matplotlib's annotations leave keyword arguments out

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from zstate.cli.plot.curves import Curves
from zstate.errors import InvalidInput, LibraryMissing

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise LibraryMissing(
        f"plots need Matplotlib, which cannot be loaded ({error}): pip install 'zstate[plot]'"
    ) from None

_WIDTH, _HEIGHT, _PANEL = 10.0, 4.5, 3.2
_LABELS = {"rad": "position [rad]", "m": "position [m]", "": "position"}
_LEGEND_ROWS = 16
_COLORS = 10
_STYLES = ("solid", "dashed", "dotted", "dashdot")

# Stamps before 1973 are those of a simulation or a log.
_NO_DATE_NS = 10**17


def draw_joints(curves: Curves, title: str, path: Path) -> None:
    """Each joint over time, angles and lengths apart, into ``path``."""
    units = [unit for unit in _LABELS if unit in curves.units]
    heights = [_HEIGHT if len(units) == 1 else _PANEL] * len(units)
    figure = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
    figure.suptitle(title, fontweight="bold")
    panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)
    for unit, panel in zip(units, panels[:, 0], strict=True):
        assert isinstance(panel, Axes)
        _plot(panel, curves.of_unit(unit))
        panel.set_ylabel(_LABELS[unit])
    panels[-1, 0].set_xlabel(_time_label(curves))
    _save(figure, path)


def draw_path(curves: Curves, title: str, path: Path) -> None:
    """The three coordinates over time, and the way seen from above, into ``path``."""
    figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
    figure.suptitle(title, fontweight="bold")
    over_time, above = figure.subplots(1, 2, width_ratios=[3, 2])
    assert isinstance(over_time, Axes)
    assert isinstance(above, Axes)
    _plot(over_time, curves)
    over_time.set_xlabel(_time_label(curves))
    over_time.set_ylabel(_LABELS["m"])
    x, y = curves.values[:, 0], curves.values[:, 1]
    above.plot(x, y, color="0.4", linewidth=1.0)
    above.plot(x[:1], y[:1], "o", color="tab:green", label="first")
    above.plot(x[-1:], y[-1:], "s", color="tab:red", label="last")
    above.set_title("from above", fontsize="medium")
    above.set_xlabel("x [m]")
    above.set_ylabel("y [m]")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(fontsize="small")
    above.grid(visible=True, alpha=0.3)
    _save(figure, path)


def _plot(panel: Axes, curves: Curves) -> None:
    for number, name in enumerate(curves.names):
        style = _STYLES[number // _COLORS % len(_STYLES)]
        panel.plot(
            curves.seconds,
            curves.values[:, number],
            label=name,
            color=f"C{number % _COLORS}",
            linestyle=style,
            linewidth=1.3,
        )
    panel.grid(visible=True, alpha=0.3)
    panel.margins(x=0.01)
    rows = -(-len(curves.names) // _LEGEND_ROWS)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", ncols=rows, frameon=False)


def _time_label(curves: Curves) -> str:
    first = int(curves.stamps[0])
    if first < _NO_DATE_NS:
        return f"time since {first * 1e-9:.3f} s [s]"
    began = datetime.fromtimestamp(first // 1_000_000_000).astimezone()
    return f"time since {began:%Y-%m-%d %H:%M:%S %Z} [s]"


def _save(figure: Figure, path: Path) -> None:
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InvalidInput(f"cannot write {str(path)!r}: {error.strerror or error}") from None
