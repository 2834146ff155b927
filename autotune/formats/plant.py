"""A plant that a person writes, in Python or as `plant.yaml`: the few numbers that a controller is designed for."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from autotune.errors import UsageError
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
from problems.model.robot import RobotModel, bandwidth_hz, bandwidth_share

from .atomic import check_target, write_atomic
from .identified import IN_MEMORY, IdentifiedFile, read_identified
from .quantity import Interval, Quantity, Uncertain, as_interval, nominal_value
from .schema import VERSION, check_document, check_format
from .yaml12 import Document, dump_yaml, kind_of_file, load_document

FORMAT = "autotune/plant"
Vector = tuple[float, float, float]
_UNKNOWN = "not known: the plant was written by hand"


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A position-controlled robot: how its flange follows a commanded position, r(s) exp(-s delay) with r(0) = 1.

    Parameters
    ----------
    bandwidth
        Frequency at which the gain falls to 1/sqrt(2) [Hz]: a robot of one pole, or with `damping_ratio` of two.
    delay
        Dead time from command to motion, without the hold of one period [s].
    damping_ratio
        Of a robot with two poles [1].
    numerator, denominator
        Instead of a bandwidth: coefficients of r(s) in descending powers of s [rad/s].

    Raises
    ------
    ParameterError
        Neither or both of bandwidth and coefficients are given, a number is out of range, or r(s) is unstable, not
        strictly proper, or not 1 at s = 0.

    """

    bandwidth: Quantity | None = None
    delay: Quantity = 0.0
    damping_ratio: Quantity | None = None
    numerator: tuple[float, ...] | None = None
    denominator: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if (self.numerator is None) != (self.denominator is None):
            raise ParameterError("numerator", self.numerator, "given together with the denominator")
        if (self.bandwidth is None) == (self.numerator is None):
            must = "given, or numerator and denominator instead, not both"
            raise ParameterError("bandwidth", self.bandwidth, must)
        if self.damping_ratio is not None and self.bandwidth is None:
            raise ParameterError("damping_ratio", self.damping_ratio, "left out where coefficients are given")
        for name in ("numerator", "denominator"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(float(each) for each in getattr(self, name)))
        self.model()

    def ranges(self) -> dict[str, Interval]:
        """Return the lowest and highest value of bandwidth [Hz], damping ratio and delay [s], as far as given."""
        given = {"bandwidth": self.bandwidth, "damping_ratio": self.damping_ratio, "delay": self.delay}
        return {
            name: as_interval(name, each, may_vanish=name == "delay")
            for name, each in given.items()
            if each is not None
        }

    def model(self) -> RobotModel:
        """Return the nominal robot."""
        nominal = {name: nominal_value(getattr(self, name), each) for name, each in self.ranges().items()}
        if self.numerator is not None and self.denominator is not None:
            numerator, denominator = list(self.numerator), list(self.denominator)
        elif self.damping_ratio is None:
            # |r| = 1/sqrt(2) of one pole is at the pole itself.
            omega = 2.0 * math.pi * nominal["bandwidth"]
            numerator, denominator = [omega], [1.0, omega]
        else:
            ratio = nominal["damping_ratio"]
            omega = 2.0 * math.pi * nominal["bandwidth"] / bandwidth_share(ratio)
            numerator, denominator = [omega**2], [1.0, 2.0 * ratio * omega, omega**2]
        return RobotModel(numerator=numerator, denominator=denominator, delay_s=nominal["delay"])  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class Plant:
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
        A number is out of the range in which the equations mean something.

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
        if self.axis not in {"x", "y", "z"}:
            raise ParameterError("axis", self.axis, "x, y or z")
        for name in ("sample_time", "force_noise", "wrench_corner"):
            if getattr(self, name) is not None:
                as_interval(name, getattr(self, name), may_vanish=False)
        if self.wrench_delay is not None:
            as_interval("wrench_delay", self.wrench_delay, may_vanish=True)
            if self.wrench_corner is not None:
                raise ParameterError("wrench_delay", self.wrench_delay, "left out beside wrench_corner")
        for name in ("centre_of_mass", "force_bias", "torque_bias"):
            given = getattr(self, name)
            if given is not None:
                if len(given) != 3:
                    raise ParameterError(name, given, "three numbers")
                object.__setattr__(self, name, tuple(float(each) for each in given))
                if not all(math.isfinite(each) for each in getattr(self, name)):
                    raise ParameterError(name, given, "three finite numbers")
        self._check_bounds()
        self._intervals()

    def _check_bounds(self) -> None:
        if self.centre_of_mass is not None and math.hypot(*self.centre_of_mass) > 2.0:
            raise ParameterError("centre_of_mass", self.centre_of_mass, "within 2 m of the sensor")
        if not isinstance(self.robot, Robot):
            raise ParameterError("robot", self.robot, "a Robot")
        if isinstance(self.sample_time, tuple | list | Uncertain) or self.sample_time > 0.1:
            raise ParameterError("sample_time", self.sample_time, "one number, at most 0.1 s")

    def _intervals(self) -> dict[str, Interval]:
        """Return the lowest and highest value by name as written, `robot.` before those of the robot."""
        own = {
            name: as_interval(name, getattr(self, name), may_vanish=name in {"coupling_damping", "drag"})
            for name in ("mass", "coupling_stiffness", "coupling_damping", "drag", "environment_stiffness")
        }
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
        names = {
            "mass": "payload_mass_kg",
            "environment_stiffness": "environment_stiffness_n_per_m",
            "coupling_stiffness": "coupling_stiffness_n_per_m",
            "coupling_damping": "coupling_damping_n_s_per_m",
            "drag": "drag_n_s_per_m",
            "robot.bandwidth": "robot_bandwidth_hz",
            "robot.damping_ratio": "robot_damping_ratio",
            "robot.delay": "delay_s",
        }
        found = {names[name]: each for name, each in self._intervals().items()}
        always = ("payload_mass_kg", "environment_stiffness_n_per_m")
        return {name: each for name, each in found.items() if name in always or each[0] < each[1]}

    def to_dict(self) -> dict[str, Any]:
        """Return the tree of `plant.yaml`."""
        return {"format": FORMAT, "version": VERSION, **_tree(self)}

    def save(self, path: Path | str) -> None:
        """Write `plant.yaml` in one step; raises UsageError where it cannot, or another kind of file would be lost."""
        check_target(path, kind="plant", option="path")
        write_atomic(path, dump_yaml(self.to_dict()))

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
            value = {"value": float(value.value), "std": float(value.std)}
        elif isinstance(value, tuple | list):
            value = [float(part) for part in value]
        elif isinstance(value, int | float):
            value = float(value)
        tree[each.name] = value
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
    found, exact = [], ", ".join(plant.exact())
    if exact:
        found.append(
            Finding(
                code="taken-as-exact",
                severity="warning",
                message=f"Taken as exact, so what is certified holds for these numbers only: {exact}.",
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


def read_plant(path: Path | str) -> IdentifiedFile:
    """Read `identified.yaml`, or a `plant.yaml` that a person wrote.

    Raises UsageError: the file cannot be read, is neither, or an entry is missing, unknown or out of range; the text
    names file, line and key.
    """
    kind = kind_of_file(Path(path))
    if kind == "identified":
        return read_identified(path)
    document = load_document(path, error=UsageError)
    if kind != "plant":
        found = f"autotune/{kind}" if kind else "no such key"
        document.refuse(("format",), f"format must be autotune/identified or {FORMAT}, found {found}.")
    return parse_plant(document).file(document.path, document.sha256)


def parse_plant(document: Document) -> Plant:
    """Return the plant of a file that was loaded; raises UsageError as `read_plant`."""
    check_format(document, "plant")
    check_document(document, "plant")
    tree = {key: value for key, value in document.tree.items() if key not in ("format", "version")}
    within: tuple[str, ...] = ("robot",)
    try:
        robot = Robot(
            **{name: _quantity(value, (*within, name), document) for name, value in tree.pop("robot").items()}
        )
        within = ()
        return Plant(robot=robot, **{name: _quantity(value, (name,), document) for name, value in tree.items()})
    except ParameterError as error:
        place = (*within, *error.name.split("."))
        document.refuse(place if place in document.lines else within, str(error))


def _quantity(value: Any, place: tuple[str, ...], document: Document) -> Any:
    if isinstance(value, Mapping):
        try:
            return Uncertain(float(value["value"]), float(value["std"]))
        except ParameterError as error:
            document.refuse((*place, error.name), str(error))
    return tuple(value) if isinstance(value, list) else value
