"""Prints what lerobot reads of a dataset, in JSON: python lerobot_reader.py FOLDER. Needs lerobot alone."""

from __future__ import annotations

import json
import sys

from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("zstate/test", root=sys.argv[1], video_backend="pyav")
rows = [dataset[number] for number in range(len(dataset))]
(camera,) = dataset.meta.camera_keys
names = [name for name, feature in dataset.features.items() if feature["dtype"] != "video"]
read = {
    "episodes": dataset.num_episodes,
    "fps": dataset.fps,
    "task": rows[0]["task"],
    "rows": {name: [row[name].tolist() for row in rows] for name in names},
    "blue": [float(row[camera][2].mean()) for row in rows],
    "shape": list(rows[0][camera].shape),
}
print(json.dumps(read))
