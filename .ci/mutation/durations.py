"""``pytest -p durations``: appends each test and its seconds of processor time to the file ``$DURATIONS``."""

import json
import os
import time
from collections.abc import Generator
from pathlib import Path

import pytest


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measures one test with its fixtures, in all threads of the process."""
    before = time.process_time()
    result = yield
    with Path(os.environ["DURATIONS"]).open("a") as file:
        file.write(json.dumps([item.nodeid, time.process_time() - before]) + "\n")
    return result
