"""When the publisher's Pinocchio is loaded, and what serves until then."""

from __future__ import annotations

import logging
import subprocess
import sys

import numpy as np
import pytest
from helpers.matrix_kinematics import matrices
from helpers.model_samples import every_joint, random_positions
from helpers.processes import until

from zstate.errors import ModelError
from zstate.model.kinematics import MovingEdges
from zstate.model.pinocchio_solver import PinocchioSolver, select_engine
from zstate.nodes import moving_edges
from zstate.nodes.moving_edges import MovingEdgesOnDemand

MODEL = every_joint().model


def test_on_demand_the_closed_forms_serve_until_pinocchio_does():
    edges = MovingEdgesOnDemand(MODEL)
    assert edges.engine == ("closed forms", "", "")
    positions = random_positions(MODEL, 1)
    closed = MovingEdges(MODEL, pinocchio=False).poses(positions)
    assert np.array_equal(edges.poses(positions), closed)
    until(lambda: edges.engine == select_engine())
    by_pinocchio = edges.poses(positions)
    assert np.array_equal(by_pinocchio, MovingEdges(MODEL).poses(positions))
    assert np.allclose(matrices(by_pinocchio), matrices(closed), rtol=0.0, atol=1e-12)


@pytest.mark.long
def test_a_process_on_demand_loads_pinocchio_with_the_first_poses():
    program = """
import sys, threading
import numpy as np
from zstate import load_model
from zstate.nodes.moving_edges import MovingEdgesOnDemand

model = load_model("rrbot")
edges = MovingEdgesOnDemand(model)
assert "pinocchio" not in sys.modules and threading.active_count() == 1
for _ in range(2):
    edges.poses(model.neutral)
for thread in set(threading.enumerate()) - {threading.main_thread()}:
    thread.join()
print(edges.engine.name)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == f"{select_engine().name}\n"


def test_on_demand_a_pinocchio_that_differs_makes_the_next_poses_raise(monkeypatch):
    compute = PinocchioSolver.moving_edges
    monkeypatch.setattr(PinocchioSolver, "moving_edges", lambda *given: compute(*given) + 2e-9)
    edges = MovingEdgesOnDemand(MODEL)
    positions = random_positions(MODEL, 2)
    edges.poses(positions)

    def raises() -> bool:
        try:
            edges.poses(positions)
        except ModelError as error:
            return "differ by 2e-09" in str(error)
        return False

    until(raises)


def test_on_demand_the_closed_forms_stay_with_a_warning_if_pinocchio_cannot_be_loaded(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    moving_edges._warn_of_closed_forms.cache_clear()
    edges = MovingEdgesOnDemand(MODEL)
    with caplog.at_level(logging.WARNING, "zstate"):
        edges.poses(random_positions(MODEL, 3))
        until(lambda: edges.engine.reason)
    assert "`pip install pin`" in caplog.text
    assert edges.engine.name == "closed forms"
