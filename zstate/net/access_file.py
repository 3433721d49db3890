"""Access control from a file: what ``zstate acl`` printed, or somebody wrote."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

from zstate.errors import ConfigError
from zstate.net.config import given_config

_SECTIONS = ("rules", "subjects", "policies")


def read_access_control(path: str | os.PathLike[str]) -> dict[str, object]:
    """That section of the Zenoh configuration in a file. Raises ConfigError where there is none."""
    given = json.loads(str(given_config(path, "peer", (), ())))["access_control"]
    if not given["enabled"]:
        raise ConfigError(
            f"{str(path)!r} has no access_control that is enabled; `zstate acl` prints one", path=str(path)
        )
    lists = {section: [_as_written(one) for one in given[section] or ()] for section in _SECTIONS}
    return {"enabled": True, "default_permission": given["default_permission"], **lists}


def _as_written(entry: Mapping[str, Any]) -> dict[str, Any]:
    # Zenoh sorts the names, and adds those that were not there.
    names = sorted(entry, key=lambda name: (name != "id", isinstance(entry[name], list), name))
    return {name: entry[name] for name in names if entry[name] is not None}
