"""The options that a solve is compiled with."""

import jax
import pytest

from jaxscp import _compiler


@pytest.fixture(autouse=True)
def asked_anew(monkeypatch):
    # The tests' own would leave nothing to ask for.
    monkeypatch.setenv("XLA_FLAGS", "")
    _compiler.compiler_options.cache_clear()
    yield
    _compiler.compiler_options.cache_clear()


def test_this_xla_knows_them():
    options = _compiler.compiler_options()
    assert options
    assert jax.jit(lambda x: x + 1, compiler_options=options)(1) == 2


def test_what_xla_no_longer_knows_is_left_out(monkeypatch):
    monkeypatch.setattr(_compiler, "_OPTIONS", {"xla_gone": True})
    assert _compiler.compiler_options() == {}


def test_flags_of_the_environment_come_first(monkeypatch):
    name = "xla_backend_optimization_level"
    every = dict(_compiler.compiler_options())
    _compiler.compiler_options.cache_clear()
    monkeypatch.setenv("XLA_FLAGS", f"--{name}=3")
    assert every.pop(name) == 1
    assert _compiler.compiler_options() == every


def test_other_devices_have_none(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert _compiler.compiler_options() == {}
