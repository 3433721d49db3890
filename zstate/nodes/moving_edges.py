"""The moving edges of a publisher's robot, with Pinocchio from the start or from the first reader on."""

from __future__ import annotations

import ctypes
import importlib.util
import logging
import sys
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from zstate._util.fork_safe import fork_safe_lock
from zstate.checks import Floats
from zstate.errors import ModelError
from zstate.model.kinematics import MovingEdges
from zstate.model.robot import RobotModel

if TYPE_CHECKING:
    from zstate.model.pinocchio_solver import Engine

_LOG = logging.getLogger("zstate")

_WRAPPERS = ("eigenpy", "coal", "pinocchio")
"""The modules of Pinocchio that have a library each, in the order of their imports."""


def open_moving_edges(model: RobotModel) -> MovingEdges:
    """The moving edges of ``model`` by Pinocchio. Logs a warning if the closed forms serve instead."""
    edges = MovingEdges(model)
    if edges.engine.reason:
        _warn_of_closed_forms(edges.engine.reason)
    return edges


@cache
def _warn_of_closed_forms(reason: str) -> None:
    """Log, once in a process, why Pinocchio does not compute the transforms."""
    _LOG.warning("transforms of publishers come from closed forms instead of Pinocchio: %s", reason)


class MovingEdgesOnDemand:
    """Moving edges from closed forms, until a thread that the first call starts has loaded Pinocchio."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._edges = MovingEdges(model, pinocchio=False)
        self._lock = fork_safe_lock()
        self._is_requested = False
        self._error: ModelError | None = None

    @property
    def engine(self) -> Engine:
        """What computes the poses now."""
        return self._edges.engine

    def poses(self, positions: Floats) -> Floats:
        """As ``MovingEdges.poses``. Raises ModelError if Pinocchio is loaded and differs."""
        if self._error is not None:
            raise self._error
        poses = self._edges.poses(positions)
        with self._lock:
            is_first, self._is_requested = not self._is_requested, True
        if is_first:
            # No daemon: the interpreter must not end while libraries are loaded.
            threading.Thread(target=self._load, name="zstate-pinocchio").start()
        return poses

    def _load(self) -> None:
        _load_pinocchio_in_steps()
        try:
            self._edges = open_moving_edges(self._model)
        except ModelError as error:
            self._error = error


def _load_pinocchio_in_steps() -> None:
    """Load Pinocchio in the background: other threads run, except for some milliseconds a module.

    An import of it holds the interpreter until all of its libraries are loaded. Here the loader of the system
    maps them without the interpreter, which the three modules then hold one by one. What cannot be loaded is
    left to ``MovingEdges``, which names it.
    """
    dlopen = ctypes.CDLL(None).dlopen  # calls through ctypes release the interpreter
    dlopen.restype, dlopen.argtypes = ctypes.c_void_p, (ctypes.c_char_p, ctypes.c_int)
    with suppress(ImportError):
        for name in _WRAPPERS:
            spec = importlib.util.find_spec(name)
            for directory in (spec and spec.submodule_search_locations) or ():
                for library in Path(directory).glob(f"{name}_pywrap*.so"):
                    dlopen(bytes(library), sys.getdlopenflags())
        for name in _WRAPPERS:
            importlib.import_module(name)
