"""View: draws a world on a page, again and again."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import viser

from zstate._util.closeable import Closeable
from zstate.buffer.snapshot import FramePoses, Poses
from zstate.clock import SystemClock, wait_interruptible
from zstate.model.robot import RobotModel
from zstate.rate import Rate
from zstate.view.camera import FIELD_OF_VIEW, Camera, CameraPose, Sight, fit_camera, sights
from zstate.view.data_source import ViewSource
from zstate.view.panels.layout import PanelLayout
from zstate.view.scene.scene import Scene
from zstate.view.server import ViewServer
from zstate.view.sliders import SliderPublisher

_LOG = logging.getLogger("zstate")

# Numbers that change faster cannot be read, and cost more than the picture.
_PANELS_PERIOD_S = 0.2
_IDLE_S = 0.5


class View(Closeable):
    """Draws ``world`` on ``page`` at most ``rate_hz`` times a second; twice a second while nobody looks.

    ``sliders`` are of robots that are moved from the page; they and the world are the caller's to close.
    ``folders`` are those of the URDF files that the user named, by the text of the URDF: a robot with
    such a URDF is drawn with every file that it names, any other with files in packages only.
    ``fixed_frame`` and ``camera`` are how a page begins: the frame that everything is seen from, if it is
    there, and from where; None shows all robots, in a picture that is ``aspect`` times as wide as high.
    One thread calls ``run`` or ``draw``; ``hold`` and what it leads to are for another.
    """

    def __init__(
        self,
        world: ViewSource,
        page: ViewServer,
        *,
        sliders: Sequence[SliderPublisher] = (),
        rate_hz: float = 30.0,
        folders: Mapping[str, Path] | None = None,
        fixed_frame: str = "",
        camera: Camera | None = None,
        aspect: float = 1.0,
    ) -> None:
        self._world = world
        self._page = page
        self._rate_hz = rate_hz
        self._folders = dict(folders or {})
        self.scene = Scene(page.server)
        self._board = PanelLayout(page.server, world, self.scene, sliders, fixed_frame)
        self._camera = camera
        self._aspect = aspect
        self._version = -1
        self._drawn: dict[str, RobotModel] = {}
        self._framed: tuple[str, tuple[str, ...], int] | None = None
        self._framed_without = 0  # so many frames had no pose then
        self._framed_busy = False  # and meshes were still to come
        self._framing: CameraPose | None = None
        self._is_to_hold = False
        self._held: FramePoses | None = None
        self._placed: Poses | None = None
        self._holds = threading.Event()
        self._panels_due_s = 0.0
        self._logged: set[str] = set()
        server = page.server
        server.initial_camera.fov = FIELD_OF_VIEW
        _light(server.scene)
        # One without an end, that fades, takes a browser without a graphics card a second for a picture.
        self._floor = server.scene.add_grid(
            "/floor",
            width=0.0,
            height=0.0,
            cell_size=0.2,
            cell_color=(226, 228, 232),
            section_color=(190, 194, 200),
            shadow_opacity=0.0,
        )

    def run(self, stop: threading.Event) -> None:
        """Draw until ``stop`` is set. A picture that raises is logged, shown on the page and tried again."""
        while not stop.is_set():
            if not self._page.connected.wait(_IDLE_S):
                # Whoever opens the page next finds everything there.
                self._try_to_draw()
                continue
            for _ in Rate(self._rate_hz, SystemClock(), stop):
                self._try_to_draw()
                if not self._page.connected.is_set():
                    break

    def draw(self) -> FramePoses:
        """Show the world as it is now, or at the instant that was chosen on the page."""
        moment = self._held
        if moment is None:
            version = self._world.version
            if self._version != version:
                self._renew_robots()
                self._version = version
            moment = self._world.moment(self._board.stamp)
            if self._is_to_hold:
                self._held, self._framed = moment, None
        fixed = self._board.fixed(moment)
        with self._page.server.atomic():
            try:
                if fixed:
                    placed = self.scene.show(moment, fixed)
                    self._frame(moment, fixed, placed)
                    if self._held is not None:
                        self._placed = placed
                        if not self.scene.busy:
                            self._holds.set()
            finally:
                # Panels turn robots grey that have been silent since: not in a picture of an earlier instant.
                if self._held is None and time.monotonic() >= self._panels_due_s:
                    self._board.update(moment)
                    self._panels_due_s = time.monotonic() + _PANELS_PERIOD_S
        return moment

    def hold(self, timeout_s: float) -> bool:
        """Draw one instant from now on, with the camera where it shows that.

        Returns when all of it is drawn, or after ``timeout_s``; False if nothing of it is.
        """
        self._is_to_hold = True
        return wait_interruptible(self._holds, timeout_s) or self._placed is not None

    def sights(self) -> tuple[Sight, ...]:
        """Which robots are in the picture that is held, and why others are not."""
        if self._held is None or self._placed is None or self._framing is None:
            return tuple(Sight(robot, False, "no robot has a pose yet") for robot in self._world.robots())
        robots = self._world.robots()
        return tuple(sights(self._held, self._placed, self._framing, self._aspect, robots))

    @property
    def fault(self) -> str:
        """Why the last picture could not be drawn; empty when it could."""
        return self._board.fault

    def close(self) -> None:
        """Draw no more. A second call does nothing."""
        self._board.close()

    def _try_to_draw(self) -> None:
        try:
            self.draw()
        except Exception as error:  # the next picture may succeed, and the other robots are still moving
            self._report(error)
        else:
            self._board.fault = ""

    def _report(self, error: Exception) -> None:
        """Show the error on the page. Log it once for each line of code that raises it."""
        self._board.fault = f"{type(error).__name__}: {error}"
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}, line {place.lineno}"
        if where not in self._logged:
            self._logged.add(where)
            _LOG.warning(
                "the view failed to draw a picture (%s, in %s); it continues and tries again",
                self._board.fault,
                where,
            )

    def _renew_robots(self) -> None:
        models = self._world.models
        for name in self._drawn.keys() - models.keys():
            self.scene.remove_robot(name)
            del self._drawn[name]
        for name, model in models.items():
            known = self._drawn.get(name)
            if known is None or known.digest != model.digest:
                self.scene.set_robot(name, model, base=self._folders.get(model.urdf))
                self._drawn[name] = model

    def _frame(self, moment: FramePoses, fixed: str, placed: Poses) -> None:
        """Look at all robots when there are others than before, or when they stand or are seen otherwise."""
        subject = fixed, tuple(self._drawn), self.scene.arrangement
        unknown = int(np.count_nonzero(~moment.known))
        had_less = unknown < self._framed_without or (self._framed_busy and not self.scene.busy)
        if not self._drawn or (subject == self._framed and not had_less):
            return
        framing = fit_camera(moment, placed, self._aspect, self.scene.corners(moment.tree, placed))
        if framing is None:
            return
        self._framed, self._framed_without, self._framed_busy = subject, unknown, self.scene.busy
        moves = self._camera is None or self._framing is None or self._held is not None
        camera = self._camera
        if camera is not None:
            framing = framing._replace(position=camera.position, look_at=camera.look_at or framing.look_at)
        self._framing = framing
        self._aim(framing, moves=moves)

    def _aim(self, framing: CameraPose, *, moves: bool) -> None:
        """Put the floor, and unless the user has put it the camera, where the framing says."""
        server = self._page.server
        self._floor.position = (0.0, 0.0, framing.floor)
        self._floor.width = self._floor.height = 2.0 * framing.reach
        if not moves:
            return
        server.initial_camera.position = framing.position
        server.initial_camera.look_at = framing.look_at
        for client in server.get_clients().values():
            client.camera.position = framing.position
            client.camera.look_at = framing.look_at


def _light(scene: viser.SceneApi) -> None:
    """Daylight that costs little.

    Without a graphics card a picture with shadows takes four times as long, one with surroundings that
    are mirrored in everything twice as long.
    """
    scene.configure_environment_map(None)
    scene.configure_default_lights(cast_shadow=False)
    scene.add_light_hemisphere(
        "/daylight", sky_color=(255, 255, 255), ground_color=(150, 150, 160), intensity=1.8
    )
