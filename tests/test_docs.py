"""What the documentation shows, run, and whether it shows everything.

`mkdocs build --strict` (`.ci/run`) tells whether its links and cross references lead
somewhere.
"""

import ast
import functools
import inspect
import re
from pathlib import Path

import pytest
from documents import ROOT, Page

import jaxscp
from jaxscp import missions, models, plot, textbook

MODULES = (jaxscp, missions, models, plot, textbook)


def pages(folder="docs"):
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob("*.md"))


def public_names(module):
    """What a module defines, and what it imports under its own name, but modules."""
    names = set()
    for node in ast.parse(Path(module.__file__).read_text()).body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            names.add(node.name)
        elif isinstance(node, ast.ImportFrom):
            names |= {alias.name for alias in node.names if alias.name == alias.asname}
    public = (name for name in names if not name.startswith("_"))
    return {
        f"{module.__name__}.{name}"
        for name in public
        if not inspect.ismodule(getattr(module, name))
    }


@functools.cache
def described():
    """Names that the reference has a place for."""
    text = "".join(Page(path).text for path in pages("docs/api"))
    return frozenset(re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE))


def public_objects():
    """What the reference describes, and what its classes are made of, by name."""
    found = {}
    for name in described():
        value = functools.reduce(getattr, name.split(".")[1:], jaxscp)
        found[name] = value
        if inspect.isclass(value):
            for member, inner in inspect.getmembers(value, _is_written):
                if not member.startswith("_"):
                    found[f"{name}.{member}"] = inner
    return found


def _is_written(member):
    kinds = (inspect.isfunction, inspect.ismethod)
    return isinstance(member, property) or any(kind(member) for kind in kinds)


@pytest.mark.slow
@pytest.mark.parametrize("path", [p for p in pages() if Page(p).blocks("python")])
def test_pages_run(path):
    assert Page(path).run()


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_the_reference_has_every_public_name(module):
    assert public_names(module) <= described()


def test_the_reference_names_what_exists():
    assert len(public_objects()) > len(described()) > 50


def test_public_names_have_docstrings():
    # Methods may leave it to the class that they implement.
    silent = [n for n, value in public_objects().items() if not inspect.getdoc(value)]
    assert not silent


def test_what_pages_print_is_compared(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(1)\n```\n\n```text\n2\n```\n")
    with pytest.raises(AssertionError):
        Page(str(page)).run()
