"""`Channel`: the radio link between a vehicle and a ground station."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Array, Float, Scalar
from ._parameters import Numbers, parameter
from ._smooth import smooth_norm


class Channel(eqx.Module):
    r"""Expected rate of an air-to-ground link in a city (paper, Section II-B).

    $$\mathcal{R} = w \log_2\!\Big(1 + b\,\frac{\zeta + (1 - \zeta) P}{d^\beta}\Big),
      \qquad P = \frac{1}{1 + a_1 e^{-a_2 (\alpha - a_1)}}$$

    with distance d [m] and elevation alpha [deg] seen from the ground station. P is the
    probability of a line of sight; without one, reflections arrive attenuated by zeta.
    Jensen's inequality makes this rate an upper bound of the mean rate under fading.

    Called as `channel(t, x, u)`, it is the integrand of the transferred data: the rate
    [bit/s] at the position in the first three entries of the state.

    Distances are rounded off within a millimetre (see `_smooth`), so values and all
    derivatives stay finite overhead, where the paper's arcsine has an infinite slope,
    and at the antenna, where the power law is infinite.

    **Arguments:** the defaults are those of the paper's Table II.

    - `ground_station`: position of the antenna, shape (3,) [m].
    - `path_loss_exponent`: beta.
    - `environment`: (a1, a2) of the line-of-sight probability, shape (2,): a1 [deg]
        and, as a bare number, its weight; a2 [1/deg].
    - `reflection_attenuation`: zeta, from 0 to 1.
    - `bandwidth`: w [Hz].
    - `snr_constant`: b, the signal-to-noise ratio in line of sight 1 m away, divided by
        the gap to capacity [m^beta].

    **Raises:** `ValueError` on wrong shapes and values out of range.
    """

    ground_station: Float[Array, "3"]
    path_loss_exponent: Scalar
    environment: Float[Array, "2"]
    reflection_attenuation: Scalar
    bandwidth: Scalar
    snr_constant: Scalar

    def __init__(
        self,
        ground_station: Numbers = (200.0, 400.0, 0.0),
        path_loss_exponent: Numbers = 2.3,
        environment: Numbers = (10.0, 0.6),
        reflection_attenuation: Numbers = 0.2,
        bandwidth: Numbers = 1e6,
        snr_constant: Numbers = 60.0,
    ):
        self.ground_station = parameter(
            "Channel.ground_station", ground_station, shape=(3,), unit="m"
        )
        self.path_loss_exponent = parameter(
            "Channel.path_loss_exponent", path_loss_exponent, above=0.0
        )
        self.environment = parameter(
            "Channel.environment", environment, shape=(2,), above=0.0
        )
        self.reflection_attenuation = parameter(
            "Channel.reflection_attenuation",
            reflection_attenuation,
            at_least=0.0,
            at_most=1.0,
        )
        self.bandwidth = parameter("Channel.bandwidth", bandwidth, above=0.0, unit="Hz")
        self.snr_constant = parameter("Channel.snr_constant", snr_constant, above=0.0)

    @classmethod
    def from_power(
        cls,
        power: Numbers,
        reference_gain: Numbers,
        noise: Numbers,
        gap: Numbers = 1.0,
        **others: Numbers,
    ) -> "Channel":
        """A channel whose b is P gamma0 / (sigma^2 kappa) (paper, Section II-B).

        **Arguments:**

        - `power`: transmission power P [W].
        - `reference_gain`: power gain gamma0 in line of sight at 1 m.
        - `noise`: noise power sigma^2 at the receiver [W].
        - `gap`: gap to capacity kappa of the coding, at least 1.
        - `others`: the remaining arguments of [`Channel`][].
        """
        power = parameter("Channel.power", power, above=0.0, unit="W")
        gain = parameter("Channel.reference_gain", reference_gain, above=0.0)
        noise = parameter("Channel.noise", noise, above=0.0, unit="W")
        gap = parameter("Channel.gap", gap, at_least=1.0)
        return cls(snr_constant=power * gain / (noise * gap), **others)

    def __call__(self, t: Scalar, x: Float[Array, " n"], u: Array) -> Scalar:
        """Rate [bit/s] at the position x[:3]."""
        del t, u
        return self.rate(x[:3])

    def elevation(self, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Angle above the ground station's horizon [deg], -90 to 90."""
        east, north, up = self._from_station(position)
        # The same angle as the paper's arcsine of height over distance.
        return jnp.arctan2(up, smooth_norm(east, north)) * (180 / math.pi)

    def line_of_sight_probability(
        self, position: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Probability that nothing stands between vehicle and ground station."""
        threshold, steepness = self.environment
        # a1 e^(-y) is e^(log a1 - y): a logistic function, which does not overflow.
        excess = steepness * (self.elevation(position) - threshold)
        return jax.nn.sigmoid(excess - jnp.log(threshold))

    def effective_probability(
        self, position: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Expected gain relative to a line of sight at the same distance."""
        zeta = self.reflection_attenuation
        return zeta + (1 - zeta) * self.line_of_sight_probability(position)

    def expected_gain(
        self, position: Float[Array, "*batch 3"], reference_gain: Numbers = 1.0
    ) -> Float[Array, "*batch"]:
        """Expected power gain, `reference_gain` being that in line of sight at 1 m."""
        distance = smooth_norm(*self._from_station(position))
        # Cheaper to differentiate twice than a power with a variable exponent.
        loss = jnp.exp(-self.path_loss_exponent * jnp.log(distance))
        return self.effective_probability(position) * loss * reference_gain

    def rate(self, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Expected rate [bit/s] with a vehicle at `position` [m]."""
        ratio = self.expected_gain(position, self.snr_constant)
        # Far away the ratio is 1e-4 and less, where log(1 + ratio) loses digits.
        return self.bandwidth * jnp.log1p(ratio) / math.log(2)

    def throughput(
        self, times: Float[Array, " N"], positions: Float[Array, "N 3"]
    ) -> Scalar:
        """Data transferred along sampled positions [bit], by the trapezoid rule."""
        return jnp.trapezoid(self.rate(positions), times)

    def _from_station(
        self, position: Float[Array, "*batch 3"]
    ) -> tuple[Array, Array, Array]:
        x, y, z = self.ground_station
        return position[..., 0] - x, position[..., 1] - y, position[..., 2] - z
