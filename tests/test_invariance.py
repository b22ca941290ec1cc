"""Solutions do not depend on the units they are computed in."""

import jax.numpy as jnp
import numpy as np
import pytest
from swing import swing, swung


@pytest.fixture(scope="module")
def plain():
    return swung(swing())


@pytest.mark.parametrize(
    "units",
    [
        {"cost": 1e6},
        {"cost": 1e-6},
        {"angle": 180 / np.pi},
        {"speed": 1e3, "torque": 1e-3},
        {"time": 1e-3},
        {"ceiling": 1e4},
        {"data": 8e6},
        {"angle": 0.01, "time": 60.0, "cost": 1e3, "data": 1e-3, "ceiling": 0.1},
    ],
    ids=str,
)
def test_units_do_not_matter(plain, units):
    other = swung(swing(**units))
    unit = {"angle": 1.0, "speed": 1.0, "torque": 1.0, "time": 1.0, "cost": 1.0}
    unit |= {"ceiling": 1.0, "data": 1.0} | units
    size = np.array([unit["angle"], unit["speed"]])
    cost = unit["cost"]
    assert float(other.objective) == pytest.approx(
        cost * float(plain.objective), rel=1e-6
    )
    time = float(other.trajectory.final_time) / unit["time"]
    assert time == pytest.approx(float(plain.trajectory.final_time), rel=1e-4)
    np.testing.assert_allclose(
        np.asarray(other.trajectory.states) / size, plain.trajectory.states, atol=1e-4
    )
    np.testing.assert_allclose(
        other.trajectory.controls / unit["torque"], plain.trajectory.controls, atol=2e-3
    )
    # Multipliers carry the units of the cost per unit of their constraint.
    np.testing.assert_allclose(
        np.asarray(other.multipliers.dynamics) * size / cost,
        plain.multipliers.dynamics,
        atol=2e-3,
    )
    assert float(other.multipliers.integrals["lift"]) * unit[
        "data"
    ] / cost == pytest.approx(float(plain.multipliers.integrals["lift"]), rel=1e-3)
    np.testing.assert_allclose(
        other.multipliers.path_constraints["ceiling"] * unit["ceiling"] / cost,
        plain.multipliers.path_constraints["ceiling"],
        atol=2e-3,
    )


def test_the_constraints_matter(plain):
    """Or the invariance above would say nothing about their multipliers."""
    assert float(jnp.max(plain.multipliers.path_constraints["ceiling"])) > 1e-3
    assert float(plain.multipliers.integrals["lift"]) < -1e-3
    assert float(plain.integrals["lift"]) == pytest.approx(3.0, abs=1e-5)
