from __future__ import annotations

import pytest

from zstate.cli.session import SessionOptions


def test_connect_alone_implies_a_client():
    there = ("tcp/10.0.0.1:7447",)
    assert SessionOptions().joins_as == "peer"
    assert SessionOptions(connect=there).joins_as == "client"
    assert SessionOptions("peer", there).joins_as == "peer"
    assert SessionOptions(connect=there, listen=there).joins_as == "peer"
    assert SessionOptions(connect=there, config="file.json5").joins_as == "peer"


def test_zenoh_configuration_counts_as_an_explicit_option(monkeypatch: pytest.MonkeyPatch):
    assert not SessionOptions().is_explicit
    assert SessionOptions("peer").is_explicit
    assert SessionOptions(listen=("tcp/127.0.0.1:0",)).is_explicit
    monkeypatch.setenv("ZENOH_CONFIG", "file.json5")
    assert SessionOptions().is_explicit
