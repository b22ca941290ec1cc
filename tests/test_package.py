"""What `import jaxscp` brings, at once and later."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxscp


def for_type_checkers() -> set[str]:
    """The names that only they import with the package."""
    tree = ast.parse(Path(str(jaxscp.__file__)).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {str(alias.asname) for node in imports for alias in node.names}


def test_type_checkers_and_users_see_the_same_names():
    later = {*jaxscp._MODULES, *jaxscp._HOMES}
    assert later == for_type_checkers()
    assert later <= set(dir(jaxscp))


@pytest.mark.parametrize("name", sorted(for_type_checkers()))
def test_every_name_is_found_when_it_is_asked_for(name):
    # A module's name has the package's before it.
    assert getattr(jaxscp, name).__name__ in {name, f"jaxscp.{name}"}


def test_a_star_brings_every_name():
    brought = {}
    exec("from jaxscp import *", brought)
    assert {*for_type_checkers(), "solve", "verify", "Bounds"} <= set(brought)
    assert "importlib" not in brought


def test_what_a_solve_does_without_is_imported_later():
    code = (
        "import sys, jaxscp\n"
        "later = ['jaxscp.' + name for name in (*jaxscp._MODULES, *jaxscp._NAMES)]\n"
        "print([name for name in later if name in sys.modules])\n"
        "print(jaxscp.missions.get('free-flight').data_required)\n"
        "print('jaxscp.missions' in sys.modules)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert run.stdout.splitlines() == ["[]", "None", "True"], run.stderr


def test_a_name_that_is_not_there():
    with pytest.raises(AttributeError, match="'jaxscp' has no attribute 'solv'"):
        jaxscp.solv  # noqa: B018
