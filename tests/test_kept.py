"""Programs that one process keeps and another finds untraced."""

import functools
import os
import pickle
import subprocess
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import jaxscp
from jaxscp import _fingerprint, _kept, missions, textbook
from jaxscp._fingerprint import fingerprint
from jaxscp._packed import Packed
from jaxscp._pickling import packages_in, pickled, pickled_by_value
from jaxscp._solve import _run

TRACING = "/jax/core/compile/jaxpr_trace_duration"
solved_by = _run.__wrapped__


@pytest.fixture
def folder(tmp_path, monkeypatch, cache_restored):
    """A fresh one, which programs are kept in."""
    monkeypatch.setattr(_kept, "_found", {})
    # JAX looks once where its own cache is.
    compilation_cache.reset_cache()
    jaxscp.keep_programs(tmp_path)
    yield tmp_path / "jaxscp"
    compilation_cache.reset_cache()


@pytest.fixture
def events():
    """What JAX's listeners hear, with the seconds."""
    heard = []

    def hear(event, duration_secs, **details):
        heard.append((event, details.get("fun_name"), duration_secs))

    jax.monitoring.register_event_duration_secs_listener(hear)
    yield heard
    jax.monitoring.unregister_event_duration_listener(hear)


def solution(problem=None, **settings):
    if problem is None:
        problem = textbook.minimum_energy_double_integrator()
    return jaxscp.solve(problem, nodes=7, **settings)


def solve_is_traced(events):
    names = [name for event, name, _ in events if event == TRACING]
    return any(name.startswith("_run") for name in names)


def numbers(tree):
    # Statistics hold seconds, which differ from solve to solve.
    return [np.asarray(leaf) for leaf in jax.tree.leaves((tree.trajectory, tree.history))]


