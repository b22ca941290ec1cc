"""Figures: drawn on the Axes given, complete, and without global state."""

import dataclasses
import io
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxscp
from jaxscp import Bounds, OptimalControlProblem, missions, plot
from jaxscp._packed import Packed


@pytest.fixture(scope="module")
def double_integrator():
    problem = OptimalControlProblem(
        lambda t, x, u: jnp.concatenate([x[1:], u]),
        running_cost=lambda t, x, u: u @ u,
        state=Bounds([-1.0, -jnp.inf], [2.0, 1.2]),
        control=Bounds([-8.0], [8.0]),
        initial_state=Bounds.exactly([0.0, 0.0]),
        final_state=Bounds.exactly([1.0, 0.0]),
        final_time=Bounds.exactly(1.0),
        state_names=("position", "speed"),
        control_names=("acceleration",),
        units={"position": "m", "speed": "m/s", "acceleration": "m/s^2"},
    )
    return jaxscp.solve(problem, nodes=11)


@pytest.fixture(scope="module")
def flight(double_integrator):
    """A route that nobody solved for, beside its guess: a figure needs no optimum."""
    mission = missions.get("urban-flight")
    guess = mission.guess(nodes=25)
    route = eqx.tree_at(lambda t: t.states, guess, guess.states.at[1:-1, 1].add(9.0))
    solution = dataclasses.replace(
        double_integrator, packed_problem=Packed.of(mission.problem()), trajectory=route
    )
    return mission, solution, guess


def test_states_have_units_and_limits(double_integrator):
    axes = Figure().subplots(2, sharex=True)
    assert plot.states(axes, double_integrator) is axes
    assert [ax.get_ylabel() for ax in axes] == ["position [m]", "speed [m/s]"]
    assert axes[-1].get_xlabel() == "time [s]"
    # The speed's limit is close enough to show, the position's lower one too.
    assert axes[1].get_ylim()[1] > 1.2
    assert axes[1].patches


def test_controls_are_drawn_as_held(double_integrator):
    (ax,) = axes = [Figure().subplots()]
    plot.controls(axes, double_integrator)
    curve = ax.get_lines()[0]
    assert curve.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(
        curve.get_ydata(), double_integrator.trajectory.controls[:, 0]
    )


def test_wrong_number_of_axes_is_refused(double_integrator):
    with pytest.raises(ValueError, match="axes has 1 entries for 2 states"):
        plot.states([Figure().subplots()], double_integrator)


def test_convergence(double_integrator):
    ax = Figure().subplots()
    assert plot.convergence(ax, double_integrator) is ax
    assert ax.get_yscale() == "log"
    assert ax.get_xlabel() == "subproblem"
    assert len(ax.get_lines()) == 3


def test_top_view_shows_the_mission(flight):
    mission, solution, guess = flight
    ax = plot.top_view(Figure().subplots(), mission, solution.trajectory, guess)
    labels = set(ax.get_legend_handles_labels()[1])
    assert labels == {"trajectory", "initial guess", "start", "goal", "ground station"}
    radii = {patch.get_radius() for patch in ax.patches}
    assert radii == {float(d) for d in mission.obstacles.safe_distances}
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert lines["initial guess"].get_linestyle() == ":"
    for label, drawn in (("initial guess", guess), ("trajectory", solution.trajectory)):
        np.testing.assert_array_equal(lines[label].get_ydata(), drawn.states[:, 1])


@pytest.mark.parametrize("form", ["png", "pdf", "svg"])
def test_mission_figure_is_written(flight, form):
    figure = plot.mission(*flight)
    labels = [ax.get_ylabel() for ax in figure.axes]
    for quantity in ("speed [m/s]", "tilt [deg]", "thrust [N]", "rate [Mbit/s]"):
        assert quantity in labels
    content = io.BytesIO()
    figure.savefig(content, format=form)
    assert len(content.getvalue()) > 10_000


def test_no_display_state_is_touched():
    code = (
        "import sys, jaxscp; assert 'matplotlib' not in sys.modules;"
        "import jaxscp.plot; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
