"""What `optimize` prints of its result: optimality, compliance, collision response, limits, comparison."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from problems.text import significant

from ._terminal import painted, print_message, print_table, printable, table_lines

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller, ScenarioPrediction
    from autotune.prediction.before_after import BeforeAndAfter
    from autotune.prediction.law import PresentGains
    from autotune.tuning.compare import EvaluatedController, SideBySide
    from autotune.tuning.compliance import Compliance, CompliancePoint
    from autotune.tuning.optimality_report import ActiveConstraint, OptimalityReport, Reference
    from autotune.tuning.optimize import Optimized
    from problems.design.objectives import Objective
    from problems.design.problem import DesignProblem
    from problems.model.axis_kind import AxisKind
    from problems.model.controller import AdmittanceController

# Decimals of a price: what is 0 in them saves nothing.
_DECIMALS = {"N": 2, "N·m": 4}
_WIDEN = "accept it, or widen it"


def active_tree(found: "Optimized") -> dict[str, Any]:
    """Return, per axis, the active requirements and bounds with the price of one percent, of a force in N or N·m."""
    from autotune.formats.units import ROTATIONAL_AXES
    from autotune.tuning.optimality_report import price_key

    return {
        name: [
            {
                "name": a.name,
                price_key(report.objective, rotational=name in ROTATIONAL_AXES): a.price,
                **({"soft": True} if a.soft else {}),
            }
            for a in report.active
        ]
        for name, report in found.optimality_reports.items()
    }


def active_lines(found: "Optimized", name: str) -> list[str]:
    """Say in words what holds the peak of one axis up, or another objective back, and how near it is to the best."""
    from autotune.formats.units import axis_units
    from problems.design.objectives import PeakObjective

    report, problem, units = found.optimality_reports[name], found.searches[name].problem, axis_units(name)
    if not isinstance(problem.objective, PeakObjective):
        return [*_objective_lines(report, problem, units)]
    lines = [_active_line(entry, problem, units) for entry in report.active]
    if not report.active:
        lines.append(f"no requirement is active: the peak is the approach {units.force_name} itself")
    widened = [entry.name for entry, line in zip(report.active, lines, strict=False) if line.endswith(_WIDEN)]
    lines += _wider_lines(problem, widened, turning=units.force != "N")
    return [*lines, *_optimality_lines(report, units.force, (".2f", ".3f"), bool(problem.requirements.soft_n))]


def default_lines(found: "Optimized", name: str) -> Iterator[str]:
    """Yield what was asked of one axis by default, where it follows the robot; a lowered one is among the notes."""
    from autotune.tuning.defaults import default_message

    default = found.defaults.get(name)
    if default is not None and default.attainable is None:
        yield default_message(name, default, found.searches[name].problem)


def _objective_lines(report: "OptimalityReport", problem: "DesignProblem", units: "AxisKind") -> Iterator[str]:
    """Yield the value of an objective that is no peak force, what holds it back, and how near it is to the best."""
    from autotune.text import bound_text

    objective = problem.objective
    unit = objective.unit_on(turning=units.force != "N")
    verb = "larger" if objective.direction == "maximize" else "smaller"
    yield f"objective {objective.name}: {objective.title} {report.shown(report.cost, 4):g} {unit}".rstrip()
    for entry in report.active:
        moved = f"{significant(entry.price)} {unit}".rstrip()
        text = bound_text(entry.name, problem.bounds, units)
        yield f"{text}{',' * (text != entry.name)} is active: easing it by 1 % makes the objective {moved} {verb}"
    if not report.active:
        yield "no requirement and no bound is active"
    yield from _optimality_lines(report, unit, (".4g", ".2g"), has_soft=False)
    if report.optimality.exact_share < 1.0:
        yield (
            f"{100.0 * (1.0 - report.optimality.exact_share):.0f} % of the gradients behind this are central "
            "differences, for there is no exact one"
        )


def _active_line(entry: "ActiveConstraint", problem: "DesignProblem", units: "AxisKind") -> str:
    from autotune.text import bound_text
    from problems.design.problem import BIQUAD_VARIABLES

    decimals = _DECIMALS[units.force]
    saved, is_nothing = f"{entry.price:.{decimals}f} {units.force}", entry.price < 0.5 * 10.0**-decimals
    side, _, variable = entry.name.partition(" bound of ")
    if variable:
        bound = f"the {bound_text(entry.name, problem.bounds, units)}"
        if is_nothing or (side == "lower" and problem.bounds[variable][0] == 0.0):
            return f"{bound}, is active, and widening it saves nothing"
        saves = f"{bound}, is active: 1 % wider saves {saved}"
        return saves if variable in BIQUAD_VARIABLES else f"{saves}; {_WIDEN}"
    if is_nothing:
        return f"{entry.name} is active, easing it alone saves nothing"
    if entry.soft:
        return f"{entry.name} is a soft requirement: asking 1 % less saves {saved} of peak and price"
    return f"{entry.name} holds the peak up: easing it by 1 % saves {saved}, asking 1 % more costs as much"


def _wider_lines(problem: "DesignProblem", names: Sequence[str], *, turning: bool) -> Iterator[str]:
    """Yield the lines of problem.yaml that widen bounds."""
    from autotune.formats.canonical import lines_to_paste, place_to_paste
    from autotune.tuning.bounds import wider_bounds

    if tree := wider_bounds(problem, names, turning=turning):
        yield "\n    ".join((f"to widen, in problem.yaml {place_to_paste(tree)}:", *lines_to_paste(tree)))


def _optimality_lines(report: "OptimalityReport", unit: str, digits: tuple[str, str], has_soft: bool) -> Iterator[str]:
    """Yield whether the design is feasible, an optimum of its surroundings, and the best that anyone found.

    `digits` are the formats of the value and of a share of it. With soft requirements, what was minimised is the peak
    and the prices of what is missed.
    """
    what = f" {unit} of peak and price" if has_soft else f" {unit}".rstrip()
    value, best = (float(report.objective.value(cost)) for cost in (report.cost, report.reference.least))
    word = "least" if report.objective.direction == "minimize" else "most"
    near = ""
    if report.nearest is not None:
        near = f"; nearest to its limit is {report.nearest}, {100.0 * report.ratio:.4f} % of it used up"
    met = "every requirement is met" if report.is_feasible else "a requirement is missed"
    yield f"{met} over {report.scenario_count} contacts{near}"
    optimality, slack = report.optimality, report.optimality.slack * value
    yield (
        f"conditions of an optimum: {optimality.relative_residual:.1e} of the gradient is left over (KKT residual), "
        f"unused slack is worth {slack:{digits[1]}} {unit}".rstrip()
    )
    least = f"{best:{digits[0]}}{what} is the {word} that was found {_where_it_was_looked(report.reference)}"
    if math.isfinite(report.reference.elsewhere):
        yield f"gap {100.0 * report.gap:.3f} % to a reference: {least}"
    else:
        yield f"no other design to compare with; {least}"


def _where_it_was_looked(reference: "Reference") -> str:
    text = (
        f"over the {reference.scenarios} hardest contacts alone with nothing kept in reserve, from here and by "
        f"{reference.descents} descents from the best of {reference.designs} other designs"
    )
    if not math.isfinite(reference.elsewhere):
        return f"{text}, none of which met the requirements"
    return f"{text}, {reference.arrived} of which end there"


def print_before_after(found: "Mapping[str, BeforeAndAfter]") -> None:
    """Print what a controller changes: on the contacts of the log, and in free motion."""
    for each in found.values():
        headline, _, _ = each.parts()
        print_message(headline)
        for line in (*each.further(), *each.notes):
            print_message(f"  {line}")


def compare_tree(old: "PresentGains", found: Mapping[str, "SideBySide"]) -> dict[str, Any]:
    """Return the comparison as plain data; a margin without limit and every number of an unstable loop are null."""
    from autotune.formats.records import rename_axis_keys

    axes = {
        name: {"started_from_old": both.is_start, "old": _evaluated_tree(both.old), "new": _evaluated_tree(both.new)}
        for name, both in found.items()
    }
    return {
        **old.tree(),
        "axes": {name: rename_axis_keys(name, tree, reading=False) for name, tree in axes.items()},
    }


def _evaluated_tree(evaluated: "EvaluatedController") -> dict[str, Any]:
    law, does, at = evaluated.law, evaluated.performance, evaluated.unstable_at
    margins = {} if does is None else does.margins
    return {
        "mass": law.mass_kg,
        "damping": law.damping_n_s_per_m,
        "lead_s": law.lead_s,
        "feedback_damping_s": law.feedback_damping_s,
        "is_stable": does is not None,
        "unstable_at": None if at is None else {"payload_mass_kg": at[0], "environment_stiffness_n_per_m": at[1]},
        "peak_sensor_force_n": None if does is None else does.peak_sensor_force_n,
        "peak_contact_force_n": None if does is None else does.peak_contact_force_n,
        "margins": {name: value if math.isfinite(value) else None for name, value in margins.items()} or None,
        "min_m_s_per_n": None if does is None else does.min_m_s_per_n,
        "hand_force_n_per_m_s": None if does is None else does.hand_force_n_per_m_s,
        "missed": None if does is None else {name: 1.0 / value for name, value in does.missed.items()},
    }


def compare_lines(old: "PresentGains", found: Mapping[str, "SideBySide"]) -> Iterator[str]:
    """Yield the comparison in words: a table per axis, then what the old controller misses."""
    from autotune.formats.units import axis_units

    yield f"beside {printable(old.label)}, on the same problem"
    for name, both in found.items():
        units = axis_units(name)
        yield from table_lines([("", "old", "new"), *_rows(both, units)], point=(1, 2), indent=f"  {name}  ")
        for side, evaluated in (("old", both.old), ("new", both.new)):
            yield f"  {name}  {side}: {_verdict(evaluated, units)}"


def _rows(both: "SideBySide", units: "AxisKind") -> Iterator[tuple[str, ...]]:
    from autotune.text import gain_rows
    from problems.design.requirements import MARGINS

    yield from gain_rows(units, both.old.law, both.new.law)
    for what, name, scale in (
        (f"peak at sensor [{units.force}]", "peak_sensor_force_n", 1.0),
        (f"peak at contact [{units.force}]", "peak_contact_force_n", 1.0),
        (f"least admittance [{units.admittance}]", "min_m_s_per_n", 1.0),
        (f"hand {units.force_name} [{units.hand}]", "hand_force_n_per_m_s", 1.0),
        *((each.heading, each.margin, each.shown_scale) for each in MARGINS),
    ):
        yield what, *(_number(side, name, scale) for side in (both.old, both.new))


def _number(side: "EvaluatedController", name: str, scale: float) -> str:
    if side.performance is None:
        return "-"
    value = side.performance.margins.get(name)
    value = float(getattr(side.performance, name)) if value is None else value
    return "no limit" if math.isinf(value) else f"{value * scale:.4g}"


def _verdict(side: "EvaluatedController", units: "AxisKind") -> str:
    from autotune.text import stiffness_text

    if side.unstable_at is not None:
        mass, stiffness = side.unstable_at
        where = f"K_e {stiffness_text(stiffness, units)}" if stiffness > 0.0 else "free space"
        return f"{painted('UNSTABLE')} in {where} with {mass:.4g} {units.mass} (largest |z| {side.spectral_radius:.5f})"
    missed = {} if side.performance is None else side.performance.missed
    shares = {name: min(100.0 / value, 99.99) for name, value in missed.items()}
    text = ", ".join(f"{name} (only {share:.4g} % of what is asked)" for name, share in shares.items())
    return f"misses {text}" if text else "meets every requirement"


def print_compliance(name: str, compliance: "Compliance", problem: "DesignProblem") -> None:
    """Print what is to be built, every stiffness that was tried with its least worst peak, and what bounds the choice.

    `problem` is the one that the controller was found for.
    """
    from autotune.text import compliance_remark
    from autotune.tuning.compliance import compliance_tree

    low, high = problem.plants.environment_stiffness_n_per_m
    tolerance = 100.0 * compliance.asked.tolerance
    print_message(
        f"axis {name}: build K_e {1e-3 * compliance.chosen.stiffness_n_per_m:g} N/mm to ± {tolerance:g} %, "
        f"certified from {1e-3 * low:g} to {1e-3 * high:g} N/mm"
    )
    # Where requirements are soft, it is the peak and their price that is least.
    prices = ("and price [N]",) if problem.requirements.soft_n else ()
    heads = ("K_e [N/mm]", _objective_head(problem.objective), *prices, "")
    tree = compliance_tree(compliance)
    pairs = zip(compliance.points, tree["tried"], strict=True)
    rows = [(*_numbers(point, len(prices)), compliance_remark(tree, tried)) for point, tried in pairs]
    last = len(heads) - 1
    print_table([heads, *rows], left=(last,), point=range(last), indent="  ")
    for line in _lines(compliance, problem):
        print_message(f"  {line}")


def _objective_head(objective: "Objective") -> str:
    """Return the head of the column of an objective."""
    from problems.design.objectives import PeakObjective

    if isinstance(objective, PeakObjective):
        return f"least worst peak at {objective.place} [N]"
    return f"{objective.title} [{objective.unit}]" if objective.unit else objective.title


def _numbers(point: "CompliancePoint", prices: int) -> tuple[str, ...]:
    from problems.design.objectives import PeakObjective

    text = ["-", "-"]
    if point.found is not None:
        evaluation, objective = point.found.evaluation, point.found.problem.objective
        values = (objective.value(evaluation.objective_cost), evaluation.cost)
        text = [f"{value:.2f}" if isinstance(objective, PeakObjective) else f"{value:.4g}" for value in values]
    return f"{point.stiffness_n_per_m * 1e-3:.6g}", *text[: 1 + prices]


def _lines(compliance: "Compliance", problem: "DesignProblem") -> Iterator[str]:
    from autotune.tuning.compliance import RESOLUTION

    low, high = compliance.asked.bounds
    if compliance.active_bound is not None:
        bound = low if compliance.active_bound == "lower" else high
        yield f"the {compliance.active_bound} bound of K_e, {1e-3 * bound:g} N/mm, is active: widen it, or accept"
    if low < high:
        yield (
            f"between two rows nothing was tried; above each that is named the next one is at most "
            f"{100.0 * RESOLUTION:g} % stiffer. To take another one, give it as "
            "free.environment_stiffness_n_per_m: [K, K]"
        )
    damping = problem.plants.range_of("environment_damping_n_s_per_m")
    text = f"{damping[0]:g}" if damping[0] == damping[1] else f"{damping[0]:g} to {damping[1]:g}"
    yield (
        f"assumed of the compliance: damping B_e {text} N·s/m, and no mass that moves with it; once it is built, "
        "identify it and ask validate --identified"
    )


_SHOWN_N = 0.005
_ENDS = {
    "free motion": "a lower one, which free motion and noise forbid, might save more",
    "lower bound": "the lower bound is active",
    "upper bound": "the upper bound is active",
}


def damping_lines(controller: "Controller") -> Iterator[str]:
    """Say which variable damping was chosen in `controller.provenance`, where one was asked for, and what it costs."""
    from autotune.formats.units import axis_units

    chosen: Mapping[str, Any] = controller.provenance.get("variable_damping", {})
    for axis, tree in chosen.items():
        low, high = tree["bounds_n_s_per_m"]
        variable, units = controller.damping_of(axis), axis_units(axis)
        peaks = tree["worst_contact_peak_n"]
        if variable is None:
            yield (
                f"axis {axis}: no variable damping. None from {low:g} to {high:g} {units.damping} is lighter "
                f"or gentler, keeps the worst peak of {peaks['without']:.2f} N (or max_peak_force_n) and most of the "
                "modulus"
            )
            continue
        hand, every_ms = tree["hand_force_n_per_m_s"], 1e3 * controller.sample_time_s * variable.update_periods
        yield (
            f"axis {axis}: B_a goes from {variable.highest:g} at rest to {variable.lowest:g} {units.damping} at the "
            f"speed of the approach, by at most {variable.largest_change:g} every {every_ms:.3g} ms; a hand needs "
            f"{hand['without']:.0f} → {hand['with']:.0f} {units.hand}, the worst peak at the contact goes from "
            f"{peaks['without']:.2f} to {peaks['with']:.2f} N"
        )
        yield (
            f"axis {axis}: stable however B_a varies in that range, proved; the loops that keep its ends have a "
            f"modulus of {tree['modulus_at_ends']:.3g}, swept"
        )


def response_lines(controller: "Controller") -> Iterator[str]:
    """Say which threshold was chosen in `controller.provenance`, where one was asked for, and what it saves."""
    collision: Mapping[str, Any] | None = controller.provenance.get("collision")
    if collision is None:
        return
    where = f"at the {collision['objective'].removesuffix('_force')}"
    without, with_it = collision["worst_peak_n"]["without"], collision["worst_peak_n"]["with"]
    best, (low, high), lowest = collision["best_threshold_n"], collision["bounds_n"], collision["lowest_n"]
    if collision["response"] != "none":
        end = f"; {_ENDS[collision['limited_by']]}" if collision["limited_by"] in _ENDS else ""
        yield (
            f"collision response: {collision['response']} at {best:g} N takes the worst peak {where} from "
            f"{without:.2f} to {with_it:.2f} N ({100.0 * (with_it / without - 1.0):+.1f} %){end}"
        )
    else:
        rises = with_it > without + _SHOWN_N
        at_best = f"the best, {best:g} N, makes it {with_it:.2f} N" if rises else "at best it stays as it is"
        yield (
            f"collision response: none. No threshold from {max(low, lowest):.4g} to {high:g} N lowers the worst peak "
            f"{where} of {without:.2f} N by 0.1 % without raising the other one; {at_best}"
        )
    if controller.collision.false_triggers is not None:
        from autotune.validation.false_triggers import describe_false_triggers

        yield describe_false_triggers(controller.collision.false_triggers)
    if collision.get("noise_is_assumed", False):
        yield (
            f"the sensor's noise was not identified: {collision['noise_rms_n']:.3g} N RMS was taken; record rests to "
            "identify it"
        )
    if low < lowest:
        yield (
            f"thresholds below {lowest:.4g} N are left out: {collision['free_motion_n']:.3g} N oppose the motion as "
            f"the approach begins in free space, and the noise of {collision['noise_rms_n']:.3g} N RMS comes on top"
        )


def limit_lines(controller: "Controller") -> Iterator[str]:
    """Say in two lines what a reading and a command must stay within; nothing for a file without limits."""
    from autotune.formats.units import axis_units

    limits = controller.limits
    if limits is None:
        return
    commands = ", ".join(f"{name} {each.describe(axis_units(name).speed)}" for name, each in limits.axes.items())
    yield f"limits of the runtime: sensor ±{limits.force_n:g} N and ±{limits.torque_n_m:g} N·m; command {commands}"
    yield (
        f"  pose {limits.pose_speed_m_s:g} m/s and {limits.pose_speed_rad_s:g} rad/s; unchanged under a moving command "
        f"{limits.stale_wrench_s:g} s (wrench), {limits.stale_pose_s:g} s (pose); left over at the start "
        f"{limits.rest_force_n:g} N and {limits.rest_torque_n_m:g} N·m of {limits.rest_samples} readings"
    )


_BLOCKS, _CELLS = "▁▂▃▄▅▆▇█", 40
# What is shown ends where the force stays this near to its last value.
_SETTLED_SHARE, _BEHIND_THE_PEAK = 0.02, 3.0


def spark(values: Sequence[float], cells: int = _CELLS) -> str:
    """Return non-negative `values` as at most `cells` blocks: the largest of each cell, in eighths of the largest.

    Nothing but zeros is the lowest block throughout; raises ValueError where there is no value.
    """
    if not len(values):
        raise ValueError("A line of blocks needs at least one value.")
    count = min(cells, len(values))
    ends = [round(i * len(values) / count) for i in range(count + 1)]
    tops = [max(values[a:b]) for a, b in itertools.pairwise(ends)]
    whole = max(tops)
    eighths = [0 if whole <= 0.0 else round(max(top, 0.0) / whole * (len(_BLOCKS) - 1)) for top in tops]
    return "".join(_BLOCKS[each] for each in eighths)


def contact_spark(
    problem: "DesignProblem", controller: "AdmittanceController", worst: "ScenarioPrediction", units: "AxisKind"
) -> str:
    """Return the predicted force at the contact of one scenario, from the impact until it has settled."""
    from problems.contact.transient import build_sampled_contact, simulate_contact
    from problems.model.sampled import build_sampled_plant

    plant = problem.plant(worst.scenario())
    pair = build_sampled_contact(build_sampled_plant(plant, problem.sample_time_s))
    found = simulate_contact(pair, controller, problem.approach)
    force = [float(value) for value in found.contact_force_n]
    stop = max(_settled(force), round(_BEHIND_THE_PEAK * found.time_of_peak_s / problem.sample_time_s), 2)
    shown = force[:stop]
    return (
        f"{spark(shown)}  the hardest contact, {1e3 * len(shown) * problem.sample_time_s:.0f} ms, "
        f"peak {found.peak_contact_force_n:.3g} {units.force}"
    )


def _settled(force: Sequence[float]) -> int:
    """Return from which sample on the force stays near its last value."""
    near = _SETTLED_SHARE * max(abs(value) for value in force)
    off = [i for i, value in enumerate(force) if abs(value - force[-1]) > near]
    return off[-1] + 2 if off else 1
