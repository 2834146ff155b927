"""Export to another controller: translate, certify what it really runs, tune what it can do if that fails, and write.

The written parameters are those that were certified, digit for digit.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from autotune import __version__
from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.formats.atomic import write_atomic
from autotune.formats.controller import ControllerFile, read_controller, short
from autotune.formats.controller_record import CollisionResponse, Controller
from autotune.formats.units import axis_units
from autotune.validation.bouncing import search_bouncing
from autotune.validation.law import AxisTask, LawCertificate, certify_law
from autotune.validation.proof import StabilityProof
from problems.model.third_party_controllers import alternates

from . import fzi_axes, fzi_cartesian, ros2_control, ros2_notes
from .fzi_cartesian import FziAxis, FziOptions
from .replace import check_replaceable
from .retune import retune
from .ros2_control import Ros2Axis, Ros2Options
from .ros_yaml import Tree, check_joint_count, dump_parameters, joints_told
from .structure import Values
from .trust import Trust

Options = Ros2Options | FziOptions
Axis = Ros2Axis | FziAxis


@dataclass(frozen=True, kw_only=True)
class PeerAxis:
    """One exported axis: its numbers as written, whether they had to be tuned and why, and what was certified."""

    axis: str
    written: Mapping[str, float]
    tuned_because: str | None
    certificate: LawCertificate
    peak_before_n: float
    notes: tuple[str, ...]

    @property
    def peak_n(self) -> float:
        """The largest force on the environment of all contacts that were looked at."""
        assert self.certificate.worst is not None  # a certificate that holds has one
        return self.certificate.worst.peak_contact_force_n

    def margins(self) -> dict[str, float | None]:
        """Return the smallest margins by name, None where there is no finite limit."""
        found = {} if self.certificate.margins is None else self.certificate.margins.values
        return {name: value if math.isfinite(value) else None for name, value in found.items()}

    def price(self) -> str:
        """Tell the peak force beside that of the file's own law."""
        unit, more = axis_units(self.axis).force, self.peak_n - self.peak_before_n
        told = f"{abs(more):.1f} {unit} {'more' if more >= 0.0 else 'less'}"
        return f"{self.peak_n:.1f} {unit} instead of {self.peak_before_n:.1f} {unit}: {told}"


@dataclass(frozen=True, kw_only=True)
class PeerExport:
    """What was written: the axes, what was dropped and what must be known of the controller."""

    target: str
    source: ControllerFile
    axes: tuple[PeerAxis, ...]
    dropped: tuple[str, ...]
    notes: tuple[str, ...]
    text: str

    def tree(self) -> dict[str, Any]:
        """Return the same as a plain tree."""
        axes = {
            each.axis: {
                "parameters": dict(each.written),
                "tuned": each.tuned_because is not None,
                "reason": each.tuned_because,
                "peak_contact_force": each.peak_n,
                "peak_contact_force_before": each.peak_before_n,
                "margins": each.margins(),
                "notes": list(each.notes),
            }
            for each in self.axes
        }
        return {"axes": axes, "dropped": list(self.dropped), "notes": list(self.notes)}


def export_peer(
    path: Path | str,
    options: Options,
    out: Path | str,
    progress: Callable[[float], None] | None = None,
    trust: Trust | None = None,
) -> PeerExport:
    """Write the controller file `path` for another controller and return what was done.

    `progress` is told the share of the work done since the last call, `trust` says what is asked of the file. Raises
    CertificateError for a file that is altered, not as asked, or says what cannot be certified, InfeasibleError where
    the other controller can do nothing that meets the file's requirements, UsageError for a file that cannot be read
    or written, an `out` that is not of the same export and a rate that cannot be told.
    """
    source = read_controller(path)
    check_replaceable(out, target_of(options), path)
    (Trust() if trust is None else trust).verify(source)
    made = make_peer(source, options, progress)
    write_atomic(out, made.text)
    return made


def make_peer(source: ControllerFile, options: Options, progress: Callable[[float], None] | None = None) -> PeerExport:
    """Do what `export_peer` does without writing."""
    controller = source.controller
    axes, common = _axes(controller, options)
    check_joint_count(options.joints, len(axes))
    done = _all_certified(axes, common, progress)
    written = {each.axis: each.written for each in done}
    dropped = (*_dropped(controller), *(line for axis in axes for line in axis.dropped()))
    if isinstance(options, Ros2Options):
        tree, rate = ros2_control.parameter_tree(controller, written, options)
        version = ros2_control.parse_version(options.version)
        target, notes = "ros2_control", tuple(ros2_notes.notes(controller.payload, written, options))
        what = f"ros2_controllers admittance_controller {'.'.join(map(str, version))} ({options.version})"
    else:
        places = fzi_axes.base_axes(written, options.orientation)
        placed = {places[axis]: gains for axis, gains in written.items()}
        tree, rate = fzi_cartesian.parameter_tree(controller, placed, options)
        told = fzi_axes.axes_told(written, options.orientation, options.base_link)
        target, notes = "fzi_cartesian", (*told, *fzi_cartesian.notes())
        what = "cartesian_controllers (FZI), cartesian_force_controller, branch ros2"
    text = _text(source, tree, what, rate, (done, dropped, notes))
    return PeerExport(target=target, source=source, axes=done, dropped=dropped, notes=notes, text=text)


