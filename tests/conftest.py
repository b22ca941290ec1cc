"""Strict numerics for every test."""

import gc
import os
import tempfile
from pathlib import Path

# What runs a few times takes longer to optimize than to run, and splitting a program to
# compile its parts side by side costs a seventh more where both cores are busy anyway.
# The rest is as solves compile by themselves (`_compiler`): inside a transformation,
# where they cannot, their numbers are the same then. Read when JAX starts.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_cpu_use_fusion_emitters=false "
    "--xla_disable_hlo_passes=tree_reduction_rewriter",
)

# Workers, and the processes that tests start, take from each other what they compiled.
# The first to get here makes the folder, and removes it.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    programs = tempfile.TemporaryDirectory(prefix="jaxscp-programs-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = programs.name

import hypothesis
import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
# A silently broadcast axis is nearly always a mistake in this code base.
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tracing makes millions of small objects that live as long as their program: looking for
# garbage among them, as often as Python does by itself, is a tenth of the time.
gc.freeze()
gc.set_threshold(100_000, 50, 100)

hypothesis.settings.register_profile(
    "jaxscp",
    # Compilation makes the first example slow; the same examples every time keep a
    # failure repeatable.
    deadline=None,
    derandomize=True,
    max_examples=25,
)
hypothesis.settings.load_profile("jaxscp")


@pytest.fixture
def cache_restored():
    """JAX's settings of its cache come back, whatever a test makes of them."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture(autouse=True)
def nothing_is_kept(monkeypatch):
    """Commands that a test runs keep programs. Another test may change what is traced."""
    monkeypatch.setattr("jaxscp._cache._keeps", False)


# Files that share what they compile: one worker takes them.
TOGETHER = {
    "test_cli": ("test_cli", "test_sweep"),
    "test_plot": (
        "test_plot",
        "test_animation",
        "test_plot_optima",
        "test_plot_pictures",
    ),
    "subproblem": (
        "test_active_set",
        "test_assembly",
        "test_model",
        "test_riccati",
        "test_scaling",
        "test_subproblem",
    ),
    "swing": ("test_invariance", "test_sensitivity", "test_sensitivity_report"),
    "textbook": (
        "test_closed_form_derivatives",
        "test_closed_forms",
        "test_sensitivity_report_closed_forms",
        "test_smoothing",
    ),
}
GROUP = {file: group for group, files in TOGETHER.items() for file in files}

# Each longer than most. What is left to the end should be short, or one worker waits.
LONG = (
    "test_notebooks",
    "textbook",
    "test_solve",
    "swing",
    "test_second_order",
    "test_cli",
    "test_docs",
    "test_readme",
    "subproblem",
    "test_discretization",
    "test_peaks",
    "test_station_placement",
    "test_audit",
)
PLACE = {group: place for place, group in enumerate(LONG)}


def group_of(file: str) -> str:
    """The group of a file of tests; most are one by themselves."""
    return GROUP.get(file, file)


def pytest_collection_modifyitems(items):
    """The longest groups first; a group's tests stay together."""
    places = {item: group_of(item.path.stem) for item in items}
    items.sort(key=lambda item: (PLACE.get(places[item], len(LONG)), places[item]))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Groups by file: xdist's own marks are lost on pytest 9.2, which makes the names of
    tests that they are added to anew.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByGroup(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return group_of(Path(nodeid.partition("::")[0]).stem)

    return ByGroup(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Whole missions call what other tests call, with its types checked, one by one: to
    check each call of theirs again takes a sixth of the time.
    """
    unchecked = item.get_closest_marker("slow") is not None
    jaxtyping.config.update("jaxtyping_disable", unchecked)
    return (yield)


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    """Compiled programs are let go before a process has more of them mapped into its
    memory than Linux allows, 65,530, at which XLA aborts.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 25_000:
        jax.clear_caches()
        gc.collect()
