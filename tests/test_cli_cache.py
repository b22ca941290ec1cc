"""Where the command line keeps its programs."""

import os
from pathlib import Path

import jax
import pytest

from jaxscp._cli import _cache
from jaxscp._cli._cache import keep_programs


@pytest.fixture(autouse=True)
def no_folder_chosen(tmp_path, monkeypatch):
    """As for a user who has set nothing; what the tests' process uses comes back."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update(names[0], None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def folder() -> Path:
    assert jax.config.jax_compilation_cache_dir is not None
    return Path(jax.config.jax_compilation_cache_dir)


def test_it_is_among_the_users_caches(tmp_path):
    keep_programs()
    assert folder().is_dir()
    assert folder().parent == tmp_path / "jaxscp"


def test_without_a_place_for_caches_it_is_the_homes(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    keep_programs()
    assert folder().parent == tmp_path / ".cache" / "jaxscp"


def test_each_kind_of_processor_has_its_own(monkeypatch):
    keep_programs()
    before = folder()
    keep_programs()
    assert folder() == before
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(_cache, "_processor", lambda: "another")
    keep_programs()
    assert folder() != before


def test_the_users_choice_stays(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    keep_programs()
    assert folder() == tmp_path / "mine"


@pytest.mark.parametrize("why", ["no folder can be made", "it may not be written to"])
def test_without_a_folder_nothing_is_kept(why, tmp_path, monkeypatch):
    if why == "no folder can be made":
        (tmp_path / "jaxscp").write_text("in the way")
    else:
        monkeypatch.setattr(os, "access", lambda *_: False)
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None
