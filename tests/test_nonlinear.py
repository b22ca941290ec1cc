"""Where second derivatives are, read from programs, against Hessians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxscp import missions
from jaxscp._nonlinear import Nonlinearity, hessian

MATRIX = jnp.array([[0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.0]])
EXACT = {
    "linear": (lambda x: MATRIX @ x + x[1:3] / 3.0 - jnp.flip(x)[:2], []),
    "sine": (lambda x: jnp.sin(x[1]) + x[2], [1]),
    "product": (lambda x: x[0] * x[3] + x[1], [0, 3]),
    "product with a constant": (lambda x: jnp.pi * x, []),
    "quotient": (lambda x: x[0] / x[2] + x[1] / 2.0, [0, 2]),
    "powers": (lambda x: x[0] ** 1 + x[1] ** 2 + x[2] ** 0.5, [1, 2]),
    "norm": (lambda x: jnp.linalg.norm(x[:2]) - x[3], [0, 1]),
    "kinks": (lambda x: jnp.abs(x[0]) + jnp.maximum(x[1], x[2]), []),
    "cases": (lambda x: jnp.where(x[0] > 0.0, x[1] ** 2, x[2]), [1]),
    "matrix product": (lambda x: x @ jnp.diag(jnp.arange(4.0)) @ x, [0, 1, 2, 3]),
    "sum of squares": (lambda x: jnp.sum(x[1:3] ** 2) + jnp.sum(x), [1, 2]),
    "indices": (lambda x: jnp.sin(x[jnp.array([3, 1])]), [1, 3]),
    "unpacked": (lambda x: jnp.stack([x[0], jnp.exp(x[1])]), [1]),
    "jitted": (lambda x: jax.jit(lambda y: y[0] * y[1])(x[2:]) + x[0], [2, 3]),
    "rounding": (lambda x: jnp.floor(x[0]) * x[1], [0, 1]),
}


@pytest.mark.parametrize("name", EXACT)
def test_entries_are_found(name):
    function, expected = EXACT[name]
    assert Nonlinearity.of(function, 4).entries.tolist() == expected


def test_programs_are_read_while_others_are_traced():
    """As inside of a jitted solve, whose own operations are traced."""
    found = []

    def traced(x):
        for name in EXACT:
            found.append(Nonlinearity.of(EXACT[name][0], 4).entries.tolist())
        return jax.lax.fori_loop(0, 2, lambda _, x: x + len(found), x)

    jax.jit(traced)(1.0)
    assert found == [expected for _, expected in EXACT.values()]


def test_what_is_unknown_counts_as_nonlinear():
    def looped(x):
        return jax.lax.fori_loop(0, 3, lambda _, total: total + x[1], x[0])

    found = Nonlinearity.of(looped, 3).entries.tolist()
    assert {0, 1} <= set(found)


@st.composite
def programs(draw):
    """Random ones, of the operations that dynamics are made of."""
    steps = draw(
        st.lists(
            st.tuples(
                st.sampled_from("+-*/sc^wmk"), st.integers(0, 9), st.integers(0, 9)
            ),
            min_size=1,
            max_size=8,
        )
    )

    def program(x):
        values = list(x)
        for what, i, j in steps:
            a, b = values[i % len(values)], values[j % len(values)]
            values.append(
                {
                    "+": lambda a, b: a + b,
                    "-": lambda a, b: 2.0 * a - b,
                    "*": lambda a, b: a * b,
                    "/": lambda a, b: a / (2.0 + b**2),
                    "s": lambda a, b: jnp.sin(a),
                    "c": lambda a, b: jnp.cos(a + b),
                    "^": lambda a, b: a**3,
                    "w": lambda a, b: jnp.where(a > 0.1, a, b),
                    "m": lambda a, b: jnp.maximum(a, b),
                    "k": lambda a, b: jnp.stack([a, b]) @ jnp.array([0.5, 0.0]),
                }[what](a, b)
            )
        return jnp.stack(values)

    return program


@settings(max_examples=12, deadline=None)
@given(programs())
def test_no_curvature_is_missed(program):
    x = jnp.array([0.3, -0.7, 1.1])
    weights = jnp.linspace(1.0, 2.0, program(x).size)
    whole = jax.hessian(lambda x: weights @ program(x))(x)
    found = Nonlinearity.of(program, 3)
    rest = np.setdiff1d(np.arange(3), found.entries)
    np.testing.assert_array_equal(whole[rest], 0.0)
    ours = found.hessian(lambda x: weights @ program(x), x)
    theirs = whole[np.ix_(found.entries, found.entries)]
    np.testing.assert_array_equal(theirs[~found.pairs], 0.0)
    # Each from one of two places that symmetry makes the same but for rounding.
    np.testing.assert_array_equal(ours, np.where(ours == theirs, theirs, theirs.T))


PAIRS = {
    "sum of squares": (lambda x: x @ x, np.eye(4), 1),
    "arrow": (lambda x: x[0] * jnp.sum(x), [[1, 1, 1, 1]] + 3 * [[1, 0, 0, 0]], 2),
    "chain": (
        lambda x: jnp.sum(x[:-1] * x[1:]),
        np.eye(4, k=1) + np.eye(4, k=-1),
        2,
    ),
    "matrix product": (
        lambda x: (x.reshape(2, 2) @ x.reshape(2, 2))[0, 0],
        [[1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 0]],
        1,
    ),
    "batched product": (
        lambda x: jnp.einsum("bij,bj->", x.reshape(2, 1, 2), x.reshape(2, 2)),
        np.eye(4),
        1,
    ),
    "all": (lambda x: jnp.prod(x), np.ones((4, 4)), 4),
}


@pytest.mark.parametrize("name", PAIRS)
def test_columns_share_tangents_where_symmetry_tells_them_apart(name):
    function, pairs, tangents = PAIRS[name]
    found = Nonlinearity.of(function, 4)
    pairs = np.asarray(pairs, bool)
    np.testing.assert_array_equal(found.entries, np.flatnonzero(pairs.any(axis=0)))
    np.testing.assert_array_equal(
        found.pairs, pairs[np.ix_(found.entries, found.entries)]
    )
    assert found.groups.max() + 1 == tangents
    x = jnp.array([0.3, -0.7, 1.1, 2.0])
    np.testing.assert_allclose(hessian(function, x), jax.hessian(function)(x))


def test_the_quadrotor_is_linear_in_position_velocity_and_torque():
    dynamics = missions.get("free-flight").problem().dynamics
    found = Nonlinearity.of(lambda z: dynamics(z[0], z[1:13], z[13:]), 17)
    # Angles, body rates and thrust; the clock comes first.
    assert found.entries.tolist() == [7, 8, 9, 10, 11, 12, 13]
    # Yaw, for one, has no curvature together with any body rate.
    assert found.groups.max() + 1 == 4
