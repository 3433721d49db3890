"""View: the page's panels and its draw loop."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import feed_of
from zstate.buffer.snapshot import FramePoses, Poses
from zstate.clock import SystemClock, wait_interruptible
from zstate.model.robot import RobotModel
from zstate.net.graph import GraphMonitor
from zstate.rate import Rate
from zstate.view.camera import FIELD_OF_VIEW, Camera, CameraPose, Visibility, fit_camera, robot_visibility
from zstate.view.data_source import FixedFrame, ViewSource
from zstate.view.panels import html
from zstate.view.panels.camera_panel import CamerasPanel
from zstate.view.panels.control_panels import (
    DriversPanel,
    PlotsPanel,
    SlidersPanel,
    TimeCursor,
    TimePanel,
)
from zstate.view.panels.display_panels import (
    DisplayPanel,
    FramesPanel,
    GraphPanel,
    RobotsPanel,
    TransformPanel,
)
from zstate.view.panels.panel import Panel, PanelContext
from zstate.view.scene.scene import Scene
from zstate.view.scene.world import DrawnFrames
from zstate.view.server import ViewServer
from zstate.view.sliders import SliderPublisher

_LOG = logging.getLogger("zstate")

# Numbers that change faster cannot be read, and cost more than the picture.
_PANELS_PERIOD_S = 0.2
_IDLE_S = 0.5
_NO_POSES: Poses = np.empty((0, 7))


class View(Closeable):
    """Draws ``source`` on ``page`` at most ``rate_hz`` times a second; twice a second without a browser.

    ``sliders`` belong to robots that are moved from the page; the caller closes them and the source. Drivers
    can be stopped from it, and with ``can_command`` a browser may take control of them.
    ``folders`` maps the text of each URDF file that the user named to its folder: a robot with such a URDF
    is drawn with every file that it names, other robots with files in packages only.
    ``fixed_frame`` and ``camera`` are the initial ones; the default camera shows all robots, in a picture
    that is ``aspect`` times as wide as high. Clouds, and pictures of cameras, are received while a browser
    shows the page, or always with ``receives_always``. One thread calls ``run`` or ``draw``; ``hold`` and
    ``visibility`` are for another.
    """

    def __init__(
        self,
        source: ViewSource,
        page: ViewServer,
        *,
        sliders: Sequence[SliderPublisher] = (),
        can_command: bool = False,
        rate_hz: float = 30.0,
        folders: Mapping[str, Path] | None = None,
        fixed_frame: str = "",
        camera: Camera | None = None,
        aspect: float = 1.0,
        receives_always: bool = False,
    ) -> None:
        self._source = source
        self._page = page
        self._rate_hz = rate_hz
        self._folders = folders or {}
        self.scene = Scene(page.server)
        self.layout = PanelLayout(page, source, self.scene, sliders, fixed_frame, can_command=can_command)
        self._camera = camera
        self._aspect = aspect
        self._receives_always = receives_always
        self._version = -1
        self._drawn: dict[str, RobotModel] = {}
        self._fitted_to: tuple[str, tuple[tuple[str, ...], tuple[str, ...]], int, int] | None = None
        self._fitted_unknown = 0  # number of frames without a pose then
        self._fitted_busy = False  # whether meshes were still to come then
        self._camera_pose: CameraPose | None = None
        self._hold_requested = False
        self._held: FramePoses | None = None
        self._held_poses: Poses | None = None
        self._hold_complete = threading.Event()
        self._panels_due_s = 0.0
        self._logged: set[str] = set()
        page.server.initial_camera.fov = FIELD_OF_VIEW
        scene = page.server.scene
        # Without a graphics card a picture with shadows takes four times as long, one with an environment
        # map that everything mirrors twice as long.
        scene.configure_environment_map(None)
        scene.configure_default_lights(cast_shadow=False)
        scene.add_light_hemisphere(
            "/daylight", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=1.8
        )
        # An infinite grid, which fades, takes a browser without a graphics card a second for a picture.
        self._floor = scene.add_grid(
            "/floor",
            width=0.0,
            height=0.0,
            cell_size=0.2,
            cell_color=(226, 228, 232),
            section_color=(190, 194, 200),
            shadow_opacity=0.0,
        )

    def run(self, stop: threading.Event) -> None:
        """Draw until ``stop`` is set. If drawing raises, the error is logged and shown on the page."""
        is_shown = False
        while not stop.is_set():
            self._source.world.receive_bulk(on=is_shown or self._receives_always)
            if is_shown:
                for _ in Rate(self._rate_hz, SystemClock(), stop):
                    self._try_to_draw()
                    if not self._page.connected.is_set():
                        break
            else:
                self._try_to_draw()  # so that the next browser finds everything
            is_shown = self._page.connected.wait(_IDLE_S)  # a page that is reloaded is away for less

    def _try_to_draw(self) -> None:
        """Draw, or show the error on the page and log it once for each line of code that raises it."""
        try:
            self.draw()
        except Exception as error:  # the next picture may succeed, and the other robots are still moving
            fault = f"{type(error).__name__}: {error}"
            self.layout.show_fault(fault)
            frame = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(frame.filename).name}, line {frame.lineno}"
            if where not in self._logged:
                self._logged.add(where)
                text = "the view failed to draw a picture (%s, in %s); it continues and tries again"
                _LOG.warning(text, fault, where)
        else:
            self.layout.show_fault("")

    def draw(self) -> FramePoses:
        """Draw the newest snapshot, or the one at the stamp selected on the page."""
        snapshot = self._held
        if snapshot is None:
            version = self._source.version
            if self._version != version:
                self._update_robots()
                self._version = version
            snapshot = self._source.snapshot(self.layout.stamp)
            if self._hold_requested:
                self._held, self._fitted_to = snapshot, None
        at = self.layout.stamp if self._held is None else snapshot.stamp
        # Maps without any frame are drawn in their own.
        own = next((grid.frame for grid in self._source.world.maps_at(at).values()), "")
        fixed = self.layout.fixed.resolve(snapshot.tree) or own
        with self._page.server.atomic():
            try:
                self.scene.cameras.read(self._source.world, self._source.buffer, self.scene.kinds, at)
                if fixed:
                    poses = self.scene.show(snapshot, fixed) if snapshot.tree.names else _NO_POSES
                    place = DrawnFrames(snapshot.tree, poses, fixed)
                    self.scene.world.show(self._source.world, self._source.buffer, place, at)
                    self.scene.clouds.show(self._source.world, self._source.buffer, place, at)
                    self.scene.cameras.show(self._source.buffer, place)
                    self.scene.odometry.show(self._source.buffer, place, at)
                    self._fit_camera(snapshot, fixed, poses)
                    if self._held is not None:
                        self._held_poses = poses
                        if not self.scene.busy and not self.scene.clouds.busy:
                            self._hold_complete.set()
            finally:
                # Panels mark robots that have become stale since: wrong in a picture of an earlier instant.
                if self._held is None and time.monotonic() >= self._panels_due_s:
                    self.layout.update(snapshot)
                    self._panels_due_s = time.monotonic() + _PANELS_PERIOD_S
        return snapshot

    def _update_robots(self) -> None:
        models = self._source.models
        for name in self._drawn.keys() - models.keys():
            self.scene.remove_robot(name)
            del self._drawn[name]
        for name, model in models.items():
            known = self._drawn.get(name)
            if known is None or known.digest != model.digest:
                self.scene.set_robot(name, model, base=self._folders.get(model.urdf))
                self._drawn[name] = model

    def _fit_camera(self, snapshot: FramePoses, fixed: str, poses: Poses) -> None:
        """Fit camera and floor to all robots if robots, fixed frame, poses or meshes have been added."""
        robots = tuple(self._drawn), tuple(snapshot.tree.tracks_of)
        subject = fixed, robots, self.scene.layout.version, self.scene.world.version
        unknown = int(np.count_nonzero(~snapshot.known))
        has_more = unknown < self._fitted_unknown or (self._fitted_busy and not self.scene.busy)
        if subject == self._fitted_to and not has_more:
            return
        maps = self.scene.world.corners(DrawnFrames(snapshot.tree, poses, fixed))
        corners = self.scene.corners(snapshot.tree, poses)
        pose = fit_camera(snapshot, poses, self._aspect, corners, maps)
        if pose is None:
            return
        self._fitted_to, self._fitted_unknown, self._fitted_busy = subject, unknown, self.scene.busy
        user = self._camera
        # The user's camera is set once, and again for a held picture.
        moves = user is None or self._camera_pose is None or self._held is not None
        if user is not None:
            pose = pose._replace(position=user.position, look_at=user.look_at or pose.look_at)
        self._camera_pose = pose
        self._floor.position = (0.0, 0.0, pose.floor)
        self._floor.width = self._floor.height = 2.0 * pose.reach
        if moves:
            server = self._page.server
            for one in (server.initial_camera, *(client.camera for client in server.get_clients().values())):
                one.position, one.look_at = pose.position, pose.look_at

    def hold(self, timeout_s: float) -> bool:
        """Draw only the current snapshot from now on, with the camera fitted to it.

        Returns when it is drawn completely, or after ``timeout_s``; False if nothing is drawn.
        """
        self._hold_requested = True
        return wait_interruptible(self._hold_complete, timeout_s) or self._held_poses is not None

    def visibility(self) -> tuple[Visibility, ...]:
        """Which robots are in the held picture, and why others are not."""
        robots = self._source.robots()
        if self._held is None or self._held_poses is None or self._camera_pose is None:
            return tuple(Visibility(robot, False, "no robot has a pose yet") for robot in robots)
        return tuple(robot_visibility(self._held, self._held_poses, self._camera_pose, self._aspect, robots))

    def close(self) -> None:
        """Close the panels. A second call does nothing."""
        self.layout.close()


class PanelLayout(Closeable):
    """Adds the panels to ``page``; ``sliders`` belong to the robots that are moved from it.

    With ``can_command`` drivers can be commanded from it, too. ``fixed_frame`` is selected at first. The
    drawing thread reads ``stamp`` and ``fixed`` for each picture, and calls ``update`` with the snapshot on
    display a few times a second. ``fault`` is why the last picture could not be drawn; empty if it was drawn.
    """

    def __init__(
        self,
        page: ViewServer,
        source: ViewSource,
        scene: Scene,
        sliders: Sequence[SliderPublisher] = (),
        fixed_frame: str = "",
        *,
        can_command: bool = False,
    ) -> None:
        gui = page.server.gui
        self._source = source
        self.fixed = FixedFrame(fixed_frame)
        self._resources = ExitStack()
        self.cursor = TimeCursor(live=source.session is not None)
        self.fault = ""
        self._fault_html = gui.add_html("")
        drivers = gui.add_folder(None)
        tabs = gui.add_tab_group()
        # A page opens on its first tab.
        joints = tabs.add_tab("Joints") if sliders or can_command else None
        # The display panel is first: a fixed frame selected there applies to the other panels.
        with tabs.add_tab("View"):
            self._panels: list[Panel] = [
                DisplayPanel(gui, scene, self.fixed),
                RobotsPanel(gui, source, scene),
            ]
        with tabs.add_tab("Frames"):
            self._panels.append(FramesPanel(gui, scene))
            with gui.add_folder("Between two frames"):
                self._panels.append(TransformPanel(gui))
        with joints or tabs.add_tab("Joints"):
            for publisher in sliders:
                with gui.add_folder(f"Move {publisher.robot}"):
                    self._panels.append(SlidersPanel(gui, publisher))
            if source.session is not None:
                panel = DriversPanel(page, source, source.session, drivers, can_command=can_command)
                self._panels.append(self._resources.enter_context(panel))
            with gui.add_folder("Plot"):
                self._panels.append(PlotsPanel(gui, source))
        with tabs.add_tab("Time"):
            self._panels.append(TimePanel(gui, self.cursor))
        if source.session is not None:
            with tabs.add_tab("Graph"):
                monitor = self._resources.enter_context(GraphMonitor(source.session))
                self._panels.append(GraphPanel(gui, monitor))
        self._panels.append(CamerasPanel(gui, tabs, scene.cameras))

    @property
    def stamp(self) -> int | None:
        """The stamp to show [ns]; None for the newest samples."""
        return self.cursor.stamp(self._source.span)

    def update(self, snapshot: FramePoses) -> None:
        """Apply the user's input, and show what has changed."""
        buffer, is_live = self._source.buffer, self.cursor.is_live
        domain = feed_of(buffer).domain.name
        now = buffer.clock.now() if is_live and domain in (None, buffer.clock.domain) else None
        for panel in self._panels:
            fixed = self.fixed.resolve(snapshot.tree)
            panel.update(PanelContext(snapshot, fixed, buffer, is_live, now, domain, self._source.span))

    def show_fault(self, fault: str) -> None:
        """Show why the last picture could not be drawn; nothing if it was drawn."""
        if fault != self.fault:
            self.fault = fault
            text = f"The last picture could not be drawn; an older one is shown: {fault}"
            self._fault_html.content = html.paragraph(text, color=html.ALARM) if fault else ""

    def close(self) -> None:
        """End control of drivers, and stop monitoring the graph. A second call does nothing."""
        self._resources.close()
