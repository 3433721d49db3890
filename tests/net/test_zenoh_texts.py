"""Texts of Zenoh's errors that ours depend on: it has one exception for everything.

A release of Zenoh that changes one fails here, and not as a wrong reason for a user.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Mapping
from contextlib import suppress

import pytest
import zenoh
from helpers.processes import until


def configuration(settings: Mapping[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {"scouting/multicast/enabled": False, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def failure(settings: Mapping[str, object]) -> str:
    with pytest.raises(zenoh.ZError) as caught:
        zenoh.open(configuration(settings))
    return str(caught.value)


def test_port_in_use_is_bound_to_its_endpoint_and_in_use(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    settings = {"listen/endpoints": [endpoint]}
    with zenoh.open(configuration(settings)):
        found = re.search(r"bound to (\S+?):? .*Address already in use", failure(settings))
    assert found is not None
    assert found[1] == endpoint


def test_client_without_a_router_is_unable_to_connect_and_a_wrong_endpoint_is_not(free_port: int) -> None:
    settings = {"mode": "client", "connect/timeout_ms": 50}
    text = failure(settings | {"connect/endpoints": [f"tcp/127.0.0.1:{free_port}"]})
    assert "Unable to connect" in text
    assert re.search(r" at /[^\s\]]*\.rs:\d+", text), (
        "the place in Zenoh's sources, which our text leaves out"
    )
    assert "Unable to connect" not in failure({"listen/endpoints": ["tcp/nowhere.invalid:7"]})


def test_entity_that_another_thread_uses_is_borrowed() -> None:
    with zenoh.open(configuration({})) as session:

        def refusal() -> str:
            subscriber = session.declare_subscriber("k", zenoh.handlers.FifoChannel(1))
            begins = threading.Event()

            def wait() -> None:
                begins.set()
                with suppress(zenoh.ZError):
                    subscriber.recv()

            waiting = threading.Thread(target=wait, daemon=True)
            waiting.start()
            begins.wait()
            try:
                subscriber.undeclare()  # before the thread waits it is done without an error
            except RuntimeError as error:
                session.put("k", b"")
                return str(error)
            finally:
                waiting.join()
            return ""

        texts = [""]
        until(lambda: texts.append(refusal()) or texts[-1])
        assert "borrowed" in texts[-1]
