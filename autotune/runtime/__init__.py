"""The cell's side: load a controller file and step its six axes. Needs the YAML parser, and no other library."""

from autotune.formats.limits import AxisLimits, CollisionResponse, Limits
from autotune.formats.units import AXES

from .change import change
from .controller import RuntimeController
from .law import AxisLaw, Payload
from .load import load_controller
from .step import START, Command, Fault, Phase, State, rearm, step

__all__ = [
    "AXES",
    "START",
    "AxisLaw",
    "AxisLimits",
    "CollisionResponse",
    "Command",
    "Fault",
    "Limits",
    "Payload",
    "Phase",
    "RuntimeController",
    "State",
    "change",
    "load_controller",
    "rearm",
    "step",
]
