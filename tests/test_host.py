"""Python called by name from compiled programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxscp import _host
from jaxscp._host import call_on_host


def doubled(vector):
    """The double of each entry, and the sum of all."""
    return np.concatenate([2.0 * np.asarray(vector), [np.sum(vector)]])


def refused(vector):
    raise ValueError(f"{vector.size} entries")


@jax.jit
def by_name(vector):
    return call_on_host("test_doubled", doubled, vector.size + 1, vector)


def test_it_returns_what_python_returns():
    np.testing.assert_array_equal(by_name(jnp.arange(4.0)), [0, 2, 4, 6, 6])


def test_a_batch_is_called_one_by_one():
    batch = jnp.arange(6.0).reshape(3, 2)
    expected = [doubled(row) for row in np.asarray(batch)]
    np.testing.assert_array_equal(jax.vmap(by_name)(batch), expected)


def test_an_error_comes_with_its_message():
    call = jax.jit(lambda vector: call_on_host("test_refused", refused, 1, vector))
    with pytest.raises(jax.errors.JaxRuntimeError, match="3 entries"):
        jax.block_until_ready(call(jnp.ones(3)))


def test_the_argument_may_be_kept():
    kept = []

    def keep(vector):
        kept.append(vector)
        return vector

    call = jax.jit(lambda vector: call_on_host("test_keep", keep, 2, vector))
    for value in (1.0, 2.0):
        jax.block_until_ready(call(jnp.full(2, value)))
    np.testing.assert_array_equal(kept, [[1.0, 1.0], [2.0, 2.0]])


@pytest.mark.parametrize("reason", ["another device", "another version"])
def test_elsewhere_it_is_a_callback(reason, monkeypatch):
    if reason == "another device":
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    else:

        def refuse(*_, **__):
            raise jax.errors.JaxRuntimeError("version")

        monkeypatch.setattr(jax.ffi, "register_ffi_target", refuse)
    name = f"test_{reason}"
    call = jax.jit(lambda vector: call_on_host(name, doubled, 3, vector))
    np.testing.assert_array_equal(call(jnp.ones(2)), [2, 2, 2])
    assert name not in _host._registered


def test_the_program_does_not_depend_on_the_process():
    def program(function):
        call = jax.jit(lambda vector: call_on_host("test_same", function, 3, vector))
        return call.lower(jnp.ones(2)).as_text()

    assert program(doubled) == program(lambda vector: doubled(vector))
