"""Figures of what optima are worth: multipliers, fronts, gradients, uncertainty."""

import drawn
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxscp
from jaxscp import plot


def test_costates_have_units():
    solution = drawn.double_integrator()
    axes = plot.costates(Figure().subplots(2), solution)
    labels = [ax.get_ylabel().split("\n") for ax in axes]
    assert labels == [
        ["costate of position", " [m²/s³ / m]"],
        ["costate of speed", " [m²/s³ / (m/s)]"],
    ]
    curve = axes[1].get_lines()[-1]
    np.testing.assert_array_equal(curve.get_xdata(), solution.trajectory.times[1:])
    np.testing.assert_array_equal(curve.get_ydata(), solution.multipliers.dynamics[:, 1])
    with pytest.raises(ValueError, match="axes has 1 entries for 2 states"):
        plot.costates(axes[:1], solution)


def test_multipliers_add_up_to_shadow_prices():
    """Those of states fixed at the ends are left out on both sides."""
    solution = drawn.double_integrator()
    assert plot.active_limits(solution) == ("speed", "acceleration")
    axes = plot.multipliers(Figure().subplots(2), solution)
    prices = jaxscp.shadow_prices(solution)
    for ax, name in zip(axes, ("speed", "acceleration"), strict=True):
        stems = ax.get_lines()[-1].get_ydata()
        assert stems.max() > 1.0
        price = prices.of(name, "upper limit")
        assert np.maximum(stems, 0.0).sum() == pytest.approx(-float(price))
    assert ax.get_ylabel() == "acceleration\n [m²/s³ / (m/s²)]"
    lowest = prices.of("acceleration", "lower limit")
    assert np.minimum(stems, 0.0).sum() == pytest.approx(-float(lowest))


def test_multipliers_between_nodes_are_bars():
    solution = drawn.with_multipliers()
    (ax,) = plot.multipliers([Figure().subplots()], solution, ["speed"])
    heights = [bar.get_height() for bar in ax.patches]
    np.testing.assert_array_equal(heights, solution.multipliers.state_between[:, 1])
    edges = [bar.get_x() + bar.get_width() for bar in ax.patches]
    np.testing.assert_allclose(edges, solution.trajectory.times[1:])
    labels = {text.get_text() for text in ax.get_legend().get_texts()}
    assert labels == {"at nodes", "between nodes"}


def test_multipliers_of_what_does_not_exist():
    solution = drawn.with_multipliers()
    ax = Figure().subplots()
    with pytest.raises(ValueError, match="names: 'mass' is none of position, speed, acc"):
        plot.multipliers([ax], solution, ["mass"])
    with pytest.raises(ValueError, match="2 active limits; give one for each of speed"):
        plot.multipliers([ax], solution)


def test_pareto_draws_its_slopes():
    """A cubic front is met everywhere."""
    x = np.array([0.0, 1.0, 3.0])
    ax = plot.pareto(Figure().subplots(), x, x**3, 3.0 * x**2, requirement="data [MB]")
    curve, *tangents, points = ax.get_lines()
    np.testing.assert_allclose(curve.get_ydata(), curve.get_xdata() ** 3, atol=1e-12)
    np.testing.assert_array_equal(points.get_xdata(), x)
    for at, tangent in zip(x, tangents, strict=True):
        ends = np.array([tangent.get_xdata(), tangent.get_ydata()])
        np.testing.assert_allclose(ends.mean(axis=1), [at, at**3], atol=1e-12)
        run, rise = ends[:, 1] - ends[:, 0]
        assert rise == pytest.approx(3.0 * at**2 * run)
    assert ax.get_xlabel() == "data [MB]"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": [0.0]}, "values has 1 entries: give at least 2"),
        ({"values": [0.0, 2.0, 1.0]}, r"values\[2\]=1 follows 2: sort them"),
        ({"objectives": [0.0, 1.0]}, r"objectives has shape \(2,\): give shape \(3,\)"),
        ({"slopes": [0.0, np.nan, 1.0]}, r"slopes\[1\]=nan: leave out what is not"),
    ],
)
def test_pareto_refuses(changes, message):
    numbers = [0.0, 1.0, 2.0]
    given = {"values": numbers, "objectives": numbers, "slopes": numbers} | changes
    with pytest.raises(ValueError, match=message):
        plot.pareto(Figure().subplots(), **given)


def paraboloid(x, y):
    east, north = np.meshgrid(x, y)
    return east**2 + 3.0 * north**2, np.stack([2.0 * east, 6.0 * north], axis=-1)


def arrows_of(ax):
    (arrows,) = (each for each in ax.collections if hasattr(each, "U"))
    return np.stack([arrows.U, arrows.V], axis=-1)


