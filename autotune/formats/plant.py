"""A plant that a person writes, in Python or as `plant.yaml`: the few numbers that a controller is designed for."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from autotune.arguments import file_path
from autotune.shown import ResultTable, Said, data_frame
from identification.result import (
    AxisEstimate,
    CouplingEstimate,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    PayloadEstimate,
    RobotEstimate,
    SensorEstimate,
    Status,
    VectorEstimate,
    WrenchFilterEstimate,
)
from problems.errors import ParameterError
from problems.frozen import FrozenDict
from problems.model.robot import bandwidth_hz

from .atomic import check_target, write_atomic
from .identified import IN_MEMORY, IdentifiedFile
from .quantity import Interval, Quantity, Uncertain, as_interval, as_number, as_numbers, as_quantity, nominal_value
from .robot import LONGEST_DELAY_S, Robot
from .schema import VERSION
from .stiffness_units import DOUBTFUL_N_PER_M, check_surface_unit, doubtful_surface, interval_text
from .written_values import UNITS, value_numbers, value_texts
from .yaml12 import dump_yaml

FORMAT = "autotune/plant"
TAKEN_AS_EXACT = "taken-as-exact"
"""Code of the finding that says what was given as a plain number."""
NO_DELAY_GIVEN = "The robot's delay was not given: 0 s was taken."
Vector = tuple[float, float, float]
_UNKNOWN = "not known: the plant was written by hand"
# Of each component, as a controller file holds them.
_MOST_OF_A_COMPONENT = {"centre_of_mass": 2.0, "force_bias": 300.0, "torque_bias": 50.0}
_LONGEST_ARM_M, _HEAVIEST_KG, _SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 2.0, 1000.0, 1e-5, 0.1
# As a controller file holds them, docs/files.md.
_MOST: Mapping[str, float] = FrozenDict(
    {
        "mass": _HEAVIEST_KG,
        "environment_stiffness": 1e9,
        "coupling_stiffness": 1e9,
        "coupling_damping": 1e7,
        "drag": 1e6,
    }
)
# From a stiffness in N/mm or kN/m that is written as N/m the payload hangs far down.
_GRAVITY, _IMPOSSIBLE_SAG_M, _DOUBTFUL_SAG_M = 9.81, 0.1, 0.02
DOMAIN_NAMES: Mapping[str, str] = FrozenDict(
    {
        "mass": "payload_mass_kg",
        "environment_stiffness": "environment_stiffness_n_per_m",
        "coupling_stiffness": "coupling_stiffness_n_per_m",
        "coupling_damping": "coupling_damping_n_s_per_m",
        "drag": "drag_n_s_per_m",
        "robot.bandwidth": "robot_bandwidth_hz",
        "robot.damping_ratio": "robot_damping_ratio",
        "robot.delay": "delay_s",
        "wrench_delay": "wrench_delay_s",
        "wrench_corner": "wrench_time_constant_s",
    }
)
"""What a name of a plant that a person writes is called in files and in sets of plants."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Plant(Said):
    """One straight axis of a cell as a person knows it, in SI.

    A plain number is **exact**: what is certified holds for that number only. A range (low, high) must all be safe, and
    so must three deviations to each side of an `Uncertain`. Everything but `mass` to `sample_time` may be left out.

    Parameters
    ----------
    mass
        Payload behind the coupling and the sensor [kg].
    coupling_stiffness
        Stiffness between flange and payload, the sensor's included [N/m].
    drag
        Damping of the payload to ground [N·s/m].
    robot
        How the flange follows a commanded position.
    environment_stiffness
        Of what is touched [N/m].
    sample_time
        Period of the controller [s].
    coupling_damping
        Damping between flange and payload [N·s/m].
    axis
        Name of the axis in the control frame: x, y or z.
    centre_of_mass
        Of the payload in the sensor frame, three numbers [m].
    force_bias, torque_bias
        What the sensor shows of no load, three numbers each [N] and [N·m].
    force_noise
        Noise of the force sensor [N RMS].
    wrench_corner
        Corner frequency of a first-order low-pass filter of the wrench [Hz].
    wrench_delay
        Delay of the wrench against the measured pose [s]; not together with a corner.

    Raises
    ------
    ParameterError
        An argument is no such number, or out of the range in which the equations mean something; a stiffness so low
        that it must be of another unit than N/m.

    Notes
    -----
    Without centre of mass and bias, or with a range of mass, the runtime cannot compensate gravity: the controller file
    then says that the payload is set in the cell, and the runtime does not start without it.

    Examples
    --------
    >>> import autotune as at
    >>> plant = at.Plant(mass=16, coupling_stiffness=3e5, drag=630, robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
    ...                  environment_stiffness=(2e4, 5e5), sample_time=8e-4)
    >>> plant.exact()
    ('mass', 'coupling_stiffness', 'coupling_damping', 'drag', 'robot.bandwidth', 'robot.delay')

    """

    mass: Quantity
    coupling_stiffness: Quantity
    drag: Quantity
    robot: Robot
    environment_stiffness: Quantity
    sample_time: float
    coupling_damping: Quantity = 0.0
    axis: str = "x"
    centre_of_mass: Vector | None = None
    force_bias: Vector | None = None
    torque_bias: Vector | None = None
    force_noise: float | None = None
    wrench_corner: float | None = None
    wrench_delay: float | None = None

    def __post_init__(self) -> None:
        if self.axis not in ("x", "y", "z"):
            raise ParameterError("axis", self.axis, "x, y or z")
        if not isinstance(self.robot, Robot):
            raise ParameterError("robot", self.robot, "a Robot")
        for name in ("mass", "coupling_stiffness", "coupling_damping", "drag", "environment_stiffness"):
            may_vanish = name in {"coupling_damping", "drag"}
            object.__setattr__(self, name, as_quantity(name, getattr(self, name), may_vanish=may_vanish))
        for name in ("sample_time", "force_noise", "wrench_corner", "wrench_delay"):
            if name == "sample_time" or getattr(self, name) is not None:
                object.__setattr__(self, name, as_number(name, getattr(self, name)))
                as_interval(name, getattr(self, name), may_vanish=name == "wrench_delay")
        for name in ("centre_of_mass", "force_bias", "torque_bias"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_numbers(name, getattr(self, name), 3))
        self._check_bounds()
        self._check_units()

    def _check_bounds(self) -> None:
        for name, most in _MOST_OF_A_COMPONENT.items():
            given = getattr(self, name)
            if given is not None and max(map(abs, given)) > most:
                raise ParameterError(name, given, f"at most {most:g} {UNITS[name]} along every axis")
        if self.centre_of_mass is not None and math.hypot(*self.centre_of_mass) > _LONGEST_ARM_M:
            raise ParameterError("centre_of_mass", self.centre_of_mass, f"within {_LONGEST_ARM_M:g} m of the sensor")
        if self.sample_time > _LONGEST_PERIOD_S:
            raise ParameterError("sample_time", self.sample_time, f"at most {_LONGEST_PERIOD_S:g} s")
        if self.sample_time < _SHORTEST_PERIOD_S:
            raise ParameterError("sample_time", self.sample_time, f"at least {_SHORTEST_PERIOD_S:g} s")
        for name, most in _MOST.items():
            if self._intervals()[name][1] > most:
                raise ParameterError(name, getattr(self, name), f"at most {most:g} {UNITS[name]}")
        if self.wrench_delay is not None and self.wrench_corner is not None:
            raise ParameterError("wrench_delay", self.wrench_delay, "left out beside wrench_corner")
        if self.wrench_delay is not None and self.wrench_delay >= LONGEST_DELAY_S:
            raise ParameterError("wrench_delay", self.wrench_delay, f"below {LONGEST_DELAY_S:g} s")

    def _check_units(self) -> None:
        """Refuse a stiffness that can only be meant in N/mm or kN/m."""
        coupling = self._intervals()["coupling_stiffness"]
        if self._sag_m() > _IMPOSSIBLE_SAG_M:
            must = f"in N/m: from this one the payload hangs {self._sag_m():.2g} m down"
            meant = f"{must} (did you mean {interval_text(coupling, 1e3)}?)"
            raise ParameterError("coupling_stiffness", self.coupling_stiffness, meant)
        check_surface_unit(self._intervals()["environment_stiffness"], self.environment_stiffness)

    def _sag_m(self) -> float:
        """Return how far the payload hangs down from its coupling at least, M_p g/K_s."""
        within = self._intervals()
        return within["mass"][0] * _GRAVITY / within["coupling_stiffness"][1]

    def doubtful_units(self) -> Iterator[str]:
        """Yield a sentence for each stiffness that is possible in N/m, and usual in N/mm or kN/m."""
        coupling = self._intervals()["coupling_stiffness"]
        yield from doubtful_surface(self._intervals()["environment_stiffness"])
        if self._sag_m() > _DOUBTFUL_SAG_M or coupling[1] < DOUBTFUL_N_PER_M:
            yield (
                f"A coupling_stiffness of {interval_text(coupling)} N/m is very soft: the payload hangs "
                f"{1e3 * self._sag_m():.3g} mm down from it. If it was meant in N/mm or kN/m, write "
                f"{interval_text(coupling, 1e3)}."
            )

    def _intervals(self) -> dict[str, Interval]:
        """Return the lowest and highest value by name as written, `robot.` before those of the robot."""
        names = ("mass", "coupling_stiffness", "coupling_damping", "drag", "environment_stiffness")
        own = {name: as_interval(name, getattr(self, name), may_vanish=True) for name in names}
        return own | {f"robot.{name}": each for name, each in self.robot.ranges().items()}

    def exact(self) -> tuple[str, ...]:
        """Return the names of what is taken as exact, because it was given as a plain number."""
        numbers = [name for name, (low, high) in self._intervals().items() if low == high]
        polynomials = [
            f"robot.{name}" for name in ("numerator", "denominator") if getattr(self.robot, name) is not None
        ]
        wrench = [name for name in ("wrench_corner", "wrench_delay") if getattr(self, name) is not None]
        return (*numbers, *polynomials, *wrench)

    def knows_mass(self) -> bool:
        """Return whether one mass is known to compensate: a number or the value of an `Uncertain`, not a range."""
        low, high = self._intervals()["mass"]
        return isinstance(self.mass, Uncertain) or low == high

    def domain(self) -> dict[str, Interval]:
        """Return the set that a controller must be safe for, by the names of `problem.yaml`."""
        found = {DOMAIN_NAMES[name]: each for name, each in self._intervals().items()}
        always = ("payload_mass_kg", "environment_stiffness_n_per_m")
        return {name: each for name, each in found.items() if name in always or each[0] < each[1]}

    def _headline(self) -> str:
        return f"Plant of axis {self.axis}"

    def _written(self) -> dict[str, Any]:
        """Return what was said but for the axis, by name as written, `robot.` before what was said of the robot."""
        every = {**_tree(self), **{f"robot.{name}": each for name, each in _tree(self.robot).items()}}
        return {name: value for name, value in every.items() if name not in ("robot", "axis")}

    def _tables(self) -> Iterator[ResultTable]:
        rows = tuple((name, *value_texts(name, value), UNITS.get(name, "")) for name, value in self._written().items())
        yield ResultTable(title="parameters", columns=("parameter", "value", "taken as", "unit"), rows=rows)

    def _notes(self) -> Sequence[str]:
        return [f"{each.message} {each.advice}" for each in _findings(self)]

    def to_dict(self) -> dict[str, Any]:
        """Return the tree of `plant.yaml`."""
        return {"format": FORMAT, "version": VERSION, **_tree(self)}

    def to_pandas(self) -> Any:
        """Return the parameters as a pandas.DataFrame of SI numbers, by name as in `robot.delay` and `force_bias.x`.

        Columns are `value` and `std` (NaN of a range, 0 of what is exact), `low` and `high` between which all must be
        safe, and `unit`.

        Raises
        ------
        UsageError
            pandas is not installed.

        """
        rows = {name: row for key, value in self._written().items() for name, row in value_numbers(key, value)}
        columns = {name: [row[i] for row in rows.values()] for i, name in enumerate(("value", "std", "low", "high"))}
        units = [UNITS.get(name) or UNITS.get(name.rpartition(".")[0], "") for name in rows]
        return data_frame({**columns, "unit": units}, list(rows))

    def save(self, path: Path | str) -> str:
        """Write `plant.yaml` in one step and return its sha256.

        Raises UsageError where it cannot be written, or a file of another kind would be lost.
        """
        target = file_path("path", path)
        check_target(target, kind="plant", option="path")
        text = dump_yaml(self.to_dict())
        write_atomic(target, text)
        return sha256(text.encode()).hexdigest()

    def file(self, path: Path = IN_MEMORY, digest: str | None = None) -> IdentifiedFile:
        """Return the plant in the form in which a log's is handed on, every value marked as given."""
        text = dump_yaml(self.to_dict())
        return IdentifiedFile(
            result=_identified(self),
            provenance={"plant": _tree(self), "exact": list(self.exact())},
            path=path,
            sha256=digest if digest is not None else sha256(text.encode()).hexdigest(),
            domain=self.domain(),
        )


