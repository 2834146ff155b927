"""The functions of the Python interface: identify, optimize, predict, load."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.arguments import axis_names, count, errors_in_arguments, file_path, file_paths, interval, priors, truth
from autotune.design import Design
from autotune.errors import UsageError
from autotune.formats.kinds import name_of
from autotune.formats.plant import Plant
from autotune.formats.quantity import Quantity, Uncertain
from autotune.formats.robot import Robot
from autotune.log import Log, Paths, cell_file, refuse_log
from autotune.pipeline import IdentifyOptions, identify_log
from autotune.results import Identification
from autotune.shown import Progress, reporting
from autotune.windows import window_length_s

if TYPE_CHECKING:
    from autotune.formats.cell import CellFile
    from autotune.formats.identified import IdentifiedFile
    from autotune.formats.problem import ProblemSpec, Structure
    from autotune.prediction.result import PredictedContact
    from problems.model.plant import Bumper


@errors_in_arguments()
def identify(
    log: Log | Paths,
    *,
    cell: "str | Path | CellFile | None" = None,
    given: Mapping[str, float | Uncertain] | None = None,
    allow_partial: bool = False,
    windows: float | str | None = None,
    keep_signals: bool = False,
    progress: Progress = None,
) -> Identification:
    """Identify payload, sensor, robot, coupling and environment, each with its deviation and a verdict.

    Parameters
    ----------
    log
        What `read_log` returned, or paths; paths that follow each other within a second are one recording, others are
        identified apart and combined.
    cell
        A `cell.yaml`, for paths; a `Log` brings its own.
    given
        What is known from elsewhere, by name as in `mass_kg` or `x.delay_s` [SI]: a number is exact, `Uncertain` a
        prior.
    allow_partial
        Return what was found even if a parameter is missing or logs disagree.
    windows
        For long logs: identify windows of this length [s], or a text as "10min", each on its own, and take those that
        tell most; a log of over twenty minutes and 100 MB is read in windows of ten minutes unless it is said.
    keep_signals
        Keep the signals in `evidence`, for pictures; there are none of windows.
    progress
        True for a bar, or a callable that takes the share of the work done since its last call.

    Returns
    -------
    Identification
        Prints as a table of values, deviations and verdicts.

    Raises
    ------
    LogError
        The log cannot be used.
    EstimateError
        It does not show what a controller needs, and not `allow_partial`.

    References
    ----------
    Haninger, Radke, Vick and Krüger, *Towards High-Payload Admittance Control for Manual Guidance with Environmental
    Contact*: the model of robot, coupling, payload and environment.

    Examples
    --------
    >>> import autotune as at
    >>> plant = at.identify(at.read_log(at.simulate_log("run8.mcap")))
    >>> plant.result.payload.mass_kg.status.value
    'identified'

    """
    source = log if isinstance(log, Log) else None
    if source is not None and cell is not None:
        raise UsageError("A log that was read brings its own cell; give cell to read_log.")
    files = file_paths("log", log) if not isinstance(log, Log) else log.paths
    read = IdentifyOptions(cell=cell_file(cell)) if source is None else source.options
    try:
        windows_s = read.windows_s if windows is None else window_length_s(windows)
    except ValueError as error:
        raise UsageError(f"windows: {error}") from None
    allow_partial, keep_signals = truth("allow_partial", allow_partial), truth("keep_signals", keep_signals)
    options = replace(read, allow_partial=allow_partial, given=priors(given), windows_s=windows_s)
    with reporting(progress, f"identifying {', '.join(map(name_of, files))}") as report:
        return identify_log(
            files,
            options,
            recording=None if source is None or windows_s is not None else source.recording,
            with_evidence=keep_signals,
            progress=report,
        )


@errors_in_arguments()
def optimize(
    plant: "Plant | Identification | str | Path",
    *,
    payload_mass: Quantity | None = None,
    environment_stiffness: Quantity | None = None,
    bumper: "Bumper | None" = None,
    problem: "str | Path | ProblemSpec | None" = None,
    axes: Sequence[str] | None = None,
    seed: int = 0,
    compare: "Mapping[str, Any] | Design | str | Path | None" = None,
    structure: "Structure | None" = None,
    progress: Progress = None,
) -> Design:
    """Search the controller with the gentlest contact that stays stable and moves freely, and validate it.

    Parameters
    ----------
    plant
        What `identify` returned, a `Plant`, or the path of an `identified.yaml` or `plant.yaml`.
    payload_mass
        Mass, or a range (low, high), that must all be safe [kg]; that of the plant unless it is said.
    environment_stiffness
        Range (low, high) that must all be safe [N/m]; that of the plant unless it is said.
    bumper
        The part of the payload that touches, behind a spring and a damper inside the payload: what is asked is met with
        it too, sampled, and the modulus proved as far as its budget goes. None, or as the problem says.
    problem
        Requirements, bounds and further ranges: a `problem.yaml` or what it holds.
    axes
        Which axes to tune; all of the plant unless they are said.
    seed
        The same seed gives the same controller.
    compare
        What runs today, to put beside the new controller: gains by name as of `predict` (by axis and name, or as in
        `x.mass`, where there are several axes), "log" for those with which the log was recorded, a design, or the path
        of a `controller.yaml` or `cell.yaml`; the search starts from it too. Those in the log unless they are said.
    structure
        Of the law: "gains" are four gains in their bounds, with "noise" the noise of the command is limited to what
        those make, or to the robot's jitter at rest, in the place of bounds that nobody said, with "biquad" the force
        passes a second-order section too.
        What does not lower the peak is not taken. As the problem says unless it is said, or "noise".
    progress
        True for a bar, or a callable that takes the share of the work done since its last call.

    Returns
    -------
    Design
        A controller that validation has passed.

    Raises
    ------
    InfeasibleError
        No controller meets the requirements.
    CertificateError
        A claim could not be proved or verified.
    EstimateError
        A parameter is missing.
    UsageError
        What was asked contradicts itself.

    References
    ----------
    Haninger, Radke, Vick and Krüger: the admittance law with lead K_l and feedback damping B_fb. The loop is the exact
    sampled one (docs/method.md, "The loop").

    Examples
    --------
    >>> import autotune as at
    >>> plant = at.Plant(mass=16, coupling_stiffness=3e5, drag=630, robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
    ...                  environment_stiffness=(2e4, 5e5), sample_time=8e-4)
    >>> design = at.optimize(plant)
    >>> design.peak_force < 100
    True

    """
    from autotune.formats.problem import ProblemSpec, read_problem  # noqa: PLC0415
    from autotune.prediction.said_gains import present_gains  # noqa: PLC0415 - compiles
    from autotune.tuning.optimize import optimize as search  # noqa: PLC0415 - compiles

    source, seed, names = _plant_file(plant), count("seed", seed), axis_names(axes)
    path = None if problem is None or isinstance(problem, ProblemSpec) else file_path("problem", problem)
    spec = problem if isinstance(problem, ProblemSpec) else ProblemSpec() if path is None else read_problem(path)
    spec = spec if names is None else replace(spec, axes=names)
    present = present_gains(compare.as_file() if isinstance(compare, Design) else compare, source, spec.axes)
    spec = spec.with_options(
        payload_mass=interval("payload_mass", payload_mass),
        environment_stiffness=interval("environment_stiffness", environment_stiffness),
        bumper=bumper,
        structure=structure,
    )
    with reporting(progress, "searching") as report:
        found = search(source, spec, seed=seed, problem_path=path, present=present, progress=report)
    return Design(controller=found.controller, optimized=found)


@errors_in_arguments()
def predict(
    plant: "Design | Plant | Identification | str | Path",
    *,
    gains: "Mapping[str, float] | Design | str | Path | None" = None,
    surface: str | None = None,
    environment_stiffness: float | Uncertain | None = None,
    payload_mass: float | None = None,
    approach_speed: float | None = None,
    approach_force: float | None = None,
    axis: str | None = None,
    sample_time: float | None = None,
    bumper: "Bumper | None" = None,
) -> "PredictedContact":
    """Predict one contact: approach in free space, impact, and what follows, with the interval of its peaks.

    Parameters
    ----------
    plant
        What `optimize`, `identify` or `load` returned, a `Plant`, or the path of such a file. A design brings its own
        gains and certified plants.
    gains
        Any admittance gains for a plant that is none: mass [kg, kg·m²], damping [N·s/m, N·m·s/rad] and, where they are
        not 0, lead [s], feedback_damping [s], deadband [N, N·m] and deadband_type; a design, or a `controller.yaml`.
        Not for a design, which brings its own.
    surface
        Name of an identified surface, as in `x1`; the only one unless it or a stiffness is said.
    environment_stiffness
        Of a surface instead, K_e [N/m, N·m/rad]; over robot travel where the plant holds no payload.
    payload_mass
        M_p [kg, kg·m²]; that of the plant unless it is said, and of a design that end of the domain with the larger
        peak, whose interval is then over the whole range of payloads.
    approach_speed
        Speed at the impact [m/s, rad/s], sustained by the force that it needs in free space.
    approach_force
        Instead of a speed: the force that was held until the speed was steady [N, N·m]. Beside a speed: the force after
        the impact. Of a design that of the certificate unless one of both is said.
    axis
        Which axis; may be left out where there is one, or the surface says it.
    sample_time
        Period of the controller [s]; that of the plant unless it is said.
    bumper
        The part of the payload that touches, behind a spring and a damper inside the payload; one piece without.

    Returns
    -------
    PredictedContact
        Forces over time, their peaks and the interval of these; `certified` says whether a certificate speaks of this
        contact, and `outside` what of the plant lies outside of the certified ranges.

    Raises
    ------
    ParameterError
        A number is out of range, or a stiffness so low that it must be of another unit than N/m.
    UsageError
        There is no such axis or surface, or it is not said which is meant.
    EstimateError
        The robot or the stiffness of the surface is not identified.
    UnstableLoopError
        The loop is unstable on this plant, so there is no steady approach or the contact grows without end.

    References
    ----------
    Haninger, Radke, Vick and Krüger: the contact experiments. docs/method.md: what the interval holds.

    Examples
    --------
    >>> import autotune as at
    >>> plant = at.Plant(mass=16, coupling_stiffness=3e5, drag=630, robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
    ...                  environment_stiffness=2e4, sample_time=8e-4)
    >>> found = at.predict(plant, gains={"mass": 13, "damping": 1000, "lead": 0.02}, approach_force=30)
    >>> 30 < found.peak_force < 60
    True

    """
    from autotune.predicting import ContactRequest, predict_any  # noqa: PLC0415 - compiles

    asked = ContactRequest(
        surface=surface or "",
        stiffness=environment_stiffness,
        payload_mass=payload_mass,
        speed=approach_speed,
        force=approach_force,
        axis=axis,
        sample_time=sample_time,
        bumper=bumper,
    )
    refuse_log(plant)
    return predict_any(load(plant) if isinstance(plant, str | Path) else plant, gains, asked)


def load(path: str | Path) -> "Design | Identification | Plant":
    """Load a `controller.yaml`, `identified.yaml` or `plant.yaml`.

    Parameters
    ----------
    path
        The file, whose first line says what it is.

    Returns
    -------
    Design, Identification or Plant
        A controller file is verified to be whole and unaltered; `Design.validate` verifies its claims.

    Raises
    ------
    CertificateError
        A controller file is altered or not validated.
    UsageError
        The file cannot be read, or is another one.

    Examples
    --------
    >>> import autotune as at
    >>> plant = at.Plant(mass=16, coupling_stiffness=3e5, drag=630, robot=at.Robot(bandwidth=3.2, delay=2.4e-3),
    ...                  environment_stiffness=(2e4, 5e5), sample_time=8e-4)
    >>> digest = plant.save("plant.yaml")
    >>> at.load("plant.yaml") == plant
    True

    """
    from autotune.formats.controller import read_controller  # noqa: PLC0415 - one of three
    from autotune.formats.identified import read_identified  # noqa: PLC0415
    from autotune.formats.kinds import unknown_file  # noqa: PLC0415
    from autotune.formats.plant_file import parse_plant  # noqa: PLC0415
    from autotune.formats.schema import head_of  # noqa: PLC0415
    from autotune.formats.yaml12 import kind_of_file, load_document  # noqa: PLC0415

    path = file_path("path", path)
    refuse_log(path)
    kind = kind_of_file(path)
    if kind == "controller":
        read = read_controller(path)
        return Design(controller=read.controller, file=read)
    if kind == "identified":
        plant = read_identified(path)
        return Identification(
            result=plant.result, provenance=plant.provenance, names=(path.name,), path=path, sha256=plant.sha256
        )
    if kind == "plant":
        return parse_plant(load_document(path, error=UsageError))
    found = f"autotune/{kind}" if kind else "no format entry"
    message = f"{path} must be a controller.yaml, identified.yaml or plant.yaml, found {found}."
    raise unknown_file(path, message, without_format=f" A plant.yaml begins with {head_of('plant')}.")


def from_control(system: Any, *, delay: Quantity | None = None) -> Robot:
    """Return the robot whose r(s) a python-control system holds.

    Parameters
    ----------
    system
        A continuous TransferFunction or StateSpace from commanded to measured position, one input and one output,
        stable, strictly proper, with r(0) = 1 [s in rad/s].
    delay
        Dead time [s], which such a system cannot hold; taken as 0, with a note, unless it is given.

    Returns
    -------
    Robot
        For `Plant(robot=…)`.

    Raises
    ------
    ParameterError
        It is discrete, has several inputs or outputs, or is no such r(s).

    Examples
    --------
    >>> import autotune as at, control
    >>> at.from_control(control.tf([20], [1, 20]), delay=2.4e-3).denominator
    (1.0, 20.0)

    """
    from problems.model.python_control import polynomials_of  # noqa: PLC0415 - python-control takes seconds to import

    numerator, denominator = polynomials_of(system)
    return Robot(numerator=numerator, denominator=denominator, delay=delay)


def _plant_file(plant: "Plant | Identification | str | Path") -> "IdentifiedFile":
    from autotune.formats.plant_file import read_plant  # noqa: PLC0415 - a file only

    refuse_log(plant)
    if isinstance(plant, Identification | Plant):
        return plant.file()
    if isinstance(plant, str | Path):
        return read_plant(plant)
    raise UsageError(f"plant must be what identify returns, a Plant or a path, found {type(plant).__name__}.")
