"""What the README shows, run."""

import json
import re
import shlex
import tomllib

import pytest
from documents import ROOT, Page

import jaxscp.missions
from jaxscp.__main__ import main
from jaxscp._cli._arguments import parser

PAGE = Page("README.md")
README, blocks = PAGE.text, PAGE.blocks


def commands(word):
    """Shell lines that run `word`, split into arguments."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    parts = [part.strip() for line in lines for part in line.split("&&")]
    return [shlex.split(part)[1:] for part in parts if part.split()[0] == word]


def first_solve():
    return commands("jaxscp")[0]


def test_python_blocks_run():
    namespace = PAGE.run()
    assert bool(namespace["solution"].converged)
    assert namespace["checked"].verified


def test_own_problem_is_short():
    assert len(blocks("python")[0].strip().splitlines()) <= 25


@pytest.mark.parametrize("arguments", commands("jaxscp"), ids=" ".join)
def test_commands_parse(arguments):
    assert parser().parse_args(arguments).mission in jaxscp.missions.names()


def test_first_command_solves_the_urban_mission():
    assert first_solve()[:2] == ["solve", "urban-30MB-60dB"]


@pytest.mark.parametrize("command", ["solve", "sweep", "verify", "audit"])
def test_every_option_is_shown(command, capsys):
    main([command, "--help"])
    for option in set(re.findall(r"--[a-z]+", capsys.readouterr().out)) - {"--help"}:
        assert option in README


def test_every_mission_is_shown():
    endings = "free-space-30MB`, `-50MB`, `-70MB"
    assert endings in README
    for name in ("free-flight", "urban-flight", "urban-30MB"):
        assert f"`{name}`" in README
        assert name in jaxscp.missions.names()


def test_extras_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {
        extra
        for arguments in commands("pip")
        for extra in re.findall(r"\[(\w+)\]", " ".join(arguments))
    }
    assert wanted <= set(project["optional-dependencies"])
    assert project["scripts"]["jaxscp"] == "jaxscp.__main__:main"


def test_links_lead_somewhere():
    for target in PAGE.links():
        assert target.startswith("https://") or (ROOT / target).is_file(), target


@pytest.mark.slow
def test_first_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(first_solve()) == 0
    assert (tmp_path / "urban.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "urban.json").read_text())["verified"] is True
