"""Loops against what they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxscp import _loop
from jaxscp._loop import over_all


def whole(x, matrix, none):
    """A value and a matrix of each entry, the value undefined at zero."""
    return {"value": matrix @ x / x[0], "outer": jnp.outer(x, x)}, none


@pytest.mark.parametrize("count", [1, 3, 4, 5, 8, 11])
def test_over_all_is_vmap(count, monkeypatch):
    monkeypatch.setattr(_loop, "_TOGETHER", 4)
    draw = np.random.default_rng(count)
    x = 1.0 + draw.random((count, 2))
    arrays = (x, draw.normal(size=(count, 3, 2)), np.zeros((count, 0)))
    mine = jax.jit(lambda *arrays: over_all(whole, *arrays))(*arrays)
    jax.tree.map(np.testing.assert_allclose, mine, jax.vmap(whole)(*arrays))


def test_over_all_is_differentiated_both_ways(monkeypatch):
    monkeypatch.setattr(_loop, "_TOGETHER", 2)
    x = jnp.asarray([1.0, 2.0, 4.0, 8.0, 16.0])

    def total(x):
        return jnp.sum(over_all(lambda each: each**3, x))

    np.testing.assert_allclose(jax.grad(total)(x), 3.0 * x**2)
    np.testing.assert_allclose(jax.jvp(total, (x,), (x,))[1], jnp.sum(3.0 * x**3))