def exact_within(exact: Sequence[str], ranges: Mapping[str, Interval]) -> tuple[str, ...]:
    """Return the names of what a design takes as exact: those of the plant, but for what it was given a range of.

    `ranges` are those of the design, by the names of `problem.yaml`; a plain number there is exact as well.
    """
    asked = {name: ranges[key] for name, key in DOMAIN_NAMES.items() if key in ranges}
    names = [name for name in (*DOMAIN_NAMES, *exact) if name in exact or name in asked]
    return tuple(name for name in dict.fromkeys(names) if name not in asked or asked[name][0] == asked[name][1])


def exact_message(names: Sequence[str]) -> str:
    """Return what it means that these are exact; empty where there is nothing to say."""
    holds = "Taken as exact, so what is certified holds for these numbers only:"
    return f"{holds} {', '.join(names)}." if names else ""


def _tree(record: Plant | Robot) -> dict[str, Any]:
    """Return what was said, numbers as they were written; what was left out is left out."""
    tree: dict[str, Any] = {}
    for each in fields(record):
        value = getattr(record, each.name)
        if value is None or value == each.default:
            continue
        if isinstance(value, Robot):
            value = _tree(value)
        elif isinstance(value, Uncertain):
            value = {"value": value.value, "std": value.std}
        tree[each.name] = list(value) if isinstance(value, tuple) else value
    return tree


