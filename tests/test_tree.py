"""Numbers, lists and arrays as arrays of floating-point numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_validation import compilations

from jaxscp._bounds import Bounds
from jaxscp._trajectory import time_grid
from jaxscp._tree import as_floats
from jaxscp.models._parameters import parameter

# A size that no other test makes arrays of.
SIZE = 41
GIVEN = {
    "integer": 3,
    "number": 3.5,
    "list of integers": list(range(SIZE)),
    "list of numbers": [0.5] * SIZE,
    "list of arrays": [np.float64(0.5), np.asarray(2)],
    "truth values": np.ones(SIZE, bool),
    "single precision": np.ones(SIZE, np.float32),
    "integers": np.arange(SIZE),
    "numbers": np.linspace(0.0, 1.0, SIZE),
}


@pytest.mark.parametrize("value", GIVEN.values(), ids=GIVEN)
def test_numbers_keep_their_values(value):
    made = as_floats(value)
    assert made.dtype == float
    assert not made.weak_type
    np.testing.assert_array_equal(made, np.asarray(value, float))


@pytest.mark.parametrize("value", GIVEN.values(), ids=GIVEN)
def test_conversion_compiles_nothing(value):
    with compilations() as compiled:
        as_floats(value)
    assert compiled == []


def test_arrays_of_a_model_compile_nothing():
    with compilations() as compiled:
        time_grid(SIZE)
        Bounds([0] * SIZE, [1] * SIZE, scale=[2.0] * SIZE)
        Bounds.exactly(np.ones(SIZE))
        Bounds.free(SIZE)
        parameter("places", [[1, 2]] * SIZE, shape=(None, 2))
    assert compiled == []


@pytest.mark.parametrize("value", [None, [1.0, None], "1.0", ["1.0"]])
def test_what_is_no_number_is_refused(value):
    with pytest.raises((TypeError, ValueError)):
        as_floats(value)


def test_traced_numbers_stay_traced():
    def total(number):
        return jnp.sum(as_floats([number, 2.0])) + as_floats(number)

    assert jax.grad(total)(3.0) == 2.0
    assert jax.jit(total)(3) == 8.0
