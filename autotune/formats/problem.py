"""`problem.yaml`: what the user asks of the controller."""

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from autotune.errors import UsageError
from autotune.plugins import build_requirements, find_requirement, load_objective, load_requirement, objective_names
from autotune.shown import ResultTable, Said, leaves, plain_tree
from problems.contact.transient import Approach
from problems.design.evaluation import CustomRequirement
from problems.design.objectives import BUILT_IN as BUILT_IN_OBJECTIVES
from problems.design.objectives import CONTACT_FORCE, Objective
from problems.design.problem import FURTHER_VARIABLES, VARIABLES
from problems.design.requirements import BUILT_IN, FIELDS, Requirement, Requirements
from problems.design.uncertainty import FURTHER_UNCERTAIN, UNCERTAIN
from problems.errors import ParameterError
from problems.frozen import freeze
from problems.model.controller import check_feedback_damping
from problems.model.plant import Bumper
from problems.text import meant

from .canonical import Place, spell
from .limits import CollisionResponse, LimitsSpec
from .plant import DOMAIN_NAMES
from .quantity import as_interval, as_numbers
from .records import ROTATIONAL_KEYS, rename_axis_keys
from .schema import check_document, load_schema
from .stiffness_units import check_bumper_unit
from .units import AXES
from .yaml12 import Document, load_document

Interval = tuple[float, float]
Origin = Literal["identified", "nominal"]
Structure = Literal["gains", "noise", "biquad"]
Uncertain = Mapping[str, Interval | Origin]

_RANGES = frozenset({*UNCERTAIN, *(ROTATIONAL_KEYS[name] for name in UNCERTAIN if name in ROTATIONAL_KEYS)})

_MOST_OF_AN_APPROACH = {"force_n": 1e4, "speed_m_s": 5.0, "torque_n_m": 2e3, "speed_rad_s": 25.0}
"""What an approach may ask at most; about a turning axis the same at a lever of 0.2 m."""
# Among the free variables in the file, but none of the search: two are chosen for the gains that were found, the third
# is the cell's.
_THRESHOLD, _DAMPING = "collision_threshold_n", "variable_damping_n_s_per_m"
_STIFFNESS = "environment_stiffness_n_per_m"
_SHARE = "share_of_jitter"
# What a plant that a person writes, and gains, call the same; a corner is in another unit than a time constant.
_PLAIN_NAMES: Mapping[str, Mapping[str, str]] = {
    "bounds": {"lead": "lead_s", "feedback_damping": "feedback_damping_s"},
    "uncertain": {p: name for p, name in DOMAIN_NAMES.items() if name in FURTHER_UNCERTAIN and p != "wrench_corner"},
}
_ARGUMENTS = ("payload_mass=", "environment_stiffness=")


@dataclass(frozen=True, kw_only=True)
class ComplianceSpec:
    """A compliance to be chosen: the least and the greatest K_e to build, and by which share the built one may be off.

    What is certified of a chosen K_e is K_e (1 ± tolerance).
    """

    bounds: Interval
    tolerance: float = 0.2


@dataclass(frozen=True, kw_only=True)
class RotationalSpec:
    """What `problem.yaml` says of rx, ry, rz alone; the fields hold rad, N·m and kg·m².

    `requirements` holds those that were said, None where nothing is asked, and `soft_n` the prices.
    """

    bounds: Mapping[str, Interval] = field(default_factory=dict)
    approach: Approach | None = None
    environment_stiffness: Interval | None = None
    payload_mass: Interval | None = None
    uncertain: Uncertain = field(default_factory=dict)
    requirements: Mapping[str, Any] = field(default_factory=dict)
    soft_n: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "bounds", "uncertain", "requirements", "soft_n")


