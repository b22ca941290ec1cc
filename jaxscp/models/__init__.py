"""Parameters and equations of what moves, transmits and stands in the way."""

from .channel import Channel as Channel
from .limits import Limits as Limits
from .obstacles import Cylinders as Cylinders
from .quadrotor import Quadrotor as Quadrotor, Rotors as Rotors
from .systems import (
    Brachistochrone as Brachistochrone,
    control_energy as control_energy,
    double_integrator as double_integrator,
    elapsed_time as elapsed_time,
    linear_hypersensitive as linear_hypersensitive,
)
