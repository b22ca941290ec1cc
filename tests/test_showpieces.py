"""OpenSCvx's powered landing, as the benchmark poses it, on fewer nodes."""

import sys
from pathlib import Path

import numpy as np
import pytest

import jaxscp

# The benchmarks are no part of the package; a source distribution has none.
sys.path.append(str(Path(__file__).parents[1]))
landings = pytest.importorskip("benchmarks.showpiece_landings")


def test_a_landing_under_limits_on_the_norm_of_thrust():
    problem, guess, *_ = landings.landing_3dof(nodes=6)
    solution = jaxscp.solve(problem, guess)
    assert bool(solution.polished)
    assert jaxscp.verify(problem, solution).verified
    thrust = np.linalg.norm(np.asarray(solution.trajectory.controls[:-1]), axis=1)
    # Most fuel is left when thrust is at one of its limits, but where it changes.
    at_a_limit = np.minimum(abs(thrust - landings.MOST), abs(thrust - landings.LEAST)) < 1
    assert np.sum(~at_a_limit) <= 2
    assert np.all(thrust > landings.LEAST - 1)
    assert np.all(thrust < landings.MOST + 1)


def test_a_landing_with_an_attitude():
    problem, guess, discretization, _ = landings.landing_6dof()
    solution = jaxscp.solve(problem, guess, discretization=discretization)
    # The guess hardly turns: the limit of the turning rate, squared, is flat there.
    assert bool(solution.polished)
    assert jaxscp.verify(problem, solution, between=True).verified
    assert float(solution.objective) == pytest.approx(-1.5756948, abs=1e-6)
    turning = np.asarray(solution.trajectory.states[:, 11:14])
    assert np.linalg.norm(turning, axis=1).max() < landings.TURN + 1e-6