@dataclass(frozen=True, kw_only=True, repr=False)
class ProblemSpec(Said):
    """What is asked of a controller, by `problem.yaml`, options or arguments; None or empty where the default holds.

    `free` makes further parameters of the controller variables, with their bounds; `collision_threshold` bounds the
    threshold of the collision response, which is chosen after the gains (there is none without), and is answered with
    `collision_response`; `variable_damping` bounds a B_a that follows the speed [N·s/m] likewise; `compliance` makes
    K_e a variable, which is the cell's.
    `objective` may be given by its registered name.
    Names in `bounds` and `uncertain` are those of problem.yaml, or of gains and of `Plant`, as `lead` and `drag`.
    `uncertain` maps further parameters of the plant to a range, to "identified" (the confidence set of the identified
    file) or to "nominal" (as if it were known). `limits` are those that the runtime enforces.
    `least_modulus_together` is asked of min σ(I + L) of axes that act on each other, None nothing but stability.
    `contact_points_m` are where the payload may touch, in the sensor frame; () those of the cell. `bumper` is the
    part of the payload that touches, of straight axes, behind a spring inside; None of one in one piece. `structure` of
    the law that `optimize` searches, "noise" unless it is said: four gains in their bounds, limited by the noise of the
    command in the place of bounds that nobody said, or with a biquad too. `share_of_jitter` limits that noise to a
    share of the robot's own jitter at rest, as the log shows it; unsaid, it is 1 or the noise of the four gains.
    `options` holds those ranges that were said outside of the file (`with_options`), `with_unit` names those whose unit
    was typed.
    """

    axes: tuple[str, ...] | None = None
    bounds: Mapping[str, Interval] = field(default_factory=dict)
    approach: Approach | None = None
    environment_stiffness: Interval | None = None
    payload_mass: Interval | None = None
    uncertain: Uncertain = field(default_factory=dict)
    requirements: Requirements = field(default_factory=Requirements)
    objective: Objective = CONTACT_FORCE
    rotational: RotationalSpec = field(default_factory=RotationalSpec)
    free: Mapping[str, Interval] = field(default_factory=dict)
    collision_threshold: Interval | None = None
    collision_response: CollisionResponse = CollisionResponse.RESET
    variable_damping: Interval | None = None
    compliance: ComplianceSpec | None = None
    limits: LimitsSpec = field(default_factory=LimitsSpec)
    contact_points_m: tuple[tuple[float, float, float], ...] = ()
    bumper: Bumper | None = None
    least_modulus_together: float | None = None
    structure: Structure | None = None
    share_of_jitter: float | None = None
    options: Mapping[str, Interval] = field(default_factory=dict)
    with_unit: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        self._check_types()
        points = tuple(as_numbers("contact_points_m", each, 3) for each in self.contact_points_m)
        object.__setattr__(self, "contact_points_m", points)
        if self.bumper is not None:
            check_bumper_unit(self.bumper.stiffness_n_per_m)
        least = self.least_modulus_together
        if least is not None and not 0.0 < least < 1.0:
            raise ParameterError("least_modulus_together", least, "above 0 and below 1")
        if self.share_of_jitter is not None:
            (share,) = as_numbers(_SHARE, (self.share_of_jitter,), 1)
            if not share > 0.0 or self.requirements.command_noise is not None:
                raise ParameterError(_SHARE, share, "above 0, and left out where command_noise says a speed")
            object.__setattr__(self, _SHARE, share)
        for name in ("environment_stiffness", "payload_mass", "collision_threshold", "variable_damping"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _range(name, getattr(self, name)))
        known = {"bounds": (*VARIABLES, *FURTHER_VARIABLES), "free": FURTHER_VARIABLES, "uncertain": FURTHER_UNCERTAIN}
        for field_name, names in known.items():
            given_as, plain = getattr(self, field_name), _PLAIN_NAMES.get(field_name, {})
            said = {plain.get(name, name): given for name, given in given_as.items()}
            if len(said) < len(given_as):
                raise ParameterError(field_name, ", ".join(given_as), "given with each parameter once")
            object.__setattr__(self, field_name, said)
            for name, given in said.items():
                if name not in names:
                    raise _unknown(field_name, name, names, plain)
                if field_name != "uncertain" or not (isinstance(given, str) and given in get_args(Origin)):
                    _range(f"{field_name}[{name!r}]", given)
        freeze(self, "bounds", "uncertain", "free", "options")
        object.__setattr__(self, "objective", _objective(self.objective))

    def _headline(self) -> str:
        return f"Problem, to be met on {'all axes' if self.axes is None else ', '.join(self.axes)}"

    def _tables(self) -> Iterator[ResultTable]:
        rows = tuple(leaves(self.to_dict()))
        yield ResultTable(title="what is asked", columns=("name", "value"), rows=rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the arguments that were said, the objective and all requirements as plain data."""
        asked, prices = plain_tree(self.requirements.asked()), self.requirements.soft_n
        priced = {name: {"value": asked[name], "soft_n": price} for name, price in prices.items()}
        return {**super().to_dict(), "objective": self.objective.name, "requirements": asked | priced}

    def _check_types(self) -> None:
        """Raise ParameterError for an argument that is no value of its type."""
        said: Any = self.axes
        axes = (said,) if isinstance(said, str) else said
        if axes is not None and not (isinstance(axes, tuple | list) and axes and all(each in AXES for each in axes)):
            raise ParameterError("axes", self.axes, f"names among {', '.join(AXES)}, or left out for all")
        object.__setattr__(self, "axes", None if axes is None else tuple(axes))
        if self.structure is not None and self.structure not in get_args(Structure):
            raise ParameterError("structure", self.structure, f"one of {', '.join(get_args(Structure))}")
        kinds: dict[str, tuple[type, str]] = {
            "bounds": (Mapping, "{name: (low, high)}"),
            "free": (Mapping, "{name: (low, high)}"),
            "uncertain": (Mapping, "{name: (low, high)}"),
            "approach": (Approach, "at.Approach(force_n=…) or at.Approach(speed_m_s=…)"),
            "requirements": (Requirements, "at.Requirements(modulus_margin=…, …)"),
            "rotational": (RotationalSpec, "a RotationalSpec"),
            "limits": (LimitsSpec, "a LimitsSpec"),
            "compliance": (ComplianceSpec, "a ComplianceSpec"),
            "bumper": (Bumper, "at.Bumper(mass_kg=…, stiffness_n_per_m=…)"),
        }
        for name, (kind, must) in kinds.items():
            given = getattr(self, name)
            if not isinstance(given, kind) and not (given is None and name in ("approach", "compliance", "bumper")):
                raise ParameterError(name, given, must)

    def with_options(
        self,
        *,
        payload_mass: Interval | None = None,
        environment_stiffness: Interval | None = None,
        bumper: Bumper | None = None,
        structure: Structure | None = None,
        with_unit: frozenset[str] = frozenset(),
    ) -> "ProblemSpec":
        """Return the problem with the ranges of translational axes, bumper and structure that are given, which win."""
        given = {"payload_mass": payload_mass, "environment_stiffness": environment_stiffness}
        ranges: dict[str, Any] = {name: each for name, each in given.items() if each is not None}
        return replace(
            self,
            **ranges,
            options={**self.options, **ranges},
            bumper=bumper or self.bumper,
            structure=structure or self.structure,
            with_unit=self.with_unit | with_unit,
        )


def read_problem(path: Path) -> ProblemSpec:
    """Read `problem.yaml`; raises UsageError with file, line and reason for anything unknown or out of range."""
    document = load_document(path, error=UsageError)
    check_document(document, problem_schema(document.tree))
    tree = document.tree
    for place in _intervals(tree):
        _check_order(document, place)
    for within in ((), ("rotational",)):
        _check_feedback_damping(document, within)
        _check_approach(document, within)
    free = tree.get("free", {})
    if "collision_response" in tree and _THRESHOLD not in free:
        document.refuse(
            ("collision_response",), f"collision_response needs free.{_THRESHOLD}, the range to choose from."
        )
    axis, turned = tree.get("axis"), rename_axis_keys("rx", tree.get("rotational", {}), reading=True)
    try:
        return ProblemSpec(
            axes=(axis,) if isinstance(axis, str) else axis and tuple(axis),
            **_ranges(tree),
            requirements=build_requirements(*_requirements(tree.get("requirements", {}))),
            objective=load_objective(tree.get("objective", CONTACT_FORCE.name)),
            free={name: _pair(value) for name, value in free.items() if name not in (_THRESHOLD, _DAMPING, _STIFFNESS)},
            collision_threshold=_optional_pair(free.get(_THRESHOLD)),
            collision_response=CollisionResponse(tree.get("collision_response", CollisionResponse.RESET)),
            variable_damping=_optional_pair(free.get(_DAMPING)),
            compliance=_compliance(document),
            limits=_limits(tree.get("limits", {})),
            contact_points_m=tuple(tree.get("payload", {}).get("contact_points_m", ())),
            bumper=Bumper(**tree["payload"]["bumper"]) if "bumper" in tree.get("payload", {}) else None,
            least_modulus_together=tree.get("axes_together", {}).get("min_modulus"),
            structure=tree.get("structure"),
            share_of_jitter=((tree.get("requirements") or {}).get("command_noise") or {}).get(_SHARE),
            rotational=_rotational(turned),
        )
    except ParameterError as error:
        raise UsageError(f"{path}: {error}") from error


def _range(name: str, given: object) -> Interval:
    """Return (low, high) as floats; raises ParameterError for anything else."""
    try:
        low, high = as_numbers(name, given, 2)
    except ParameterError:
        raise ParameterError(name, given, "a range (low, high)") from None
    return as_interval(name, (low, high), may_vanish=name not in {"environment_stiffness", "payload_mass"})


def _unknown(field_name: str, name: str, names: Sequence[str], plain: Mapping[str, str]) -> ParameterError:
    """Return the error of a name that is none; those that are known are listed as a plant or gains call them."""
    short = {of_file: each for each, of_file in plain.items()}
    must = f"given for {', '.join(short.get(each, each) for each in names)} only"
    near = "wrench_time_constant_s" if name == "wrench_corner" else name
    return ParameterError(field_name, name, must, hint=meant(near, (*short.values(), *names, *_ARGUMENTS)))


def _objective(given: object) -> Objective:
    """Return the objective itself or the registered one of a name; raises ParameterError for anything else."""
    if isinstance(given, Objective):
        return given
    if not isinstance(given, str) or given not in objective_names():
        raise ParameterError("objective", given, f"one of {', '.join(objective_names())}")
    return load_objective(given)


def _rotational(turned: Mapping[str, Any]) -> RotationalSpec:
    asked, prices = _requirements(turned.get("requirements", {}))
    return RotationalSpec(**_ranges(turned), requirements=asked, soft_n=prices)


def _limits(said: Mapping[str, Any]) -> LimitsSpec:
    """Return what is said of the limits; what is not is chosen with the controller."""
    return LimitsSpec(values={name: value for name, value in said.items() if name != "axes"}, axes=said.get("axes", {}))


def _compliance(document: Document) -> ComplianceSpec | None:
    """Return what is said of a free K_e; refuse it beside a range of K_e that must be safe anyway."""
    said = document.tree.get("free", {}).get(_STIFFNESS)
    if said is None:
        return None
    if _STIFFNESS in document.tree:
        reason = f"{_STIFFNESS} is free, and a range of it is given too; leave one of them out."
        document.refuse((_STIFFNESS,), reason)
    if isinstance(said, Mapping):
        return ComplianceSpec(**{**said, "bounds": _pair(said["bounds"])})
    return ComplianceSpec(bounds=_pair(said))


def _ranges(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "bounds": {name: _pair(value) for name, value in tree.get("bounds", {}).items()},
        "approach": Approach(**tree["approach"]) if "approach" in tree else None,
        "environment_stiffness": _optional_pair(tree.get(_STIFFNESS)),
        "payload_mass": _optional_pair(tree.get("payload_mass_kg")),
        "uncertain": {name: _range_or_origin(tree[name]) for name in FURTHER_UNCERTAIN if name in tree},
    }


def _requirements(tree: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, float]]:
    """Return what is asked by name, None for what is not, and the prices of what may be missed."""
    asked: dict[str, Any] = {}
    prices: dict[str, float] = {}
    for name, said in tree.items():
        if isinstance(said, bool):
            asked[name] = 1.0 if said else None
        elif not isinstance(said, Mapping):
            asked[name] = said
        elif _SHARE in said:
            # A speed once the robot is known.
            continue
        else:
            asked[name] = load_requirement(name).read({key: value for key, value in said.items() if key != "soft_n"})
            prices |= {name: said["soft_n"]} if "soft_n" in said else {}
    return asked, prices


def problem_schema(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of the file with an entry for every requirement that it names and that has none there.

    The built-in ones have one whether they are named or not; those of other packages where they are installed. So do
    the objectives. The limits are those of `controller.yaml`, none of which must be there.
    """
    schema = deepcopy(load_schema("problem"))
    schema["properties"]["limits"] |= _limits_schema()
    # Text or not: a list is no key of a mapping.
    is_known = tree.get("objective", CONTACT_FORCE.name) in tuple(BUILT_IN_OBJECTIVES)
    schema["properties"]["objective"] = {"enum": list(BUILT_IN_OBJECTIVES if is_known else objective_names())}
    turning = schema["properties"]["rotational"]["properties"]["requirements"]["properties"]
    straight, rotational = schema["properties"]["requirements"]["properties"], tree.get("rotational")
    for said, known, price in (
        (tree.get("requirements"), straight, "soft_n"),
        (rotational.get("requirements") if isinstance(rotational, Mapping) else None, turning, "soft_n_m"),
    ):
        further = [each for each in BUILT_IN.values() if each.name not in FIELDS]
        if isinstance(said, Mapping) and set(said) - {*straight, *turning, *BUILT_IN}:
            found = (find_requirement(str(name)) for name in said if name not in {*straight, *turning})
            further += [each for each in found if each is not None]
        known |= {each.name: _entry_schema(each, price) for each in further if each.asked_as is None}
    return schema


def _limits_schema() -> dict[str, Any]:
    known = load_schema("controller")["$defs"]
    entries = {name: each for name, each in known["Limits"]["properties"].items() if name not in ("noise", "reasons")}
    axis = {**known["AxisLimits"], "required": [], "minProperties": 1}
    # The lag is that of the robot.
    axis["properties"] = {name: each for name, each in axis["properties"].items() if name != "followed_lag_s"}
    entries["axes"] = {"type": "object", "properties": dict.fromkeys(AXES, axis), "additionalProperties": False}
    return {"type": "object", "properties": entries, "additionalProperties": False}


def _entry_schema(requirement: Requirement[Any], price: str) -> dict[str, Any]:
    """Return the schema of a number that is asked, or of `true` where the requirement says the number itself."""
    number: dict[str, Any] = {"exclusiveMinimum": 0}
    if requirement.must_be_below is not None:
        number["exclusiveMaximum"] = requirement.must_be_below[0]
    return {
        "type": ["number", "null", "object", *(["boolean"] if isinstance(requirement, CustomRequirement) else [])],
        **number,
        "additionalProperties": False,
        "required": ["value", price],
        "properties": {"value": {"type": "number", **number}, price: {"type": "number", "exclusiveMinimum": 0}},
    }


def _intervals(tree: Mapping[str, Any], within: Place = ()) -> list[Place]:
    """Return where the ranges are, those of rotational axes included."""
    places: list[Place] = [(part, name) for part in ("bounds", "free") for name in tree.get(part, {})]
    if isinstance(tree.get("free", {}).get(_STIFFNESS), Mapping):
        places[places.index(("free", _STIFFNESS))] = ("free", _STIFFNESS, "bounds")
    places += [(name,) for name, value in tree.items() if name in _RANGES and isinstance(value, list)]
    if (tree.get("requirements") or {}).get("free_space_admittance"):
        places.append(("requirements", "free_space_admittance", "band_hz"))
    places = [(*within, *place) for place in places]
    return places + (_intervals(tree["rotational"], ("rotational",)) if "rotational" in tree else [])


def _check_order(document: Document, place: Place) -> None:
    value: Any = document.tree
    for key in place:
        value = value[key]
    if value[0] > value[1]:
        document.refuse(place, f"{spell(place)} must be [low, high], found {value[0]} above {value[1]}.")


def _check_feedback_damping(document: Document, within: Place) -> None:
    """Refuse a bound of B_fb in the paper's printed unit: the least value that works there is none at all."""
    place = (*within, "bounds", "feedback_damping_s")
    for value in _entry(document, place) or ():
        try:
            check_feedback_damping(value)
        except ParameterError as error:
            document.refuse(place, f"{spell(place)} must hold {error.must}, found {value:g}.")


def _check_approach(document: Document, within: Place) -> None:
    """Refuse an approach that no robot of this kind makes: its numbers are in another unit."""
    for name, value in (_entry(document, (*within, "approach")) or {}).items():
        if value > _MOST_OF_AN_APPROACH[name]:
            place = (*within, "approach", name)
            must = f"at most {_MOST_OF_AN_APPROACH[name]:g}, far above what a robot does at a contact"
            document.refuse(place, f"{spell(place)} must be {must}, found {value:g}; mind its unit.")


def _entry(document: Document, place: Place) -> Any:
    """Return the entry at a place, None where there is none."""
    found: Any = document.tree
    for key in place:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _pair(value: list[float]) -> Interval:
    return float(value[0]), float(value[1])


def _range_or_origin(value: Any) -> Interval | Origin:
    """Return [low, high] as an interval, and the word behind `from` as it is."""
    if isinstance(value, Mapping):
        origin: Origin = value["from"]
        return origin
    return _pair(value)


def _optional_pair(value: list[float] | None) -> Interval | None:
    return None if value is None else _pair(value)