def _axes(controller: Controller, options: Options) -> tuple[list[Axis], bool]:
    """Return the axes in the target's structure, and whether their masses had to be made the same."""
    tasks = {name: _task(controller, name) for name in controller.axes}
    if isinstance(options, FziOptions):
        fzi_axes.check_kinds(tasks, options.orientation)
        return [FziAxis(task, controller.axes[name], options) for name, task in tasks.items()], False
    axes = {name: Ros2Axis(task=task, gains=controller.axes[name], options=options) for name, task in tasks.items()}
    same = ros2_control.with_common_masses(axes, ros2_control.parse_version(options.version))
    return list(same.values()), same != axes


def _task(controller: Controller, name: str) -> AxisTask:
    """Return what one axis was certified for; raises CertificateError for what cannot be certified again."""
    asked, domain = controller.certificate.requirements_of(name), controller.certificate.domain[name]
    if asked is None:
        raise CertificateError(f"Axis {name}: the certificate does not say what was asked (rotational_requirements).")
    if domain.environment_mass_kg != 0.0:
        raise CertificateError(f"Axis {name}: an environment with mass cannot be certified by this release.")
    if domain.approach_force_n is None and domain.approach_speed_m_s is None:
        raise CertificateError(f"Axis {name}: the domain names no approach.")
    if not controller.predicted[name].scenarios:
        raise CertificateError(f"Axis {name}: the file predicts no contact to compare with.")
    return AxisTask(
        axis=name,
        domain=domain,
        asked=asked,
        margins=controller.certificate.margins[name],
        predicted=controller.predicted[name],
        sample_time_s=controller.sample_time_s,
    )


def _all_certified(axes: list[Axis], common: bool, progress: Callable[[float], None] | None) -> tuple[PeerAxis, ...]:
    """Certify every axis, so that all that fail are told at once; the first of them decides the kind of the error."""
    done, failed = [], list[CertificateError | InfeasibleError]()
    for axis in axes:
        try:
            done.append(_certified(axis, common))
        except (CertificateError, InfeasibleError) as error:
            failed.append(error)
        if progress is not None:
            progress(1.0 / len(axes))
    if len(failed) > 1:
        raise type(failed[0])(" ".join(str(each) for each in failed)) from failed[0]
    if failed:
        raise failed[0]
    return tuple(done)


def _certified(axis: Axis, common: bool) -> PeerAxis:
    """Certify the translated gains of an axis, or tune what the structure can do."""
    task, values = axis.task, axis.translated
    law, reason, found = axis.law(values), None, None
    if alternates(law):
        reason = "the law itself would change the sign of its speed in every cycle at this update rate"
    else:
        found = certify_law(task, law)
        reason = None if found.holds else found.missed[0]
    if found is None or reason is not None:
        try:
            values, found = retune(task, axis)
        except InfeasibleError as error:
            fixed = " with one mass for all axes of a kind (6.4.0 and later do not need that)" if common else ""
            raise InfeasibleError(
                f"Axis {task.axis}: that controller{fixed} cannot do what was asked. The translated gains fail "
                f"({reason}), and {error}."
            ) from error
    bouncing = search_bouncing(task.axis, task.domain, axis.law(values), task.sample_time_s)
    if not bouncing.passed:
        raise CertificateError(f"Axis {task.axis}: with what that controller runs, {bouncing.message()}.")
    return PeerAxis(
        axis=task.axis,
        written=axis.written(values),
        tuned_because=reason,
        certificate=found,
        peak_before_n=task.promised_n(),
        notes=(
            *axis.told(values),
            *(() if reason is None else _bounds_told(axis, values)),
            *joints_told(axis.options.joints, axis.task.axis),
        ),
    )


def _bounds_told(axis: Axis, values: Values) -> Iterator[str]:
    """Say which numbers of a search sit on a bound."""
    for each, value in zip(axis.variables, values, strict=True):
        if each.high > each.low and value in (each.low, each.high):
            end = "lowest" if value == each.low else "highest"
            yield f"axis {axis.task.axis}: {each.name} is the {end} that the search may choose, {value:.4g}."


