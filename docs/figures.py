"""Writes the figures of the pages: docs/figures/*.svg.

python docs/figures.py

Each figure has a background of its own, and follows the colour scheme of the reader. Numbers in figures are
computed here, with zstate where it has the method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

import zstate
from zstate.cameras import Camera

FOLDER = Path(__file__).with_name("figures")
Point = tuple[float, float]

_STYLE = """\
.bg{fill:#fff;stroke:#d5dae1}.box{fill:#f3f6fa;stroke:#8b97a8}.a,.fa{stroke:#1f6fd6}.b,.fb{stroke:#c2620a}\
.c,.fc{stroke:#1d8a4b}.r,.fr{stroke:#c9302c}.m,.fm{stroke:#8b97a8}.fa{fill:#e3eefc}.fb{fill:#fdeedd}\
.fc{fill:#e0f4e8}.fr{fill:#fbe3e2}.fm{fill:#eceff3}.a,.b,.c,.r,.m{fill:none}\
path,line,ellipse,polyline{stroke-width:1.6}.thin{stroke-width:.8}.dash{stroke-dasharray:5 4}\
text{font:14px system-ui,"DejaVu Sans",sans-serif;fill:#1d2733}.s{font-size:12px}.t{fill:#5d6b7c}\
.code{font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:12.5px}.bold{font-weight:600}\
.ta{fill:#1f6fd6}.tb{fill:#a8540a}.tc{fill:#1a7a43}.tr{fill:#c9302c}.da{fill:#1f6fd6}.db{fill:#c2620a}\
.dc{fill:#1d8a4b}.dr{fill:#c9302c}.dm{fill:#8b97a8}
@media(prefers-color-scheme:dark){.bg{fill:#161b22;stroke:#30363d}.box{fill:#222933;stroke:#7d8a9b}\
text{fill:#e3e8ee}.t{fill:#9fabb9}.fa{fill:#17304f}.fb{fill:#40290f}.fc{fill:#12381f}.fr{fill:#451b1a}\
.fm{fill:#2a313b}.a,.fa{stroke:#6cabf7}.b,.fb{stroke:#f0a04b}.c,.fc{stroke:#5fcf8c}.r,.fr{stroke:#f47c78}\
.ta,.da{fill:#6cabf7}.tb,.db{fill:#f0a04b}.tc,.dc{fill:#5fcf8c}.tr,.dr{fill:#f47c78}}
"""


class Figure:
    """A drawing; x is to the right, y down [px]. Classes of CSS are colours: a, b, c, r (red), m (grey)."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self._parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">',
            f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>",
            '<defs><marker id="h" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            'orient="auto-start-reverse"><path d="M0 0 8 4 0 8z" class="dm"/></marker></defs>',
            f'<rect x=".5" y=".5" width="{width - 1}" height="{height - 1}" rx="8" class="bg"/>',
        ]

    def svg(self) -> str:
        """The file."""
        return "\n".join([*self._parts, "</svg>\n"])

    def text(self, x: float, y: float, text: str, css: str = "", anchor: str = "middle") -> None:
        """Lines of text, 17 px apart; the first has its baseline at ``y``."""
        for n, line in enumerate(text.split("\n")):
            place = f'x="{x:g}" y="{y + 17 * n:g}" text-anchor="{anchor}"'
            self._parts.append(f'<text {place} class="{css}">{escape(line)}</text>')

    def box(self, x: float, y: float, size: Point, text: str, css: str = "box") -> None:
        """A rounded rectangle; the first line of its text is bold, the others are small."""
        width, height = size
        shape = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6"'
        self._parts.append(f'<rect {shape} class="{css}"/>')
        lines = text.split("\n")
        top = y + height / 2 - 8.5 * (len(lines) - 1) + 5
        for n, line in enumerate(lines):
            self.text(x + width / 2, top + 17 * n, line, "bold" if n == 0 else "s t")

    def path(self, points: Iterable[Point], css: str = "m", heads: str = "") -> None:
        """A line through points; ``heads`` has ">" for an arrow at its end and "<" for one at its start."""
        places = " ".join(f"{x:.4g} {y:.4g}" for x, y in points)
        ends = ' marker-end="url(#h)"' if ">" in heads else ""
        ends += ' marker-start="url(#h)"' if "<" in heads else ""
        self._parts.append(f'<path d="M{places}" class="{css}" style="fill:none"{ends}/>')

    def arrow(self, start: Point, end: Point, label: str = "", css: str = "m", heads: str = ">") -> None:
        """A straight arrow, with its label above its middle."""
        self.path((start, end), css, heads)
        if label:
            self.text((start[0] + end[0]) / 2, (start[1] + end[1]) / 2 - 7, label, "s t")

    def dots(self, points: Iterable[Point], css: str = "da", radius: float = 3.5) -> None:
        """Filled circles."""
        for x, y in points:
            self._parts.append(f'<circle cx="{x:.4g}" cy="{y:.4g}" r="{radius:g}" class="{css}"/>')

    def ellipse(self, center: Point, axes: Point, degrees: float, css: str) -> None:
        """An ellipse with half axes, turned clockwise."""
        turn = f'transform="rotate({degrees:.1f} {center[0]:.4g} {center[1]:.4g})"'
        shape = f'cx="{center[0]:.4g}" cy="{center[1]:.4g}" rx="{axes[0]:.4g}" ry="{axes[1]:.4g}"'
        self._parts.append(f'<ellipse {shape} {turn} class="{css}"/>')

    def caption(self, y: float, text: str) -> None:
        """A sentence below a drawing."""
        self.text(360, y, text, "s t")

    def span(self, x: Point, y: float, text: str, color: str) -> None:
        """A band of a time line, with its name."""
        self.box(x[0], y, (x[1] - x[0], 30), "", f"f{color}")
        self.text((x[0] + x[1]) / 2, y + 20, text, f"code t{color}")


def tree() -> Figure:
    """Frames of two robots in one map."""
    figure = Figure(720, 300, "Frames of two robots in one tree")
    figure.box(285, 16, (150, 34), "fleet/map", "fc")
    for x, robot in ((60, "r1"), (450, "r2")):
        figure.arrow((360, 50), (x + 105, 88))
        figure.box(x + 30, 90, (150, 34), f"{robot}/odom", "box")
        figure.arrow((x + 105, 124), (x + 105, 148))
        figure.box(x + 30, 150, (150, 34), f"{robot}/base", "box")
        figure.arrow((x + 105, 184), (x + 40, 218))
        figure.arrow((x + 105, 184), (x + 170, 218))
        figure.box(x - 25, 220, (120, 34), f"{robot}/laser", "box")
        figure.box(x + 115, 220, (120, 34), f"{robot}/upper", "fa")
    figure.caption(82, "static: StaticPublisher, zstate static")
    figure.text(360, 141, "moving: odometry,\nTransformPublisher", "s t")
    figure.text(360, 208, "fixed joint of the model,\nor a joint (blue)", "s t")
    figure.caption(
        284, "An edge is the pose of the child in its parent. An arrow leads from parent to child."
    )
    return figure


def timeline() -> Figure:
    """Which lookups a history can answer."""
    figure = Figure(720, 230, "Lookups before, within and after the history of an edge")
    left, right, y = 200, 520, 96
    figure.span((20, left), y - 62, "InPast", "r")
    figure.span((left, right), y - 62, "exact, interpolated", "c")
    figure.span((right, 700), y - 62, "InFuture", "r")
    figure.arrow((20, y), (704, y))
    stamps = [left + 40 * n for n in range(9)]
    figure.dots(((x, y) for x in stamps), "da", 5)
    figure.text(left, y + 26, "oldest sample", "s t")
    figure.text(right, y + 26, "newest sample", "s t")
    figure.text(690, y + 26, "stamp", "s t", "end")
    asked = 375
    figure.path(((asked, y - 30), (asked, y + 52)), "c")
    figure.text(asked, y + 70, "between two samples: joints are\ninterpolated, the pose is computed", "s tc")
    figure.path(((600, y - 30), (600, y + 52)), "r dash")
    figure.text(610, y + 70, "wait (timeout_s=),\nat=None, or predict_s=", "s tr")
    figure.path(((100, y - 30), (100, y + 52)), "r dash")
    figure.text(100, y + 70, "history_s= keeps\nmore", "s tr")
    figure.caption(220, "Nothing is clamped: no answer is that of the nearest sample.")
    return figure


def wires() -> Figure:
    """What a publisher sends and where it is computed."""
    figure = Figure(720, 200, "Joint positions travel; readers compute poses")
    figure.box(16, 60, (150, 56), "joint source\ndriver, sine, program")
    figure.arrow((166, 88), (190, 88))
    figure.box(192, 60, (132, 56), "StatePublisher\nmodel, exact rate", "fa")
    figure.arrow((324, 88), (436, 88), "joint_states", "a")
    figure.text(380, 106, "110 B for 7 joints", "s t")
    figure.box(438, 60, (154, 56), "TransformListener\ndecodes, counts", "fa")
    figure.arrow((592, 88), (614, 88))
    figure.box(616, 60, (88, 56), "buffer\nlookups", "fc")
    figure.path(((258, 116), (258, 150), (515, 150), (515, 118)), "m dash", ">")
    figure.text(386, 168, "robot_description, tf_static: once, and to late joiners", "s t")
    figure.path(((258, 60), (258, 30), (515, 30), (515, 58)), "m dash", ">")
    figure.text(386, 24, "tf: only while a reader subscribes to it", "s t")
    return figure


def streams_of_a_publisher() -> Figure:
    """The four streams of a publisher."""
    figure = Figure(720, 210, "One StatePublisher writes four streams")
    figure.box(20, 78, (150, 56), "your loop\nreads the hardware")
    figure.arrow((170, 106), (238, 106), "publish()")
    figure.box(240, 78, (150, 56), "StatePublisher\nmodel of the robot", "fa")
    rows = (
        ("joint_states", "positions of all joints at one instant"),
        ("tf", "moving edges, while it has a reader"),
        ("tf_static", "fixed edges, for late joiners too"),
        ("robot_description", "the model, for late joiners too"),
    )
    for n, (name, what) in enumerate(rows):
        y = 34 + 48 * n
        figure.path(((390, 106), (430, y)), "m", ">")
        figure.text(440, y + 1, name, "code ta", "start")
        figure.text(440, y + 18, what, "s t", "start")
    return figure


def drivers() -> Figure:
    """Two drivers of one robot, interpolated on their own."""
    figure = Figure(720, 236, "Samples of two drivers of one robot, merged by the reader")
    for y, name, css in ((40, "arm", "a"), (100, "gripper", "b")):
        figure.text(24, y + 5, name, f"bold t{css}", "start")
        figure.arrow((110, y), (700, y))
    figure.dots(((130 + 30 * n, 40) for n in range(19)), "da", 4)
    figure.dots(((150 + 130 * n, 100) for n in range(5)), "db", 4)
    asked = 355
    figure.path(((asked, 24), (asked, 146)), "c")
    figure.path(((340, 52), (370, 52)), "c")
    figure.path(((280, 112), (410, 112)), "c")
    figure.box(180, 148, (350, 44), "lookup at one stamp\neach joint between samples of its own driver", "fc")
    figure.caption(220, "PartialStatePublisher: one writer for each joint; rates and stamps need not agree.")
    return figure


def driving() -> Figure:
    """Who may do what with a driver."""
    figure = Figure(720, 262, "Programs, the driver and the hardware")
    figure.box(20, 20, (180, 56), "Commander\nsend(), move(): one at a time", "fa")
    figure.box(20, 97, (180, 56), "any program\nstop()", "fr")
    figure.box(20, 174, (180, 56), "readers\nlistener, view, recorder", "fc")
    figure.box(350, 64, (150, 120), "zstate drive\nlimits, ramps, ttl,\nstops, faults", "box")
    figure.box(580, 97, (124, 56), "hardware\nhas its own e-stop", "fm")
    figure.path(((200, 48), (270, 48), (348, 90)), "a", ">")
    figure.text(276, 42, "setpoints, motions", "s t", "start")
    figure.arrow((200, 125), (348, 125), "stop, until released", "r")
    figure.path(((348, 160), (270, 202), (202, 202)), "c", ">")
    figure.text(276, 216, "joint_states, driver", "s t", "start")
    figure.arrow((500, 110), (578, 110), "write()")
    figure.arrow((578, 140), (502, 140), "read()")
    figure.caption(250, "No setpoint within the ttl (0.25 s): the joints brake and hold.")
    return figure


def network() -> Figure:
    """Ways to connect processes."""
    figure = Figure(720, 330, "Peers on one host, clients of a router, routers of a site")
    figure.box(16, 44, (190, 240), "", "bg")
    figure.text(111, 32, "one host: peers", "bold")
    for x, y, name in ((30, 66, "driver"), (118, 66, "zstate tf"), (74, 196, "view")):
        figure.box(x, y, (76, 34), name, "fa")
    figure.path(((106, 83), (116, 83)), "a")
    figure.path(((68, 100), (100, 194)), "a")
    figure.path(((156, 100), (124, 194)), "a")
    figure.text(111, 256, "nothing to start;\nnothing leaves the host", "s t")
    figure.box(226, 44, (226, 240), "", "bg")
    figure.text(339, 32, "several hosts: a router", "bold")
    figure.box(296, 134, (90, 40), "router", "fb")
    for x, y, name in ((240, 66, "r1"), (362, 66, "r2"), (240, 210, "desk"), (362, 210, "view")):
        figure.box(x, y, (76, 34), name, "fa")
        figure.arrow(
            (x + 38, y + 34 if y < 100 else y),
            (320 if x < 300 else 362, 134 if y < 100 else 174),
            "",
            "b",
            "<>",
        )
    figure.text(339, 258, "--connect; TLS, identities,\naccess control", "s t")
    figure.box(472, 44, (232, 240), "", "bg")
    figure.text(588, 32, "a site: several routers", "bold")
    figure.box(543, 62, (90, 36), "site", "fb")
    for x in (484, 563, 642):
        figure.box(x, 136, (50, 34), "hall", "fb")
        figure.arrow((x + 25, 136), (588 + (x - 563) / 4, 98), "", "b", "<>")
        for dx in (0, 28):
            figure.path(((x + 25, 170), (x + 11 + dx, 208)), "a")
            figure.dots(((x + 11 + dx, 212),), "da", 7)
    figure.text(588, 238, "robots", "s t")
    figure.text(588, 258, "routers forward what\nreaders ask for", "s t")
    figure.caption(312, "The programs are the same in all three; only --connect differs.")
    return figure


def ellipse() -> Figure:
    """The covariance of dead reckoning along a path, and what a fix does to it."""
    figure = Figure(720, 300, "Position of a base, and the ellipse that it is in with 95 %")
    pose, covariance = np.zeros(3), np.diag([0.0, 0.0, 1e-6])
    scale, origin, step = 58.0, np.array([50.0, 262.0]), 0.05
    path: list[Point] = []
    turns = [0.0] * 50 + [0.5] * 30 + [0.0] * 40 + [-0.5] * 60 + [0.0] * 40
    for n, turn in enumerate(turns):
        s, c = math.sin(pose[2]), math.cos(pose[2])
        jacobian = np.array([[1, 0, -step * s], [0, 1, step * c], [0, 0, 1]])
        along = np.outer((c, s, 0), (c, s, 0)) * (0.04**2 * step)  # a random walk of the distance
        covariance = jacobian @ covariance @ jacobian.T + along + np.diag([0, 0, 0.025**2 * step])
        pose += np.array([step * c, step * s, step * turn])
        at = (origin[0] + scale * pose[0], origin[1] - scale * pose[1])
        path.append(at)
        if n % 44 == 43:
            values, vectors = np.linalg.eigh(covariance[:2, :2])
            small, large = np.sqrt(values * 5.991) * scale  # 95 % of two dimensions
            angle = -math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
            figure.ellipse(at, (large, small), angle, "fa thin")
            figure.dots((at,), "da", 3)
    figure.path(path, "a")
    figure.dots((path[0],), "dc", 5)
    figure.text(path[0][0], path[0][1] + 24, "odom", "code tc")
    figure.text(30, 36, "odom -> base: continuous, and less and less certain", "bold", "start")
    figure.text(
        30,
        56,
        "An error of the heading moves the base across its path, one of the distance along it.",
        "s t",
        "start",
    )
    figure.text(390, 250, "ellipse: the true x and y\nare inside with 95 %", "s ta")
    return figure


def odometry_sources() -> Figure:
    """What each source of the odometry measures, and which edge it moves."""
    figure = Figure(720, 300, "Sources of the odometry")
    rows = (
        ("IMU", "rates, accelerations: predict"),
        ("wheels, --velocity", "velocities"),
        ("feet, --relative", "displacements"),
        ("--pose", "poses in odom"),
        ("--heading", "changes of the yaw"),
        ("--barometer", "changes of the height"),
    )
    for n, (name, what) in enumerate(rows):
        y = 16 + 38 * n
        figure.box(16, y, (200, 32), name, "fa")
        figure.text(226, y + 21, what, "s t", "start")
        figure.path(((400, y + 16), (448, 102 + 4 * n)), "m", ">")
    figure.box(450, 78, (110, 66), "estimator", "box")
    figure.arrow((560, 111), (588, 111))
    figure.box(590, 88, (116, 46), "odom -> base\ncontinuous", "fc")
    figure.box(16, 250, (200, 32), "--fix", "fb")
    figure.text(226, 271, "positions on the earth", "s t", "start")
    figure.arrow((400, 266), (588, 266), "and odom -> base")
    figure.box(590, 243, (116, 46), "map -> odom\nmay jump", "fb")
    return figure


def pose_in_odom() -> Figure:
    """How the published pose follows a measured one that differs."""
    figure = Figure(720, 240, "A measured pose moves odom -> base slowly")
    figure.path(((60, 196), (690, 196)), "m", ">")
    figure.path(((60, 196), (60, 24)), "m", ">")
    figure.text(690, 216, "time", "s t", "end")
    figure.text(68, 32, "x in odom", "s t", "start")
    speed, follow, step = 0.30, 0.2, 0.6  # [m/s], [m/s], [m]
    times = np.linspace(0.0, 8.0, 81)
    estimate = speed * times + np.where(times >= 2.5, step, 0.0)
    behind = np.where(times >= 2.5, np.maximum(step - follow * (times - 2.5), 0.0), 0.0)
    best = [(60 + 76 * t, 190 - 48 * x) for t, x in zip(times, estimate, strict=True)]
    published = [(60 + 76 * t, 190 - 48 * (x - b)) for t, x, b in zip(times, estimate, behind, strict=True)]
    figure.path(best, "b dash")
    figure.path(published, "a")
    figure.text(240, 60, "best estimate: jumps\nwith the measurement", "s tb")
    figure.text(420, 160, "published: follows at 0.2 m/s;\nthe difference is in its covariance", "s ta")
    figure.caption(226, "Differences of poses stay motions of the robot.")
    return figure


def scan() -> Figure:
    """A scan of a turning robot, placed with one pose and with a pose for each ray."""
    figure = Figure(720, 300, "A wall, measured while the robot turns")
    duration, rate = 0.1, 2.0  # [s], [rad/s]
    buffer = zstate.TransformBuffer()
    for n in range(11):
        half = 0.5 * rate * duration * n / 10
        quaternion = [0.0, 0.0, math.sin(half), math.cos(half)]
        stamp = n * round(1e8 * duration) + 1
        buffer.insert(zstate.Transform("room", "laser", [0.0, 0.0, 0.0], quaternion, stamp=stamp))
    bearings = np.linspace(-0.6, 0.6, 31)
    stamps = np.linspace(1, round(1e9 * duration) + 1, 31).astype(np.int64)
    ranges = 3.0 / np.cos(bearings + rate * (stamps - 1) * 1e-9)  # to the wall x = 3
    points = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings), 0 * bearings], axis=1)
    middle = np.full_like(stamps, stamps[15])
    for x, times, title in (
        (40, middle, "one pose for the whole scan"),
        (400, stamps, "each ray at its own stamp: place()"),
    ):
        placed, valid = buffer.place(points, times, source="laser", target="room")
        assert valid.all()
        robot = (x + 20.0, 165.0)
        drawn = [(robot[0] + 70 * p[0], robot[1] - 33 * p[1]) for p in placed]
        figure.path(((robot[0] + 210, 40), (robot[0] + 210, 270)), "m")
        for point in drawn[::5]:
            figure.path((robot, point), "m thin")
        figure.dots(drawn, "dr" if times is middle else "dc", 3)
        figure.dots((robot,), "da", 8)
        figure.text(x + 130, 26, title, "bold")
    figure.caption(
        290, "A laser that turns at 2 rad/s and takes 0.1 s for a scan; the grey line is the wall."
    )
    return figure


def lidar() -> Figure:
    """A sweep of a lidar that drives, placed with one pose and with a pose for each point."""
    figure = Figure(720, 290, "A room, measured by a lidar that drives forward and turns")
    duration, speed, rate = 0.1, 5.0, 1.5  # [s], [m/s], [rad/s]
    half = np.array([3.0, 2.0])  # of the room [m]
    stamps = np.linspace(1, round(1e9 * duration) + 1, 57).astype(np.int64)
    since = (stamps - 1) * 1e-9
    buffer = zstate.TransformBuffer()
    for stamp, s in zip(stamps.tolist(), since.tolist(), strict=True):
        pose = zstate.Transform.from_rpy(
            "room", "lidar", [speed * s - 0.25, 0, 0], [0, 0, rate * s], stamp=stamp
        )
        buffer.insert(pose)
    bearings = 2.0 * np.pi * since / duration
    directions = np.stack([np.cos(bearings + rate * since), np.sin(bearings + rate * since)], axis=1)
    starts = np.stack([speed * since - 0.25, 0.0 * since], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along a wall
        ranges = np.nanmin((np.sign(directions) * half - starts) / directions, axis=1)
    points = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings), 0.0 * bearings], axis=1)
    last = np.full_like(stamps, stamps[-1])
    for x, times, title in (
        (190, last, "one pose for the whole sweep"),
        (530, stamps, "each point at its own instant"),
    ):
        placed, valid = buffer.place(points, times, source="lidar", target="room")
        assert valid.all()
        corners = [(x + sx * 48 * half[0], 148 + sy * 48 * half[1]) for sx, sy in _AROUND]
        figure.path([*corners, corners[0]], "m")
        figure.dots([(x + 48 * p[0], 148 - 48 * p[1]) for p in placed], "dr" if times is last else "dc", 3)
        figure.arrow((x - 12, 148), (x + 12, 148))
        figure.text(x, 26, title, "bold")
    figure.caption(
        278, "A turn takes 0.1 s: the robot drives 0.5 m and turns by 9 degrees. The grey line is the wall."
    )
    return figure


_AROUND = (-1, -1), (1, -1), (1, 1), (-1, 1)


def camera() -> Figure:
    """Points on a floor in a picture: where they are, and where a wrong mount projects them."""
    figure = Figure(720, 300, "Points in a picture, and where a wrong mount projects them")
    lens = Camera(640, 480, (600.0, 600.0, 319.5, 239.5))
    optical = zstate.Transform.from_rpy("eye", "lens", [0, 0, 0], [-math.pi / 2, 0, -math.pi / 2])
    points = np.array([(x, y, 0.0) for x in (1.6, 2.4, 4.0, 7.0) for y in (-0.5, 0.0, 0.5)])
    mounts = {
        "meant": ([0.0, 0.0, 0.8], 0.0),
        "turned by 3 degrees": ([0.0, 0.0, 0.8], math.radians(3.0)),
        "moved by 10 cm": ([0.0, 0.1, 0.8], 0.0),
    }
    pixels = {
        name: lens.project(
            (zstate.Transform.from_rpy("floor", "eye", at, [0, 0.25, yaw]) @ optical).inverse() @ points
        )[0]
        for name, (at, yaw) in mounts.items()
    }
    for x, name in ((30, "turned by 3 degrees"), (370, "moved by 10 cm")):
        drawn = {
            kind: [(x + u / 2, 40 + v / 2) for u, v in pixels[kind].tolist()] for kind in ("meant", name)
        }
        figure.box(x, 40, (320, 222), "", "fm")
        for meant, seen in zip(drawn["meant"], drawn[name], strict=True):
            figure.path((meant, seen), "m thin")
        figure.dots(drawn["meant"], "dr", 3.5)
        figure.dots(drawn[name], "dc", 3.5)
        figure.text(x + 160, 28, name, "bold")
    figure.caption(
        284, "Green: where points of the floor are seen. Red: where the assumed mount projects them."
    )
    return figure


def panels() -> Figure:
    """The parts of the page of zstate view."""
    figure = Figure(720, 330, "The page of zstate view")
    figure.box(16, 16, (370, 298), "", "fm")
    figure.text(200, 42, "scene", "bold")
    figure.path(((60, 270), (60, 220), (110, 160), (170, 190)), "a")
    figure.dots(((60, 220), (110, 160), (170, 190)), "da", 5)
    figure.text(60, 292, "robot: meshes, axes, names", "s t", "start")
    figure.dots(((220 + 9 * n, 120 + 3 * (n % 2)) for n in range(17)), "dr", 2.5)
    figure.text(292, 108, "laser scans, maps", "s t")
    figure.path(((200, 250), (250, 236), (300, 232)), "c")
    figure.ellipse((300, 232), (26, 12), -10, "fc")
    figure.text(290, 266, "odometry: path, 95 %", "s t")
    figure.path(((170, 190), (190, 160), (230, 150)), "b dash")
    figure.text(236, 168, "trail of a frame", "s t", "start")
    figure.text(200, 62, "drag: turn; right button: move; wheel: zoom", "s t")
    rows = (
        ("View", "fixed frame; what is drawn;\na line for each robot and its state"),
        ("Frames", "pose of a frame, its writer, trail;\npose between two frames"),
        ("Joints", "sliders, drivers with a STOP button,\nplots"),
        ("Time", "live, paused, or the slider\nof a recording"),
        ("Graph", "publishers, streams,\nand who reads them"),
    )
    for n, (name, what) in enumerate(rows):
        y = 16 + 61 * n
        figure.box(400, y, (304, 54), "", "box")
        figure.text(412, y + 32, name, "bold ta", "start")
        figure.text(472, y + 24, what, "s t", "start")
    return figure


def recordings() -> Figure:
    """What makes a recording, and what reads it."""
    figure = Figure(720, 220, "A recording, what writes it and what reads it")
    figure.box(20, 30, (150, 44), "robots\nnative wire", "fa")
    figure.box(20, 88, (150, 44), "ROS 2 nodes\nwire ros2", "fb")
    figure.box(20, 146, (150, 44), "ros2 bag record\nMCAP, sqlite3", "fb")
    figure.path(((170, 52), (205, 80), (228, 92)), "m", ">")
    figure.path(((170, 110), (228, 106)), "m", ">")
    figure.text(200, 46, "record", "code", "start")
    figure.path(((170, 168), (290, 168), (300, 134)), "m", ">")
    figure.box(230, 76, (150, 56), "run.mcap\nROS 2 messages", "fc")
    rows = (
        ("zstate info, recover", "what is inside, what is missing"),
        ("zstate view, replay", "with a time slider; as a live robot"),
        ("zstate export", "CSV, Parquet"),
        ("zstate.Recording", "lookups, equal to the live ones bit for bit"),
        ("Foxglove, rosbags, ros2 bag", "unchanged"),
    )
    for n, (name, what) in enumerate(rows):
        y = 28 + 40 * n
        figure.path(((380, 104), (426, y + 2)), "m", ">")
        figure.text(434, y, name, "code ta", "start")
        figure.text(434, y + 16, what, "s t", "start")
    return figure


def sites() -> Figure:
    """What crosses the uplink of a site."""
    figure = Figure(720, 300, "A site's router thins what leaves for headquarters")
    figure.box(16, 40, (300, 214), "", "bg")
    figure.text(166, 28, "site plant1: all samples", "bold")
    for y, name in ((60, "rrbot\n50 Hz"), (128, "r2\n50 Hz")):
        figure.box(32, y, (90, 48), name, "fa")
        figure.arrow((122, y + 24), (188, 114), "", "a", ">")
    figure.box(190, 92, (108, 44), "router\n--site plant1", "fb")
    figure.box(32, 196, (90, 44), "programs\n50 Hz", "fa")
    figure.arrow((212, 136), (122, 214), "", "a", ">")
    figure.box(470, 40, (234, 214), "", "bg")
    figure.text(587, 28, "headquarters", "bold")
    figure.box(486, 92, (84, 44), "router\nACL", "fb")
    figure.box(600, 92, (90, 44), "readers\n5 Hz", "fa")
    figure.arrow((570, 114), (598, 114), "", "a", ">")
    figure.arrow((298, 106), (484, 106), "joint_states=5, tf=0", "b", ">")
    figure.path(((645, 136), (645, 190), (250, 190), (250, 138)), "c dash", "<>")
    figure.text(392, 183, "lookup(..., exact=True)", "code tc")
    figure.text(392, 208, "the robot's own samples, on demand", "s t")
    figure.caption(282, "Readers know that the samples are thinned on purpose, and by which site.")
    return figure


def archive() -> Figure:
    """What is in an archive, and what reads it."""
    figure = Figure(720, 236, "Recordings become Parquet files by stream, robot and date")
    for n, name in enumerate(("monday.mcap", "tuesday.mcap", "...")):
        figure.box(20, 34 + 54 * n, (130, 40), name, "fa")
        figure.path(((150, 54 + 54 * n), (208, 108)), "m", ">")
    figure.text(85, 214, "zstate archive --from", "code")
    figure.box(210, 30, (196, 156), "", "fc")
    for n, line in enumerate(("stream=joint_states", "robot=r17", "date=2026-11-20", "....parquet")):
        figure.text(224 + 16 * n, 62 + 26 * n, line, "code", "start")
    figure.text(308, 172, "models, static edges, writers", "s t")
    rows = (
        ("zstate.Archive", "lookups over months, as in a recording"),
        ("DuckDB, Polars, Spark", "without zstate"),
        ("zstate.archive.poses", "one function on many machines"),
        ("zstate archive DIR cut", "a window as MCAP: view, plot, export"),
    )
    for n, (name, what) in enumerate(rows):
        y = 44 + 42 * n
        figure.path(((406, 108), (446, y + 2)), "m", ">")
        figure.text(454, y, name, "code ta", "start")
        figure.text(454, y + 16, what, "s t", "start")
    return figure


def fleet() -> Figure:
    """The live side of several sites, and the recorded side."""
    figure = Figure(720, 330, "Sites thin what leaves them; recordings of all go into one archive")
    figure.text(20, 26, "live: Zenoh", "bold ta", "start")
    figure.text(190, 198, "recorded: Parquet", "bold tc", "start")
    for n, site in enumerate(("site plant1", "site plant2")):
        y = 40 + 62 * n
        figure.box(20, y, (110, 44), f"{site}\nrobots, readers", "fa")
        figure.arrow((130, y + 22), (188, y + 22), "", "a", ">")
        figure.box(190, y, (96, 44), "router\nfull rate", "fb")
        figure.path(((286, y + 22), (418, 93)), "b", ">")
    figure.text(366, 40, "uplink: 5 Hz,\nnamed streams", "s t")
    figure.box(420, 71, (96, 44), "router\nheadquarters", "fb")
    figure.arrow((516, 93), (574, 93), "", "a", ">")
    figure.box(576, 71, (124, 44), "readers\nof all sites", "fa")
    figure.path(((75, 146), (75, 214)), "c", ">")
    figure.text(84, 172, "zstate record --archive", "code", "start")
    figure.box(20, 216, (110, 44), "recorder\nMCAP files", "fa")
    figure.arrow((130, 238), (188, 238), "", "c", ">")
    figure.box(190, 208, (196, 60), "imports\na record each, written last", "fc")
    figure.arrow((386, 238), (424, 238), "", "c", ">")
    figure.box(426, 208, (144, 60), "compact, daily\na file for each\nrobot and date", "fc")
    for y, name in ((206, "Archive"), (238, "DuckDB"), (270, "Ray, Spark")):
        figure.path(((570, 238), (608, y)), "m", ">")
        figure.text(614, y + 4, name, "code", "start")
    figure.caption(312, "Zenoh thins, filters and routes; Parquet, DuckDB and Ray hold and query.")
    return figure


def dataset() -> Figure:
    """States at the stamps of images."""
    figure = Figure(720, 190, "Joint samples, images, and the state at each image")
    for y, name in ((40, "joint_states"), (90, "images")):
        figure.text(20, y + 4, name, "code", "start")
        figure.arrow((130, y), (704, y))
    figure.dots(((140 + 14 * n, 40) for n in range(40)), "da", 3)
    images = [187 + 120 * n for n in range(5)]
    for x in images:
        figure.box(x - 12, 80, (24, 20), "", "fb")
        figure.path(((x, 46), (x, 78)), "c dash")
        figure.path(((x, 102), (x, 124)), "c", ">")
        figure.box(x - 44, 126, (88, 26), "", "fc")
        figure.text(x, 143, "q, camera", "s")
    figure.caption(176, "One row for each image: joints interpolated at its stamp, poses computed from them.")
    return figure


def arrays() -> Figure:
    """The libraries with which poses are exchanged."""
    figure = Figure(720, 210, "Poses in other libraries")
    figure.box(20, 36, (160, 44), "Transform\none pose", "fa")
    figure.box(20, 124, (160, 44), "lookup_many\n(T, 7), valid (T,)", "fa")
    rows = (
        ("NumPy", ".matrix (4, 4)  .pose7 (7,)", 58),
        ("SciPy", ".rotation: x y z w", 58),
        ("Pinocchio", ".se3, from_se3", 58),
        ("pandas, polars", "columns x y z qx qy qz qw", 146),
        ("PyTorch, JAX", "arrays of float64", 146),
    )
    for n, (name, what, start) in enumerate(rows):
        y = 30 + 38 * n
        figure.path(((180, start), (290, y)), "m", "<>")
        figure.text(300, y + 4, name, "bold", "start")
        figure.text(430, y + 4, what, "code", "start")
    return figure


def chain() -> Figure:
    """The order in which doctor checks."""
    figure = Figure(720, 170, "The chain that zstate doctor checks")
    names = (
        "network",
        "robots",
        "writers",
        "model",
        "joint_states",
        "clocks",
        "stamps",
        "tf_static",
        "poses",
    )
    for n, name in enumerate(names):
        x, y = 20 + 138 * (n % 5), 24 + 60 * (n // 5)
        css = "fr" if name == "model" else "fm" if name == "poses" else "fc"
        figure.box(x, y, (118, 34), name, css)
        if n not in (4, 8):
            figure.arrow((x + 118, y + 17), (x + 136, y + 17))
    figure.path(((631, 58), (631, 71), (79, 71), (79, 82)), "m", ">")
    figure.caption(148, "The first broken link (red) is named, with the command that repairs it.")
    return figure


def ros() -> Figure:
    """ROS 2 nodes and zstate on one router."""
    figure = Figure(720, 240, "ROS 2 nodes and zstate on one router")
    figure.box(20, 20, (190, 44), "ROS 2 nodes\nrmw_zenoh: rviz2, MoveIt", "fb")
    figure.box(20, 98, (190, 44), "zstate --wire ros2\npublish, tf, view, record", "fa")
    figure.box(280, 56, (170, 50), "router\nport 7447", "box")
    figure.arrow((210, 42), (278, 70), "", "b", "<>")
    figure.arrow((210, 120), (278, 92), "", "a", "<>")
    figure.text(365, 128, "/joint_states, /tf, /tf_static:\nthe same topics, the same bytes", "s t")
    figure.box(530, 56, (170, 50), "zstate bridge\nboth wires", "fc")
    figure.arrow((450, 81), (528, 81), "", "m", "<>")
    figure.box(530, 176, (170, 44), "zstate robots\nnative wire", "fa")
    figure.arrow((615, 106), (615, 174), "", "m", "<>")
    figure.box(20, 176, (190, 44), "ROS 1 nodes\nrospy", "fb")
    figure.arrow((210, 198), (528, 198), "zstate ros1", "m", "<>")
    return figure


def simulated_time() -> Figure:
    """Simulated time at half the speed of real time."""
    figure = Figure(720, 250, "Simulated time against real time")
    figure.path(((70, 210), (440, 210)), "m", ">")
    figure.path(((70, 210), (70, 24)), "m", ">")
    figure.text(440, 230, "real time [s]", "s t", "end")
    figure.text(78, 30, "simulated time [s]", "s t", "start")
    figure.path(((70, 170), (230, 120), (230, 120), (290, 120), (430, 76)), "a")
    figure.dots(((70 + 16 * n, 170 - 5 * n) for n in range(1, 10)), "da", 3)
    figure.text(262, 112, "paused", "s ta")
    figure.text(60, 175, "10", "s t", "end")
    figure.box(480, 30, (220, 44), "ClockPublisher\nsimulator or zstate replay", "fa")
    figure.arrow((590, 74), (590, 100), "")
    figure.text(600, 92, "zstate/clock", "code", "start")
    figure.box(480, 102, (220, 44), "--clock sim\npublishers stamp and pace with it", "fc")
    figure.box(480, 164, (220, 44), "SimulatedClock\nthe same in Python", "fc")
    return figure


def streams() -> Figure:
    """What a package with a stream brings."""
    figure = Figure(720, 200, "A stream of another package in all tools")
    figure.box(20, 62, (170, 76), "your package\na message class,\na Stream, a Plugin", "fb")
    figure.arrow((190, 100), (268, 100), "entry point")
    figure.box(270, 62, (150, 76), "stream_registry\nrows of all streams", "box")
    rows = (
        "StreamPublisher, StreamListener",
        "zstate ls, hz, echo, graph, monitor",
        "zstate doctor, with checks of your own",
        "zstate record, info, replay, export",
        "zstate foxglove; your commands",
    )
    for n, name in enumerate(rows):
        y = 24 + 38 * n
        figure.path(((420, 100), (452, y + 1)), "m", ">")
        figure.text(460, y + 5, name, "s", "start")
    return figure


def foxglove() -> Figure:
    """The server between robots and Foxglove."""
    figure = Figure(720, 150, "zstate foxglove")
    figure.box(20, 50, (170, 50), "robots\nZenoh, any wire", "fa")
    figure.arrow((190, 75), (278, 75), "subscribes")
    figure.box(280, 50, (170, 50), "zstate foxglove\nROS 2 messages, CDR", "fc")
    figure.arrow((450, 75), (548, 75), "WebSocket")
    figure.box(550, 50, (150, 50), "Foxglove\n3D, plots, map", "fb")
    figure.caption(132, "A stream is read only while a panel shows it.")
    return figure


FIGURES: Sequence[Callable[[], Figure]] = (
    *(archive, arrays, camera, chain, dataset, drivers, driving, ellipse, fleet),
    *(foxglove, lidar, network),
    *(odometry_sources, panels),
    *(
        pose_in_odom,
        recordings,
        ros,
        scan,
        simulated_time,
        sites,
        streams,
        streams_of_a_publisher,
        timeline,
        tree,
        wires,
    ),
)


def files() -> dict[str, str]:
    """The contents of the files by their names."""
    return {f"{draw.__name__}.svg": draw().svg() for draw in FIGURES}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, content in files().items():
        (FOLDER / name).write_text(content)
