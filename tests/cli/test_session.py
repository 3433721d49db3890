from __future__ import annotations

import pytest

from zstate.cli.session import SessionOptions


def test_whoever_only_connects_is_a_client():
    there = ("tcp/10.0.0.1:7447",)
    assert SessionOptions().joins_as == "peer"
    assert SessionOptions(connect=there).joins_as == "client"
    assert SessionOptions("peer", there).joins_as == "peer"
    assert SessionOptions(connect=there, listen=there).joins_as == "peer"
    assert SessionOptions(connect=there, config="file.json5").joins_as == "peer"


def test_a_configuration_of_zenoh_is_a_word_about_the_network(monkeypatch: pytest.MonkeyPatch):
    assert not SessionOptions().is_explicit
    assert SessionOptions("peer").is_explicit
    assert SessionOptions(listen=("tcp/127.0.0.1:0",)).is_explicit
    monkeypatch.setenv("ZENOH_CONFIG", "file.json5")
    assert SessionOptions().is_explicit
