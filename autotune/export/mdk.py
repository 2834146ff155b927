"""Export to programs whose law is M dv/dt = f − D v − K x: what all of them share, to which each adds a template.

A program is a module with a `MdkProgram`, made a target by `mdk_target`, and a line in `targets`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from problems.progress import Progress

from .ros_yaml import UPRIGHT, OrientedNames, Tree, spawner, update_rate_hz
from .target import ExportRequest, ExportTarget, TargetOption, begins_with, render_translation

if TYPE_CHECKING:
    from autotune.formats.controller import ControllerFile
    from autotune.formats.controller_record import AxisGains, Controller
    from autotune.validation.law import AxisTask

    from .mdk_axis import MdkForm
    from .retune import ControllerStructure
    from .third_party import ParameterFile, TranslatedAxis, Translation


_SPAWNER = spawner("admittance_controller")


@dataclass(frozen=True, kw_only=True)
class MdkOptions(OrientedNames):
    """What a program with such a law needs beyond the controller; raises UsageError for what is none."""

    sensor_name: str = "ft_sensor"
    control_frame: str | None = None
    robot_name: str = "lbr"


@dataclass(frozen=True, kw_only=True)
class MdkExport:
    """What a template fills in: the controller, its axes as certified, the options and 1/h in whole hertz."""

    controller: "Controller"
    axes: Mapping[str, "TranslatedAxis"]
    options: MdkOptions
    update_rate_hz: int

    def numbers(self, name: str, still: float) -> dict[str, float]:
        """Return one number of every axis by name, `still` for those that were not tuned."""
        from autotune.formats.units import AXES  # noqa: PLC0415

        return {axis: self.axes[axis].written[name] if axis in self.axes else still for axis in AXES}


@dataclass(frozen=True, kw_only=True)
class MdkProgram:
    """Another program with such a law.

    `software` names it with the version that was read; files that `begins_with` recognises begin with its first word.
    `form` returns its discretisation and ranges; `check` raises UsageError for axes and options that do not fit;
    `content` returns the tree of its parameter file, or the text of its script; `notes` say what it does of itself.
    `sample_time_s` is its period where it has one of its own, `expresses` as in `ExportTarget`, `joints` those of the
    robot that it is for, `suffix` and `following` as in `ExportTarget`.
    """

    name: str
    summary: str
    software: str
    form: Callable[[], "MdkForm"]
    content: Callable[[MdkExport], Tree | str]
    notes: Callable[[MdkExport], Iterator[str]]
    options: tuple[TargetOption, ...] = ()
    check: Callable[[Mapping[str, "AxisGains"], MdkOptions], None] = lambda _gains, _options: None
    sample_time_s: float | None = None
    expresses: tuple[str, ...] = ("mass", "damping")
    joints: Callable[[MdkOptions], tuple[str, ...]] = lambda options: options.joints
    suffix: str = ".yaml"
    following: Callable[[ExportRequest], str] = _SPAWNER


def translate(
    program: MdkProgram, source: "ControllerFile", options: MdkOptions, progress: Progress | None = None
) -> "Translation":
    """Return the controller as the program runs it, certified; raises as `third_party.translate_controller`."""
    from .mdk_axis import MdkAxis  # noqa: PLC0415
    from .third_party import ParameterFile, translate_controller  # noqa: PLC0415

    form = program.form()

    def build_axes(
        tasks: Mapping[str, "AxisTask"], gains: Mapping[str, "AxisGains"]
    ) -> tuple[list["ControllerStructure"], bool]:
        program.check(gains, options)
        return [MdkAxis(task=task, gains=gains[name], form=form) for name, task in tasks.items()], False

    def build_file(controller: "Controller", axes: Sequence["TranslatedAxis"]) -> "ParameterFile":
        rate = update_rate_hz(controller.sample_time_s)
        made = MdkExport(
            controller=controller, axes={each.axis: each for each in axes}, options=options, update_rate_hz=rate
        )
        return ParameterFile(
            content=program.content(made),
            update_rate_hz=rate,
            software=program.software,
            notes=tuple(program.notes(made)),
        )

    return translate_controller(source, program.joints(options), build_axes, build_file, progress)


def mdk_target(program: MdkProgram) -> ExportTarget:
    """Return the export target of a program."""
    first = program.software.split()[0]

    def run(source: "ControllerFile", options: MdkOptions, progress: Progress | None) -> "Translation":
        return translate(program, source, options, progress)

    return ExportTarget(
        name=program.name,
        summary=program.summary,
        render=render_translation(run, MdkOptions),
        is_own=begins_with(rb"# Written by autotune \S+ for " + first.encode() + rb" "),
        options=program.options,
        runs_same_law=False,
        sample_time_s=program.sample_time_s,
        expresses=program.expresses,
        suffix=program.suffix,
        following=program.following,
        design_options=UPRIGHT if any(each.name == "orientation" for each in program.options) else {},
    )
