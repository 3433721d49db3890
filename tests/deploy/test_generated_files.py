"""The files of deploy/ are the output of the commands in its README."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from helpers.cli_runner import run_cli
from helpers.deployment import DEPLOY


def output(*arguments: str) -> str:
    ended = run_cli(*arguments)
    assert ended.code == 0, ended.stderr
    return ended.stdout


def commands_in_the_readme() -> list[list[str]]:
    text = (DEPLOY / "README.md").read_text().replace("\\\n", " ")
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL)).splitlines()
    return [shlex.split(line) for line in lines if line.startswith("zstate ")]


def router_command(contains: str, certs: Path) -> list[str]:
    """The options of the router command in the README that has ``contains``."""
    (words,) = [words for words in commands_in_the_readme() if words[1] == "router" and contains in words]
    options = words[1 : words.index("--print") + 1]
    return [str(certs) if word in ("certs", "/etc/zstate/certs") else word for word in options]


@pytest.mark.long
def test_router_configuration_is_generated_by_the_readme_command(certs: Path, tmp_path):
    acl = tmp_path / "acl.json5"
    acl.write_text(output("acl", "--robot", "r1", "--viewer", "desk"))
    options = [str(acl) if word == "acl.json5" else word for word in router_command("--acl", certs)]
    generated = output(*options).replace(str(certs), "/certs")
    assert generated == (DEPLOY / "router.json5").read_text()


def test_site_router_configuration_is_generated_by_the_readme_command(certs: Path):
    generated = output(*router_command("--wan", certs)).replace(str(certs), "/etc/zstate/certs")
    assert generated == (DEPLOY / "site-router.json5").read_text()


def test_other_commands_of_the_readme_exist():
    for words in commands_in_the_readme():
        output(words[1], "--help")


def test_the_rules_of_the_firewall_have_the_limits_of_the_readme():
    """20 connections of an address, 10 at once and then one every 2 s; of IPv6 each network of 64 bits."""
    rules = (DEPLOY / "router.nft").read_text()
    assert re.findall(r"ct count over (\d+)", rules) == ["20"] * 2
    assert re.findall(r"limit rate over (\d+)/minute burst (\d+) packets", rules) == [("30", "10")] * 2
    assert re.findall(r"ip6 saddr & (\S+)", rules) == ["ffff:ffff:ffff:ffff::"] * 2
