"""viser's own ViserUrdf, moved at an exact rate, for comparison in ``bench.micro.view``.

Runs in a separate environment with ``viser[urdf]`` and without zstate. Job on standard input, as JSON:
``urdf`` (with meshes as absolute paths), ``joints``, ``rows`` of positions, ``rate_hz``. It sends its port,
and runs until it is stopped.
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
    """Draws the robot of the job."""
    job = json.loads(sys.stdin.readline())
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    model = yourdfpy.URDF.load(io.StringIO(job["urdf"]), filename_handler=lambda fname: fname)
    robot = ViserUrdf(server, model)
    columns = {name: column for column, name in enumerate(job["joints"])}
    order = [columns.get(name, -1) for name in robot.get_actuated_joint_names()]
    # A joint missing in the job mimics another joint and stays at 0 here.
    rows = [np.array([row[at] if at >= 0 else 0.0 for at in order]) for row in job["rows"]]
    print(json.dumps({"event": "ready", "port": server.get_port()}), flush=True)
    begin, tick = time.monotonic(), 0
    while True:
        robot.update_cfg(rows[tick % len(rows)])
        tick += 1
        time.sleep(max(0.0, begin + tick / job["rate_hz"] - time.monotonic()))


if __name__ == "__main__":
    main()
