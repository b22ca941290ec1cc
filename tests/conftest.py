"""Strict numerics for every test."""

import gc
import os
import tempfile
from pathlib import Path

# What runs a few times takes longer to optimize than to run, and splitting a program to
# compile its parts side by side costs a seventh more where both cores are busy anyway.
# Read when JAX starts.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1",
)

# Workers, and the processes that tests start, take from each other what they compiled.
# The first to get here makes the folder, and removes it.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    programs = tempfile.TemporaryDirectory(prefix="jaxscp-programs-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = programs.name

import hypothesis
import jax
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


# Each longer than most. What is left to the end should be short, or one worker waits.
LONG = (
    "textbook",
    "test_solve",
    "swing",
    "test_second_order",
    "test_cli",
    "test_readme",
    "test_docs",
    "subproblem",
    "test_discretization",
    "test_peaks",
    "test_station_placement",
    "test_audit",
)


def pytest_collection_modifyitems(items):
    """A file's tests share what they compile, and so do those of some files: they go to
    one worker, the longest first.
    """
    place = {name: rank for rank, name in enumerate(LONG)}
    ranks = {}
    for item in items:
        mark = item.get_closest_marker("xdist_group")
        group = mark.args[0] if mark else item.path.stem
        if mark is None:
            item.add_marker(pytest.mark.xdist_group(group))
        ranks[item] = place.get(group, len(LONG))
    items.sort(key=ranks.__getitem__)


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