def test_it_is_found_untraced(folder, events, monkeypatch):
    first = solution()
    (file,) = folder.iterdir()
    written = file.stat().st_mtime_ns
    assert solve_is_traced(events)
    assert _kept.LOADING not in [event for event, *_ in events]
    # As if another process had written it.
    monkeypatch.setattr(_kept, "_found", {})
    events.clear()
    again = solution()
    assert not solve_is_traced(events)
    (seconds,) = [seconds for event, _, seconds in events if event == _kept.LOADING]
    assert 0.0 < seconds < 60.0
    for one, other in zip(numbers(first), numbers(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert jax.tree.structure(first) == jax.tree.structure(again)
    assert again.message == first.message
    assert again.problem.state_names == ("position", "velocity")
    assert file.stat().st_mtime_ns >= written
    # Found once, it is not looked for again.
    events.clear()
    solution(textbook.minimum_energy_double_integrator(2.0))
    assert not [event for event, *_ in events if event == _kept.LOADING]


def test_it_solves_what_is_solved_without(folder):
    kept = solution(textbook.minimum_energy_double_integrator(2.0))
    assert len(list(folder.iterdir())) == 1
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        plain = solution(textbook.minimum_energy_double_integrator(2.0))
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    for one, other in zip(numbers(kept), numbers(plain), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    assert kept.objective == pytest.approx(12 * 2.0**2, rel=0.05)


def test_who_listens_is_told(folder, monkeypatch):
    told = []
    for _ in range(2):
        monkeypatch.setattr(_kept, "_found", {})
        solution(progress=told.append)
    assert len(list(folder.iterdir())) == 1
    assert told[0]["iteration"] == 1
    assert told[: len(told) // 2] == told[len(told) // 2 :]


def test_derivatives_are_what_they_are(folder):
    def objective(distance):
        return solution(textbook.minimum_energy_double_integrator(distance)).objective

    found = objective(3.0)
    # 12 d^2 / T^3, but for the held control.
    assert float(jax.grad(objective)(3.0)) == pytest.approx(2 * float(found) / 3.0)


def test_nothing_is_kept_unasked(folder, monkeypatch):
    monkeypatch.setattr("jaxscp._cache._keeps", False)
    solution()
    assert not folder.exists()


def test_nothing_is_kept_in_a_cache_elsewhere(folder, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", "gs://bucket/programs")
    assert jaxscp._cache.whole_programs() is None


def test_a_users_function_is_not_kept(folder):
    problem = textbook.minimum_energy_double_integrator()
    cost = problem.running_cost
    mine = eqx.tree_at(
        lambda p: p.running_cost, problem, lambda t, x, u: 2.0 * cost(t, x, u)
    )
    assert solution(mine).objective == pytest.approx(2 * solution().objective)
    assert len(list(folder.iterdir())) == 1


def test_a_damaged_file_is_written_anew(folder, monkeypatch):
    first = solution()
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for damaged in (b"", b"text", whole[: len(whole) // 2]):
        file.write_bytes(damaged)
        assert _kept._load(file) is None
    monkeypatch.setattr(_kept, "_found", {})
    # What comes from JAX's cache would lack its kernels if it was written again.
    assert solution().objective == first.objective
    assert len(file.read_bytes()) > len(whole) // 2
    assert _kept._load(file) is not None


def test_what_another_user_has_written_is_found(folder, monkeypatch, events):
    def refused(*_):
        raise PermissionError

    first = solution()
    monkeypatch.setattr(_kept, "_found", {})
    # Only its owner may say that it has been used.
    monkeypatch.setattr(os, "utime", refused)
    events.clear()
    assert solution().objective == first.objective
    assert not solve_is_traced(events)


def test_without_a_file_it_serves_the_process(folder, events):
    folder.write_text("in the way")
    first = solution()
    events.clear()
    assert solution().objective == first.objective
    assert not solve_is_traced(events)


def test_those_not_used_for_long_go_first(folder, monkeypatch):
    folder.mkdir()
    now = time.time()
    for index in range(4):
        other = folder / f"other{index}"
        other.write_bytes(b"")
        os.utime(other, (now - 100 + index, now - 100 + index))
    monkeypatch.setattr(_kept, "_MOST_FILES", 3)
    solution()
    left = {each.name for each in folder.iterdir()}
    assert len(left) == 3
    assert left > {"other2", "other3"}


class Mine(jaxscp.ProximalSCP):
    """A method of a user's."""


def dynamics_of_mine(t, x, u):
    return jnp.stack([x[1], u[0]])


def told(**changes):
    problem = textbook.minimum_energy_double_integrator()
    parts = {"method": jaxscp.ProximalSCP(), "problem": problem, "numbers": jnp.ones(3)}
    options = changes.pop("options", {})
    return fingerprint(solved_by, tuple((parts | changes).values()), options)


def test_equal_programs_have_one_name():
    assert told() == told(
        method=jaxscp.ProximalSCP(),
        problem=textbook.minimum_energy_double_integrator(2.0),
        numbers=jnp.zeros(3),
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"method": jaxscp.ProximalSCP(max_iterations=7)},
        {"method": jaxscp.PaperSCP()},
        {"problem": textbook.minimum_time_double_integrator()},
        {"numbers": jnp.ones(4)},
        {"numbers": jnp.ones(3, jnp.float32)},
        {"numbers": None},
        {"options": {"xla_backend_optimization_level": 2}},
    ],
    ids=str,
)
def test_others_have_others(changes):
    assert told(**changes) not in (None, told())


def test_settings_of_jax_and_xla_count(monkeypatch):
    before = told()
    with jax.default_matmul_precision("float32"):
        assert told() not in (None, before)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert told() not in (None, before)


def test_what_is_installed_counts(monkeypatch):
    before = told()
    monkeypatch.setattr("jaxscp._fingerprint._installed", lambda: "another version")
    assert told() not in (None, before)
    monkeypatch.setattr("jaxscp._fingerprint._installed", lambda: None)
    assert told() is None


def test_sources_changed_since_they_were_imported_tell_nothing(monkeypatch):
    before = told()
    _fingerprint._installed.cache_clear()
    # As if every file had been written later.
    monkeypatch.setattr(_fingerprint, "_IMPORTED", 0.0)
    try:
        assert told() is None
    finally:
        monkeypatch.undo()
        _fingerprint._installed.cache_clear()
    assert told() == before is not None


@pytest.mark.parametrize(
    "part",
    [
        lambda t, x, u: x,
        dynamics_of_mine,
        functools.partial(dynamics_of_mine, 0.0),
        Mine(),
        Mine().terminate,
        Mine,
        jax.jit(dynamics_of_mine),
    ],
    ids=lambda part: type(part).__name__,
)
def test_what_is_not_jaxscps_has_none(part):
    assert told(method=part) is None
    assert fingerprint(dynamics_of_mine, (jnp.ones(3),), {}) is None


@pytest.mark.parametrize("name", missions.names())
def test_every_mission_can_be_kept(name):
    problem = missions.get(name).problem()
    assert told(problem=problem)
    packed = Packed.of(problem)
    assert told(problem=packed)


def test_pickled_structures_are_equal():

    structure = jax.tree.structure(textbook.brachistochrone())
    assert pickle.loads(pickled(structure)) == structure


def test_pickles_tell_whose_code_they_name():
    assert packages_in(pickled((jaxscp.solve, np.sin))) >= {"jaxscp", "numpy"}
    shared = (1.5,)
    assert pickled_by_value([shared, shared]) == pickled_by_value([(1.5,), (1.5,)])


@pytest.mark.slow
def test_another_process_finds_it(tmp_path):
    script = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import jaxscp
heard = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: heard.append(event)
)
jaxscp.keep_programs(sys.argv[1])
problem = jaxscp.textbook.minimum_time_double_integrator()
solved = jaxscp.solve(problem, nodes=7)
print(repr(float(solved.objective)), solved.message)
print("/jaxscp/load_program_duration" in heard)
"""
    # As users have it: XLA then compiles parts side by side.
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}

    def run():
        found = subprocess.run(
            [sys.executable, "-c", script, str(tmp_path)],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        return found.stdout.splitlines()

    (first, compiled), (second, found) = run(), run()
    assert (compiled, found) == ("False", "True")
    assert first == second