def _given(value: float | None) -> Estimate:
    status = Status.UNIDENTIFIABLE if value is None else Status.GIVEN
    return Estimate(
        value=value, std=None if value is None else 0.0, status=status, note=_UNKNOWN if value is None else ""
    )


def _vector(value: tuple[float, ...] | None) -> VectorEstimate:
    std = None if value is None else (0.0,) * len(value)
    return VectorEstimate(value=value, std=std, status=Status.GIVEN, note=_UNKNOWN if value is None else "")


def _identified(plant: Plant) -> Identified:
    robot = plant.robot
    nominal = {
        name: nominal_value(getattr(robot if name.startswith("robot.") else plant, name.removeprefix("robot.")), each)
        for name, each in plant._intervals().items()  # noqa: SLF001 - of this module
    }
    stiffness, coupling = nominal["environment_stiffness"], nominal["coupling_stiffness"]
    model, mass = robot.model(), _given(nominal["mass"])
    if not plant.knows_mass():
        # No deviation: the middle of the range, which is not the mass to compensate.
        mass = replace(mass, std=None, note="any mass of the range; the one to compensate is not known")
    surface = EnvironmentEstimate(
        name="surface",
        stiffness_n_per_m=_given(stiffness),
        secant_stiffness_n_per_m=_given(stiffness * coupling / (stiffness + coupling)),
        damping_n_s_per_m=_given(None),
        mass_kg=_given(None),
        contacts=0,
        peak_force_n=(),
    )
    axis = AxisEstimate(
        coupling=CouplingEstimate(
            stiffness_n_per_m=_given(coupling), damping_n_s_per_m=_given(nominal["coupling_damping"])
        ),
        drag_n_s_per_m=_given(nominal["drag"]),
        environments=(surface,),
        robot=RobotEstimate(
            numerator=_vector(tuple(float(each) for each in model.numerator)),
            denominator=_vector(tuple(float(each) for each in model.denominator)),
            delay_s=_given(model.delay_s),
            bandwidth_hz=_given(bandwidth_hz(model)),
        ),
    )
    return Identified(
        sample_time_s=_given(plant.sample_time),
        payload=PayloadEstimate(mass_kg=mass, com_m=_vector(plant.centre_of_mass)),
        axes={plant.axis: axis},
        sensor=SensorEstimate(
            force_bias_n=_vector(plant.force_bias),
            torque_bias_n_m=_vector(plant.torque_bias),
            force_noise_rms_n=_given(plant.force_noise),
            gravity_residual_rms_n=_given(None),
            deadband_n=_given(None),
            wrench_filter=_wrench_filter(plant),
        ),
        findings=tuple(_findings(plant)),
    )


