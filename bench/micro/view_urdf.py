"""The other side of ``bench.micro.view``: viser's own ViserUrdf, moved at an exact rate.

Runs in an environment of its own, which has ``viser[urdf]`` and no zstate. Job on standard input, as JSON:
``urdf`` (with meshes as absolute paths), ``joints``, ``rows`` of positions, ``rate_hz``. Says its port, and
goes on until it is ended.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import time

import numpy as np
import viser
import yourdfpy
from viser.extras import ViserUrdf


def main() -> None:
    """Draw the robot of the job."""
    job = json.load(sys.stdin)
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    model = yourdfpy.URDF.load(io.StringIO(job["urdf"]), filename_handler=lambda fname: fname)
    robot = ViserUrdf(server, model)
    places = {name: place for place, name in enumerate(job["joints"])}
    order = [places.get(name, -1) for name in robot.get_actuated_joint_names()]
    # A joint that is no joint of the job follows others, and stays where it is here.
    rows = [np.array([row[at] if at >= 0 else 0.0 for at in order]) for row in job["rows"]]
    print(server.get_port(), flush=True)
    begin, tick = time.monotonic(), 0
    while True:
        robot.update_cfg(rows[tick % len(rows)])
        tick += 1
        time.sleep(max(0.0, begin + tick / job["rate_hz"] - time.monotonic()))


if __name__ == "__main__":
    main()