def _dropped(controller: Controller) -> Iterator[str]:
    """Say what of the file beyond the axes' gains no such controller has."""
    if controller.compensation_mass_kg:
        yield f"acceleration compensation of {controller.compensation_mass_kg:g} kg"
    if controller.collision.response is not CollisionResponse.NONE:
        yield f"collision response {controller.collision.response.value} at {controller.collision.threshold_n:g} N"
    limits = controller.limits
    if limits is not None:
        speeds = (f"{axis} {each.speed:g} {axis_units(axis).speed}" for axis, each in limits.axes.items())
        yield (
            f"limits ({limits.force_n:g} N, {limits.torque_n_m:g} N·m, commanded {', '.join(speeds)}, stale readings, "
            "the check at rest): that controller moves on any reading, so limit speed and wrench below and before it"
        )
    payload = controller.payload
    if any((*payload.force_bias_n, *payload.torque_bias_n_m)):
        bias = ", ".join(f"{each:g}" for each in (*payload.force_bias_n, *payload.torque_bias_n_m))
        yield f"sensor bias ({bias}) N and N·m: remove it before the wrench reaches the controller"
    soft = controller.certificate.soft or {}
    if any(soft.values()):
        names = ", ".join(sorted({name for each in soft.values() for name in each}))
        yield f"what was only wished ({names}): it is not looked at here"


def _text(
    source: ControllerFile,
    tree: Tree,
    what: str,
    rate: int,
    told: tuple[tuple[PeerAxis, ...], tuple[str, ...], tuple[str, ...]],
) -> str:
    """Return the whole file, comments first."""
    axes, dropped, notes = told
    comments = [
        f"Written by autotune {__version__} for {what}.",
        f"Source: controller.yaml with checksum {short(source.checksum)} (sha256 {source.checksum}).",
        f"Holds at an update rate of {rate} Hz and for the cell of that file; names are those of the installation.",
        "",
    ]
    for each in axes:
        comments += [*_certificate(each), *each.notes, ""]
    comments += [f"Dropped: {line}." for line in dropped] or ["Nothing of the file is dropped."]
    return dump_parameters(tree, [*comments, "", *notes, ""])


def _certificate(each: PeerAxis) -> Iterator[str]:
    """Tell what was certified of one axis."""
    found, units = each.certificate, axis_units(each.axis)
    assert found.margins is not None
    assert found.worst is not None
    assert found.admittance is not None
    if each.tuned_because is None:
        yield f"Axis {each.axis}: the gains of the file, translated. Peak force {each.price()}."
    else:
        yield (
            f"Axis {each.axis}: tuned anew for this controller, since the translated gains fail: {each.tuned_because}. "
            f"Peak force {each.price()}."
        )
    spring = "" if found.spring_share is None else ", there without the return spring, which takes "
    if found.spring_share is not None:
        spring += f"{100.0 * max(found.spring_share, 0.0):.2g} % of its room"
    yield (
        f"axis {each.axis}: certified for what runs: stable in contact ({_cells(found.contact)}) and in free space "
        f"({_cells(found.free)}{spring}); "
        + ", ".join(f"{name} {value:.4g}" for name, value in found.margins.values.items())
        + f" on {found.margins.plants} plants."
    )
    low, high = found.admittance.band_hz
    yield (
        f"axis {each.axis}: largest contact {units.force_name} {each.peak_n:.4g} {units.force} at {found.worst.name}; "
        f"free-space admittance at least {found.admittance.min_m_s_per_n:.4g} {units.admittance} from {low:g} to "
        f"{high:g} Hz; a hand needs {found.admittance.hand_force_n_per_m_s:.4g} {units.hand}."
    )


def _cells(proof: StabilityProof) -> str:
    return f"proved in {proof.cells} cell{'s' * (proof.cells != 1)}"


PEERS: Mapping[str, type[Options]] = {"ros2_control": Ros2Options, "fzi_cartesian": FziOptions}


def peer_options(target: str, given: Mapping[str, Any]) -> Options:
    """Return the options of a target from those that were given; raises UsageError for one that it does not have."""
    kind = PEERS[target]
    unknown = sorted(name for name in given if name not in kind.__dataclass_fields__)
    if unknown:
        names = ", ".join(f"--{_spelt(name)}" for name in unknown)
        raise UsageError(f"{names} says nothing to the target {target}.")
    return kind(**given)


def target_of(options: Options) -> str:
    """Return the name of the target that options are for."""
    return next(name for name, kind in PEERS.items() if isinstance(options, kind))


def _spelt(name: str) -> str:
    return "ros2-version" if name == "version" else name.replace("_", "-")


__all__ = ["PEERS", "PeerAxis", "PeerExport", "Values", "export_peer", "make_peer", "peer_options"]
