"""`data_sent`: what a flight transfers."""

import jax.numpy as jnp

from ._mission import Mission
from ._verification import Verification


def data_sent(mission: Mission, verification: Verification) -> float:
    """Data transferred on the way [bit], also where the mission requires none."""
    if "data" in verification.integrals:
        return verification.integrals["data"]
    dense = verification.dense
    positions = jnp.asarray(dense.states[:, :3])
    return float(mission.channel.throughput(jnp.asarray(dense.times), positions))
