"""Where the command line and the workers of sweeps keep their programs."""

import functools
import os
import threading
from pathlib import Path

import jax
import jax.monitoring
import jax.numpy as jnp
import pytest

from jaxscp import _cache
from jaxscp._cache import compile_in_turn, keep_programs


@pytest.fixture(autouse=True)
def no_folder_chosen(tmp_path, monkeypatch, cache_restored):
    """As for a user who has set nothing; what the tests' process uses comes back."""
    monkeypatch.setattr(_cache, "_takes_turns", False)
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


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
    monkeypatch.setattr(_cache, "processor", lambda: "another")
    keep_programs()
    assert folder() != before


def test_the_users_choice_stays(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    keep_programs()
    assert folder() == tmp_path / "mine"


def test_one_process_compiles_at_a_time(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    told = {}
    for name in ("register_scalar_listener", "register_event_duration_secs_listener"):
        monkeypatch.setattr(
            jax.monitoring, name, functools.partial(told.__setitem__, name)
        )
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    compile_in_turn()
    begin, end = told.values()

    def another_may():
        with (tmp_path / "mine" / "jaxscp.lock").open() as turn:
            try:
                fcntl.flock(turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            return True

    event = _cache._COMPILING
    assert another_may()
    begin("another event", 1.0)
    assert another_may()
    begin(event, 1.0, fun_name="f")
    assert not another_may()
    end("another event", 1.0)
    assert not another_may()
    end(event, 1.0, fun_name="f")
    assert another_may()


def test_a_process_does_not_wait_for_itself(tmp_path, monkeypatch):
    pytest.importorskip("fcntl")
    listeners = []
    for name in ("register_scalar_listener", "register_event_duration_secs_listener"):
        monkeypatch.setattr(jax.monitoring, name, listeners.append)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    # Threads of a worker begin together, and sweeps of several clients come one by one.
    threads = [threading.Thread(target=compile_in_turn) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "another"))
    compile_in_turn()
    assert len(listeners) == 2


def test_jax_tells_when_it_begins_to_compile_and_when_it_ends():
    told = []

    def begin(event, value, **details):
        told.append(("begin", event))

    def end(event, duration_secs, **details):
        told.append(("end", event))

    jax.monitoring.register_scalar_listener(begin)
    jax.monitoring.register_event_duration_secs_listener(end)
    try:
        jax.jit(lambda x: 3 * x + 0.25)(jnp.arange(3.0)).block_until_ready()
    finally:
        jax.monitoring.unregister_scalar_listener(begin)
        jax.monitoring.unregister_event_duration_listener(end)
    compiling = [kind for kind, each in told if each == _cache._COMPILING]
    assert compiling == ["begin", "end"] * (len(compiling) // 2)
    assert compiling


@pytest.mark.parametrize("where", ["no cache", "no folder", "no locks"])
def test_without_a_place_for_locks_all_compile(where, tmp_path, monkeypatch):
    monkeypatch.setattr(jax.monitoring, "register_scalar_listener", None)
    if where != "no cache":
        (tmp_path / "file").write_text("in the way")
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "file"))
    if where == "no locks":
        monkeypatch.setattr(_cache, "fcntl", None)
    compile_in_turn()


@pytest.mark.parametrize("why", ["no folder can be made", "it may not be written to"])
def test_without_a_folder_nothing_is_kept(why, tmp_path, monkeypatch):
    if why == "no folder can be made":
        (tmp_path / "jaxscp").write_text("in the way")
    else:
        monkeypatch.setattr(os, "access", lambda *_: False)
    keep_programs()
    assert jax.config.jax_compilation_cache_dir is None
