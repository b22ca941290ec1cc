"""The vehicle against SciPy's rotations, Newton and Euler, and its own rotors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from jaxscp.models import Quadrotor, Rotors

angle = st.floats(-1.2, 1.2)
rate = st.floats(-3.0, 3.0)
attitude = st.tuples(angle, angle, st.floats(-3.1, 3.1))
rates = st.tuples(rate, rate, rate)
torques = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@eqx.filter_jit
def compiled(vehicle, state, control):
    return vehicle(jnp.zeros(()), state, control)


def derivative(vehicle, state, control):
    return np.asarray(compiled(vehicle, jnp.asarray(state), jnp.asarray(control)))


def state_of(*, velocity=(0, 0, 0), attitude=(0, 0, 0), rates=(0, 0, 0)):
    return np.concatenate([(1.0, 2.0, 3.0), velocity, attitude, rates]).astype(float)


def rotation(attitude):
    """Body to earth: intrinsic turns about z, then y, then x."""
    roll, pitch, yaw = attitude
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()


@given(attitude, st.floats(0.0, 60.0))
def test_thrust_acts_along_the_body_axis(attitude, thrust):
    change = derivative(Quadrotor(), state_of(attitude=attitude), [thrust, 0.0, 0.0, 0.0])
    expected = rotation(attitude) @ [0.0, 0.0, thrust / 3.0] - [0.0, 0.0, 9.81]
    assert_allclose(change[3:6], expected, atol=1e-12)


@given(attitude, rates)
def test_angle_rates_turn_the_attitude_by_the_body_rates(attitude, rates):
    state = state_of(attitude=attitude, rates=rates)
    change = derivative(Quadrotor(), state, np.zeros(4))
    step = 1e-5
    ahead = rotation(attitude + step * change[6:9])
    behind = rotation(attitude - step * change[6:9])
    p, q, r = rates
    spin = np.array([[0, -r, q], [r, 0, -p], [-q, p, 0]])
    turned = rotation(attitude) @ spin
    assert_allclose((ahead - behind) / (2 * step), turned, atol=1e-5)


def test_angle_rates_by_hand():
    # Roll 30, pitch 60 degrees: tan 60 = sqrt 3, 1/cos 60 = 2.
    state = state_of(attitude=(np.pi / 6, np.pi / 3, 0.7), rates=(1.0, 2.0, 3.0))
    change = derivative(Quadrotor(), state, np.zeros(4))
    turning = 2 * 0.5 + 3 * np.sqrt(3) / 2
    expected = [1 + np.sqrt(3) * turning, 2 * np.sqrt(3) / 2 - 3 * 0.5, 2 * turning]
    assert_allclose(change[6:9], expected, rtol=1e-13)


def test_euler_equations_by_hand():
    # J w = (0.04, 0.08, 0.24), w x J w = (0.24, -0.12, 0).
    state = state_of(rates=(1.0, 2.0, 3.0))
    change = derivative(Quadrotor(), state, [0.0, 0.1, -0.2, 0.3])
    assert_allclose(change[9:], [-3.5, -2.0, 3.75], rtol=1e-13)


@given(rates, torques)
def test_euler_equations_with_three_different_moments(rates, torques):
    inertia = np.array([0.03, 0.05, 0.07])
    vehicle = Quadrotor(inertia=inertia)
    change = derivative(vehicle, state_of(rates=rates), [0.0, *torques])
    expected = (np.array(torques) - np.cross(rates, inertia * rates)) / inertia
    assert_allclose(change[9:], expected, atol=1e-11)


def test_free_fall():
    state = state_of(velocity=(4.0, 5.0, 6.0), attitude=(0.3, -0.2, 1.0))
    change = derivative(Quadrotor(), state, np.zeros(4))
    assert_allclose(change, [4, 5, 6, 0, 0, -9.81, 0, 0, 0, 0, 0, 0], atol=1e-15)


def test_hover_is_an_equilibrium():
    vehicle = Quadrotor(mass=2.5, gravity=1.62)
    assert float(vehicle.hover_thrust) == pytest.approx(2.5 * 1.62)
    change = derivative(
        vehicle, state_of(attitude=(0, 0, 0.4)), np.asarray(vehicle.hover_control)
    )
    assert_allclose(change, np.zeros(12), atol=1e-15)


@given(attitude, rates, torques, st.floats(-3.0, 3.0))
def test_no_direction_of_the_horizon_is_special(attitude, rates, torques, heading):
    control = [40.0, *torques]
    roll, pitch, yaw = attitude
    change = derivative(
        Quadrotor(),
        state_of(velocity=(1, 2, 3), attitude=attitude, rates=rates),
        control,
    )
    turn = Rotation.from_euler("Z", heading).as_matrix()
    turned = derivative(
        Quadrotor(),
        state_of(
            velocity=turn @ [1, 2, 3],
            attitude=(roll, pitch, yaw + heading),
            rates=rates,
        ),
        control,
    )
    expected = np.concatenate([turn @ change[:3], turn @ change[3:6], change[6:]])
    assert_allclose(turned, expected, atol=1e-11)


@given(st.tuples(*[st.floats(-600.0, 600.0)] * 4))
def test_rotor_forces_give_the_wrench_of_their_layout(speeds):
    vehicle = Quadrotor()
    # Front, left, back, right; 1 and 3 clockwise, dragging the body counterclockwise.
    places = 0.3 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    spins = np.array([1, -1, 1, -1])
    sizes = 58.86 / 4 * np.array(speeds) * np.abs(speeds) / 600.0**2
    forces = sizes[:, None] * [0, 0, 1]
    torque = np.cross(places, forces).sum(axis=0)
    torque[2] += np.sum(0.017 * spins * sizes)
    control = vehicle.control_from_rotors(jnp.asarray(speeds))
    assert_allclose(control, [sizes.sum(), *torque], atol=1e-12)
    assert_allclose(vehicle.rotor_speeds(control), speeds, atol=1e-4)


@given(st.floats(0.0, 60.0), torques)
def test_controls_survive_the_way_over_rotors(thrust, torques):
    vehicle = Quadrotor(rotors=Rotors(thrust_coefficient=3e-5, drag_ratio=0.02))
    control = jnp.asarray([thrust, *torques])
    back = vehicle.control_from_rotors(vehicle.rotor_speeds(control))
    assert_allclose(back, control, atol=1e-12)


def test_rotor_speeds_of_many_controls_at_once():
    vehicle = Quadrotor()
    controls = jnp.array([[20.0, 0.1, 0.0, 0.0], [30.0, 0.0, -0.2, 0.1]])
    one_by_one = jnp.stack([vehicle.rotor_speeds(control) for control in controls])
    assert_allclose(vehicle.rotor_speeds(controls), one_by_one)


def test_four_rotors_lift_twice_the_weight():
    vehicle = Quadrotor()
    assert float(vehicle.thrust_limit) == pytest.approx(58.86)
    assert float(vehicle.thrust_limit) == pytest.approx(2 * vehicle.hover_thrust)
    speeds = vehicle.rotor_speeds(2 * vehicle.hover_control)
    assert_allclose(speeds, np.full(4, 600.0), rtol=1e-12)


def test_torque_limits_are_reached_by_rotors_at_full_speed():
    vehicle = Quadrotor()
    full = [
        vehicle.control_from_rotors(jnp.asarray(speeds))
        for speeds in ([0, 600.0, 0, 0], [0, 0, 600.0, 0], [600.0, 0, 600.0, 0])
    ]
    reached = [full[0][1], full[1][2], full[2][3]]
    assert_allclose(vehicle.torque_limits, reached, rtol=1e-12)
    assert np.all(np.asarray(vehicle.torque_limits) >= [1.0, 1.0, 0.5])


def test_what_rotors_cannot_give_stays_visible():
    vehicle = Quadrotor()
    speeds = np.asarray(vehicle.rotor_speeds(jnp.array([0.0, 1.0, 0.0, 0.0])))
    assert speeds[1] > 0 > speeds[3]
    speeds = np.asarray(vehicle.rotor_speeds(jnp.array([58.86, 1.0, 0.0, 0.0])))
    assert speeds.max() > 600.0


def test_derivatives_are_finite_with_rotors_at_rest():
    slope = jax.jacfwd(Quadrotor().rotor_speeds)(jnp.zeros(4))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [("mass", -1.0), ("mass", np.nan), ("arm_length", 0.0), ("gravity", -9.81)],
)
def test_impossible_numbers_are_refused(field, value):
    with pytest.raises(ValueError, match=rf"Quadrotor\.{field}=.*give a finite number"):
        Quadrotor(**{field: value})


def test_impossible_inertia_is_refused():
    with pytest.raises(ValueError, match=r"Quadrotor\.inertia\[1\]=0"):
        Quadrotor(inertia=[0.04, 0.0, 0.08])
    with pytest.raises(ValueError, match=r"Quadrotor\.inertia has shape \(2,\)"):
        Quadrotor(inertia=[0.04, 0.04])


def test_impossible_rotors_are_refused():
    with pytest.raises(ValueError, match=r"Rotors\.drag_ratio=0"):
        Rotors(drag_ratio=0.0)


def test_every_number_is_a_parameter():
    def upward(vehicle):
        return vehicle(jnp.zeros(()), jnp.zeros(12), jnp.array([30.0, 0, 0, 0]))[5]

    gradient = eqx.filter_grad(upward)(Quadrotor())
    assert float(gradient.mass) == pytest.approx(-30.0 / 9.0)
    assert float(gradient.gravity) == pytest.approx(-1.0)


def test_a_vehicle_can_be_made_of_traced_values():
    def weight(mass):
        return Quadrotor(mass=mass).hover_thrust

    assert float(jax.jit(jax.grad(weight))(3.0)) == pytest.approx(9.81)
