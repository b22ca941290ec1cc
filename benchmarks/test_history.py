"""A few times that are kept from version to version: see "History" in README.md.

Each is of one thing alone, warm, but for the import. Where other programs share the
machine, least and median tell more than means.
"""

import subprocess
import sys

import jax
import pytest

import jaxscp
from benchmarks import pieces
from benchmarks.discretization import case_of
from benchmarks.discretizers_jax import jaxscp as jaxscp_discretizer
from jaxscp import missions
from jaxscp._transcription import Transcription

# A process that imports jaxscp when it is told to, and has imported JAX before.
FRESH = "import jax; print(flush=True); input(); import jaxscp; print('done', flush=True)"


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    with jax.enable_x64(True):
        yield


def record(benchmark, call, rounds):
    """Times of a warm call."""
    benchmark.pedantic(
        lambda: jax.block_until_ready(call()), rounds=rounds, warmup_rounds=1
    )


def solve(name):
    mission = missions.get(name)
    return jaxscp.solve(mission.problem(), mission.guess(100), throw=False)


@pytest.fixture(scope="module")
def begun():
    """free-flight as a discrete problem, and the state that its first QP is made at."""
    guess = missions.get("free-flight").guess(100)
    problem = solve("free-flight").problem
    transcription = Transcription(problem, jaxscp.Discretization(), guess.fractions)
    state = pieces.first(transcription, transcription.variables(guess))
    return transcription, pieces.look(transcription, state)


def test_discretization(benchmark):
    """Values and Jacobians of the quadrotor, 100 nodes, four substeps, no integrals."""
    case = case_of("free-space-30MB-60dB", nodes=100, gathers=False)
    record(benchmark, jaxscp_discretizer(case, substeps=4).call, rounds=200)


def test_subproblem(benchmark, begun):
    """The first QP of free-flight by PIQP, with its assembly and the call to the host."""
    parts = pieces.curvature(*begun)
    record(benchmark, lambda: pieces.subproblem(*begun, parts), rounds=30)


def test_curvature(benchmark, begun):
    """The exact Hessian of free-flight, where Newton's step is first tried."""
    transcription, state = begun
    tried = False
    while not tried:
        looked = pieces.look(transcription, state)
        state, _, tried, done = pieces.move(transcription, looked)
        assert not done
    record(benchmark, lambda: pieces.curvature(transcription, looked), rounds=50)


@pytest.mark.parametrize("name", ["free-flight", "free-space-30MB-60dB"])
def test_warm_solve(benchmark, name):
    """Of a mission from its own guess, limits at the nodes; it must still converge."""
    record(benchmark, lambda: solve(name), rounds=9)
    assert bool(solve(name).polished)


def test_import(benchmark):
    """Of jaxscp in a fresh process, after JAX."""

    def start():
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        process = subprocess.Popen([sys.executable, "-c", FRESH], text=True, **pipes)
        assert process.stdout.readline() == "\n"
        return (process,), {}

    def imported(process):
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline() == "done\n"

    def end(process):
        process.communicate()

    benchmark.pedantic(imported, setup=start, teardown=end, rounds=9)
