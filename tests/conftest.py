"""Strict numerics for every test."""

import os

# What runs a few times takes longer to optimize than to run. Read when JAX starts.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import hypothesis
import jax

jax.config.update("jax_enable_x64", True)
# A silently broadcast axis is nearly always a mistake in this code base.
jax.config.update("jax_numpy_rank_promotion", "raise")

hypothesis.settings.register_profile(
    "jaxscp",
    # Compilation makes the first example slow; the same examples every time keep a
    # failure repeatable.
    deadline=None,
    derandomize=True,
    max_examples=25,
)
hypothesis.settings.load_profile("jaxscp")