def test_arrows_point_where_the_objective_rises():
    x, y = np.linspace(-1.0, 2.0, 4), np.linspace(0.0, 1.0, 3)
    values, gradients = paraboloid(x, y)
    ax = plot.gradient_map(Figure().subplots(), x, y, values, gradients)
    arrows = arrows_of(ax).reshape(gradients.shape)
    factor = arrows[2, 3] / gradients[2, 3]
    np.testing.assert_allclose(arrows, factor * gradients, atol=1e-12)
    # The longest is shorter than the smaller distance between points, by a quarter.
    assert np.linalg.norm(arrows, axis=-1).max() == pytest.approx(0.375)
    assert ax.get_aspect() == 1.0


def test_arrows_on_paper_are_across_level_lines():
    """With other units on one axis, the same picture."""
    x, y = np.linspace(-1.0, 1.0, 4), np.linspace(-1.0, 1.0, 3)
    values, gradients = paraboloid(x, y)
    axes = Figure().subplots(2)
    settings = {"same_unit": False}
    plot.gradient_map(axes[0], x, y, values, gradients, **settings)
    changed = gradients / (1.0, 1000.0)
    plot.gradient_map(axes[1], x, 1000.0 * y, values, changed, **settings)
    first, second = map(arrows_of, axes)
    np.testing.assert_allclose(second, first * (1.0, 1000.0), atol=1e-12)


def test_gradient_map_refuses():
    x, y = np.arange(3.0), np.arange(2.0)
    values, gradients = paraboloid(x, y)
    ax = Figure().subplots()
    with pytest.raises(ValueError, match=r"values has shape \(3, 2\): give shape \(2, 3"):
        plot.gradient_map(ax, x, y, values.T, gradients)
    with pytest.raises(ValueError, match=r"gradients has shape .*: give shape \(2, 3, 2"):
        plot.gradient_map(ax, x, y, values, gradients[..., 0])
    with pytest.raises(ValueError, match=r"y\[1\]=0 follows 1"):
        plot.gradient_map(ax, x, y[::-1], values, gradients)


def test_ellipses_hold_the_share_they_say():
    """Of positions drawn at random."""
    route = drawn.flight()[1].trajectory
    generator = np.random.default_rng(0)
    jacobian = generator.normal(size=(route.nodes, 3, 4))
    root = generator.normal(size=(4, 4))
    ax = Figure().subplots()
    plot.ellipses(ax, route, jacobian, root @ root.T, probability=0.8, every=12)
    assert len(ax.patches) == 3
    moves = root @ generator.normal(size=(4, 20_000))
    for node, ellipse in zip((0, 12, 24), ax.patches, strict=True):
        center = np.asarray(route.states)[node, :2]
        np.testing.assert_array_equal(ellipse.center, center)
        places = center + (jacobian[node, :2] @ moves).T
        turned = np.radians(ellipse.angle)
        across = np.array([[np.cos(turned), -np.sin(turned)]])
        across = np.vstack([across, [[np.sin(turned), np.cos(turned)]]])
        own = (places - center) @ across / (0.5 * ellipse.width, 0.5 * ellipse.height)
        assert np.mean(np.sum(own**2, axis=1) < 1.0) == pytest.approx(0.8, abs=0.01)
    assert ax.get_legend_handles_labels()[1] == ["80 %"]


def test_ellipses_are_magnified_and_left_out_where_nothing_moves():
    route = drawn.flight()[1].trajectory
    jacobian = np.zeros((route.nodes, 2, 1))
    jacobian[3, 0] = 2.0
    ax = plot.ellipses(Figure().subplots(), route, jacobian, [[4.0]], magnify=10.0)
    (ellipse,) = ax.patches
    # 95 % lie within the root of chi squared's 5.991 standard deviations of 4 m.
    assert ellipse.width == pytest.approx(2.0 * 10.0 * 4.0 * np.sqrt(5.99146), rel=1e-5)
    assert ellipse.height == 0.0
    assert ellipse.get_label() == "95 %, 10 times as large"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"jacobian": np.zeros((3, 2, 2))},
            r"jacobian has shape \(3, 2, 2\): give \(25,",
        ),
        ({"covariance": np.eye(3)}, r"covariance has shape \(3, 3\): give shape \(2, 2"),
        ({"covariance": [[1.0, 0.5], [0.0, 1.0]]}, "covariance is not symmetric"),
        ({"covariance": np.diag([1.0, -2.0])}, "negative variance -2"),
        ({"probability": 1.0}, "probability=1: give one above 0 and below 1"),
        ({"every": 0}, "every=0: give 1 for all nodes"),
        ({"magnify": -1.0}, "magnify=-1: give a positive factor"),
    ],
)
def test_ellipses_refuse(changes, message):
    route = drawn.flight()[1].trajectory
    given = {"jacobian": np.zeros((25, 2, 2)), "covariance": np.eye(2)} | changes
    with pytest.raises(ValueError, match=message):
        plot.ellipses(Figure().subplots(), route, **given)
