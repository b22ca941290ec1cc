"""The channel against the paper's formulas and their closed-form limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxscp.models import Channel

STATION = np.array([200.0, 400.0, 0.0])
offset = st.floats(-1000.0, 1000.0)
offsets = st.tuples(offset, offset, offset)
above = st.tuples(offset, offset, st.floats(1.0, 500.0))


def at(offset):
    return jnp.asarray(STATION + np.asarray(offset, float))


@given(above)
def test_the_paper_s_formulas(offset):
    channel, position = Channel(), at(offset)
    distance = np.linalg.norm(offset)
    elevation = np.degrees(np.arcsin(offset[2] / distance))
    direct = 1 / (1 + 10 * np.exp(-0.6 * (elevation - 10)))
    effective = 0.2 + 0.8 * direct
    gain = effective * distance**-2.3
    # Rounding off within a millimetre turns the elevation by up to 1e-3/1 rad.
    assert_allclose(channel.elevation(position), elevation, atol=0.06)
    assert_allclose(channel.line_of_sight_probability(position), direct, rtol=2e-3)
    assert_allclose(channel.effective_probability(position), effective, rtol=2e-3)
    assert_allclose(channel.expected_gain(position, 7.0), 7.0 * gain, rtol=2e-3)
    rate = 1e6 * np.log2(1 + 60 * gain)
    assert_allclose(channel.rate(position), rate, rtol=2e-3)


def test_elevation_overhead_and_on_the_horizon():
    elevation = Channel().elevation
    assert float(elevation(at([0, 0, 100]))) == pytest.approx(90.0, abs=1e-3)
    assert float(elevation(at([0, 0, -100]))) == pytest.approx(-90.0, abs=1e-3)
    assert float(elevation(at([30, 40, 50]))) == pytest.approx(45.0, abs=1e-3)
    assert float(elevation(at([1e5, 0, 10]))) == pytest.approx(0.0, abs=1e-2)


@given(st.floats(1.0, 30.0), st.floats(0.05, 2.0))
def test_line_of_sight_probability_at_the_threshold(a1, a2):
    channel = Channel(environment=[a1, a2])
    distance = 1000.0
    place = at([distance, 0, distance * np.tan(np.radians(a1))])
    probability = float(channel.line_of_sight_probability(place))
    assert probability == pytest.approx(1 / (1 + a1), rel=1e-5)


@given(offsets)
def test_effective_probability_lies_between_zeta_and_one(offset):
    probability = float(Channel().effective_probability(at(offset)))
    assert 0.2 <= probability <= 1.0


def test_hovering_above_the_station_with_b_60():
    rate = float(Channel().rate(at([0, 0, 10])))
    assert rate == pytest.approx(0.379e6, rel=1e-3)
    # A line of sight is certain there.
    assert rate == pytest.approx(1e6 * np.log2(1 + 60 / 10**2.3), rel=1e-7)


def test_far_away_the_rate_keeps_its_digits():
    # log2(1 + s) -> s / ln 2 with only reflections on the horizon.
    distance = 1e8
    rate = float(Channel().rate(at([distance, 0, 0])))
    direct = 1 / (1 + 10 * np.exp(6.0))
    signal = 60 * (0.2 + 0.8 * direct) * distance**-2.3
    assert rate == pytest.approx(1e6 * signal / np.log(2), rel=1e-10)


@given(offsets, st.floats(1.0, 1e6), st.floats(1.01, 10.0))
def test_rate_grows_with_b_and_with_bandwidth(offset, b, factor):
    rate = float(Channel(snr_constant=b).rate(at(offset)))
    assert float(Channel(snr_constant=factor * b).rate(at(offset))) > rate > 0
    wider = Channel(snr_constant=b, bandwidth=factor * 1e6)
    assert float(wider.rate(at(offset))) == pytest.approx(factor * rate)


@given(offsets, st.floats(-3.0, 3.0))
def test_rate_depends_on_no_direction_of_the_horizon(offset, heading):
    turned = Rotation.from_euler("Z", heading).apply(offset)
    rates = [float(Channel().rate(at(place))) for place in (offset, turned)]
    assert rates[0] == pytest.approx(rates[1], rel=1e-6)


def test_b_from_power():
    channel = Channel.from_power(5.0, 1e-4, 1e-9, 2.0, bandwidth=2e6)
    assert float(channel.snr_constant) == pytest.approx(5.0 * 1e-4 / (1e-9 * 2.0))
    assert float(channel.bandwidth) == 2e6


@pytest.mark.parametrize("snr_constant", [60.0, 1e6])
@pytest.mark.parametrize(
    "function", ["elevation", "effective_probability", "expected_gain", "rate"]
)
def test_values_and_derivatives_are_finite(function, snr_constant):
    value = getattr(Channel(snr_constant=snr_constant), function)

    @jax.jit
    def all_of_them(position):
        transforms = (jax.jacfwd, jax.jacrev, jax.hessian)
        return value(position), [of(value)(position) for of in transforms]

    @given(offsets)
    @example((0.0, 0.0, 0.0))
    @example((0.0, 0.0, 10.0))
    @example((0.0, 0.0, -10.0))
    @example((1e-9, 0.0, 10.0))
    @example((1e-200, 0.0, 1e-200))
    @example((10.0, 0.0, 0.0))
    @example((1e7, -1e7, 1e5))
    def check(offset):
        for result in jax.tree.leaves(all_of_them(at(offset))):
            assert np.isfinite(result).all()

    check()


@given(above)
def test_slope_of_the_rate_against_finite_differences(offset):
    channel, position = Channel(snr_constant=1e6), at(offset)
    slope = jax.grad(channel.rate)(position)
    ahead, behind = (
        channel.rate(jnp.tile(position, (3, 1)) + step)
        for step in (1e-3 * jnp.eye(3), -1e-3 * jnp.eye(3))
    )
    assert_allclose(slope, (ahead - behind) / 2e-3, rtol=1e-4, atol=1.0)


def test_as_an_integrand_it_reads_the_position():
    channel = Channel()
    state = jnp.concatenate([at([3, 4, 20]), jnp.full(9, 7.0)])
    rate = channel(jnp.zeros(()), state, jnp.ones(4))
    assert float(rate) == float(channel.rate(at([3, 4, 20])))
    assert rate.shape == ()


def test_throughput_of_a_hover_is_rate_times_duration():
    channel = Channel()
    times = jnp.array([0.0, 1.0, 4.0, 10.0])
    positions = jnp.broadcast_to(at([0, 0, 10]), (4, 3))
    expected = 10.0 * float(channel.rate(at([0, 0, 10])))
    assert float(channel.throughput(times, positions)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("ground_station", [1.0, 2.0], r"ground_station has shape \(2,\): give 3"),
        ("ground_station", [1.0, 2.0, np.inf], r"ground_station\[2\]=inf"),
        ("reflection_attenuation", 1.5, r"=1.5: give .* at most 1"),
        ("bandwidth", 0.0, r"bandwidth=0: give .* above 0 \[Hz\]"),
        ("snr_constant", -60.0, r"snr_constant=-60"),
    ],
)
def test_impossible_numbers_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        Channel(**{field: value})