def _wrench_filter(plant: Plant) -> WrenchFilterEstimate | None:
    if plant.wrench_corner is not None:
        return WrenchFilterEstimate(corner_hz=_given(plant.wrench_corner))
    return None if plant.wrench_delay is None else WrenchFilterEstimate(delay_s=_given(plant.wrench_delay))


def _findings(plant: Plant) -> list[Finding]:
    """Say what the certificate of such a plant cannot hold for."""
    found = [Finding.warning("unit-suspected", sentence, "") for sentence in plant.doubtful_units()]
    if plant.robot.delay is None:
        advice = "Give the robot's delay, a range of it where it is not known: a later robot leaves less margin."
        found.append(Finding.warning("delay-not-given", NO_DELAY_GIVEN, advice))
    exact = plant.exact()
    if exact:
        found.append(
            Finding(
                code=TAKEN_AS_EXACT,
                severity="warning",
                message=exact_message(exact),
                advice="Give a range (low, high), or a value with its deviation, for what is not known exactly.",
            )
        )
    names = ("centre_of_mass", "force_bias", "torque_bias")
    missing = [name for name in names if getattr(plant, name) is None]
    given = [name for name in names if name not in missing]
    unknown = missing if plant.knows_mass() else ["the one mass to compensate (mass is a range)", *missing]
    if unknown:
        ignored = f" What was given of the payload ({', '.join(given)}) is ignored there." if given else ""
        found.append(
            Finding(
                code="payload-unknown",
                severity="warning",
                message=f"Not known: {', '.join(unknown)}. So the runtime cannot compensate gravity with this "
                f"controller (set_in_cell): it does not start until the whole payload is given there.{ignored}",
                advice="Give mass (a number or Uncertain), centre_of_mass, force_bias and torque_bias, or identify the "
                "payload from a log.",
            )
        )
    return found
