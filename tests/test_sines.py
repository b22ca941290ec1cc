"""Sines that are evaluated once: the same numbers, from fewer evaluations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxscp
from jaxscp import _flow, missions
from jaxscp._intervals import linearize
from jaxscp._sines import sines_once
from jaxscp._transcription import Transcription


@jax.jit
def inner(x):
    return jnp.sin(x) * x


@jax.custom_vjp
def softly(x):
    return jnp.tanh(x)


softly.defvjp(lambda x: (softly(x), softly(x)), lambda y, slope: (slope * (1.0 - y**2),))


def mixed(x, y):
    """Sines in a program, in a call, a loop and a branch, beside custom derivatives."""
    looped = jax.lax.scan(lambda at, _: (jnp.sin(at), at), x, None, length=3)[0]
    chosen = jax.lax.cond(x[0] > 0.0, jnp.cos, lambda at: 2.0 * at, y)
    smooth = jax.nn.softplus(looped) + jnp.logaddexp(x, jnp.sin(2.0 * y))
    kinked = jax.nn.relu(jnp.where(x > 0.0, jnp.sin(x), jnp.cos(y)))
    return {"all": smooth + inner(x) * chosen, "more": (kinked, jnp.arange(2))}


def first(function):
    """One of its results, as a function of both arguments."""
    return lambda x, y: function(x, y)["all"]


@pytest.mark.parametrize(
    "seen",
    [
        lambda function: function,
        jax.jit,
        jax.vmap,
        lambda function: jax.jacfwd(first(function), (0, 1)),
        lambda function: jax.jacrev(first(function), (0, 1)),
        lambda function: jax.jacfwd(jax.jacrev(first(function), (0, 1)), (0, 1)),
    ],
    ids=["value", "jit", "vmap", "forward", "backward", "second"],
)
@given(numbers=st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=4))
def test_nothing_else_changes(seen, numbers):
    x, y = jnp.split(jnp.asarray(numbers), 2)
    if seen is jax.vmap:
        x, y = jnp.stack([x, y]), jnp.stack([y, x])
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13),
        seen(sines_once(mixed))(x, y),
        seen(mixed)(x, y),
    )


@given(numbers=st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=2))
def test_programs_within_run_as_they_are(numbers):
    def function(x):
        kept = jax.checkpoint(lambda at: jnp.cos(at) ** 2)(x)
        like = jax.ShapeDtypeStruct((), float)
        told = jax.pure_callback(lambda at: 2.0 * at, like, jnp.asarray(3.0))
        return softly(x) + jnp.sin(kept), told

    x = jnp.asarray(numbers)
    jax.tree.map(np.testing.assert_array_equal, sines_once(function)(x), function(x))
    slopes = [
        jax.jacrev(lambda x, each=each: each(x)[0])(x)
        for each in (sines_once(function), function)
    ]
    np.testing.assert_allclose(*slopes, rtol=1e-14, atol=1e-14)


def test_what_is_not_finite_stays_so():
    found = sines_once(jnp.sin)(jnp.array([jnp.nan, jnp.inf, 0.0]))
    np.testing.assert_array_equal(found, [np.nan, np.nan, 0.0])


def test_a_linearization_evaluates_fewer(monkeypatch):
    mission = missions.get("free-flight")
    guess = mission.guess(20)
    transcription = Transcription(
        mission.problem(), jaxscp.Discretization(), guess.fractions
    )

    def evaluated():
        def program(states, controls, time):
            at = (transcription.flow(2), transcription.grid)
            return linearize(*at, states, controls, time)

        arguments = (guess.states, guess.controls, guess.final_time)
        text = jax.jit(program).lower(*arguments).compile().as_text()
        return text.count(" sine(") + text.count(" cosine(")

    once = evaluated()
    monkeypatch.setattr(_flow, "sines_once", lambda function: function)
    # Six in each of four stages.
    assert 24 <= once <= 48
    assert evaluated() > 2 * once
