"""What the contacts of many plants say of a controller: the verdicts in words, and the results as plain data."""

from collections.abc import Iterator, Sequence

from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.text import scenario_text
from problems.design.uncertainty import Scenario
from problems.model.plant_parameters import PARAMETERS

from .monte_carlo import QUANTILES, SAME_PEAK, AxisMonteCarlo, SampledPeaks
from .report import Check
from .sampled_contacts import CONFIDENCE

# Steps of Runge–Kutta alone see the same contact, but for a kink inside a step.
_SAME_CONTACT = 1e-3


def monte_carlo_checks(found: Sequence[AxisMonteCarlo]) -> tuple[Check, ...]:
    """Return the verdicts: the file's own model on the sampled plants, then the full simulation."""
    return tuple(check for each in found for check in _axis_checks(each))


def _axis_checks(found: AxisMonteCarlo) -> Iterator[Check]:
    if found.unstable is not None:
        where = scenario_text(found.unstable, axis_units(found.axis))
        message = f"the loop is not stable at {where}; {violations_text(found)}"
        yield Check(axis=found.axis, name="sampled peaks", passed=False, message=message)
    elif found.is_left_out:
        message = (
            f"not simulated: {found.refusal.removesuffix('.')}; margins and predicted contacts are verified above, "
            "deadband, noise, limits and late commands are not"
        )
        yield Check(axis=found.axis, name="full simulation", passed=True, message=message, warns=True)
    elif found.contact is None or found.sensor is None:
        yield Check(axis=found.axis, name="full simulation", passed=False, message=f"not possible: {found.refusal}")
    else:
        both = (("contact", found.contact), ("sensor", found.sensor))
        yield _linear_check(found, both)
        yield _full_check(found, both)


def _linear_check(found: AxisMonteCarlo, both: Sequence[tuple[str, SampledPeaks]]) -> Check:
    """Hold the peaks of the file's own model, without disturbances, against the predicted ones."""
    units = axis_units(found.axis)
    above = [
        f"the peak {what} {units.force_name} is {of.linear.largest:.2f} {units.force} at "
        f"{scenario_text(of.linear.plant, units)}, more than the largest predicted, {of.predicted:.2f} {units.force}"
        for what, of in both
        if of.linear.largest > of.predicted + SAME_PEAK * max(of.predicted, found.driving_force)
    ]
    text = ", ".join(f"{of.linear.largest:.1f} {units.force} at the {what}" for what, of in both)
    message = "; ".join(above) or f"largest of {found.count} plants {text}, none above the predicted"
    return Check(axis=found.axis, name="sampled peaks", passed=not above, message=message)


def _change(of: SampledPeaks) -> float:
    """Return what the disturbances add, to the digit that is shown; adding nothing makes 0 of -0."""
    return round(of.observed.largest - of.linear.largest, 1) + 0.0


def _full_check(found: AxisMonteCarlo, both: Sequence[tuple[str, SampledPeaks]]) -> Check:
    """Hold the peaks with disturbances against what these explain."""
    units = axis_units(found.axis)
    above = [
        f"the peak {what} {units.force_name} is {of.observed.largest:.2f} {units.force} at "
        f"{scenario_text(of.observed.plant, units)}; {of.predicted:.2f} {units.force} is predicted, "
        f"and {_describe_effects(found)} explain {of.limit:.2f} {units.force} at most"
        for what, of in both
        if of.observed.largest > of.limit
    ]
    text = ", ".join(
        f"{of.observed.largest:.1f} {units.force} at the {what} ({_change(of):+.1f}; at most {of.limit:.1f})"
        for what, of in both
    )
    above += [
        f"the contact at {scenario_text(each.plant, units)} peaks at {each.contact:.3f} {units.force}, and in steps of "
        f"Runge–Kutta alone at {each.repeated:.3f} {units.force}"
        for each in found.worst
        if abs(each.repeated - each.contact) > _SAME_CONTACT * each.contact
    ]
    message = "; ".join(above) or f"with {_describe_effects(found)} largest {text}"
    message = f"{message}; {violations_text(found)}"
    return Check(axis=found.axis, name="full simulation", passed=not above, message=message)


def violations_text(found: AxisMonteCarlo) -> str:
    """Return how many plants broke a limit, and the bound on their share."""
    some = f"{found.violating or 'none'} of {found.count} plants break{'' if found.violating > 1 else 's'} a limit"
    confidence = f"{100.0 * CONFIDENCE:g} % confidence"
    return f"{some}, with {confidence} no more than {100.0 * found.largest_share:.2g} % of all do"


def _describe_effects(found: AxisMonteCarlo) -> str:
    effects, units = found.effects, axis_units(found.axis)
    text = [
        f"{effects.deadband.width_n:g} {units.force} deadband" if effects.deadband is not None else "",
        f"{effects.force_noise_rms_n:.3g} {units.force} noise",
        f"clipping at {effects.force_limit_n:g} {units.force}" if effects.force_limit_n is not None else "",
        f"at most {effects.limits.speed_m_s:g} {units.speed}" if effects.limits is not None else "",
        f"{100.0 * effects.late_share:g} % of the commands late",
        f"the collision response at {effects.collision.threshold_n:g} N" if effects.collision is not None else "",
        "B_a that follows the speed" if effects.variable_damping is not None else "",
    ]
    return ", ".join(part for part in text if part)


def monte_carlo_tree(found: Sequence[AxisMonteCarlo]) -> dict[str, object]:
    """Return the results by axis as plain data."""
    return {each.axis: _axis_tree(each) for each in found}


def _axis_tree(found: AxisMonteCarlo) -> dict[str, object]:
    effects, units = found.effects, axis_units(found.axis)
    return {
        "samples": found.count,
        "seed": found.seed,
        "unit": units.force,
        "effects": {
            "deadband": effects.deadband.width_n if effects.deadband is not None else 0.0,
            "noise_rms": effects.force_noise_rms_n,
            "sensor_range": effects.force_limit_n,
            "command_speed_limit": None if effects.limits is None else effects.limits.speed_m_s,
            "late_share": effects.late_share,
            "collision_threshold": None if effects.collision is None else effects.collision.threshold_n,
            "damping": None if effects.variable_damping is None else list(effects.variable_damping.bounds_n_s_per_m),
        },
        "unstable": None if found.unstable is None else scenario_text(found.unstable, units),
        "refusal": found.refusal or None,
        "violating": found.violating,
        "largest_share": found.largest_share,
        "confidence": CONFIDENCE,
        **{
            what: {
                "predicted": of.predicted,
                "limit": of.limit,
                **{
                    model: {
                        "largest": peaks.largest,
                        "plant": scenario_text(peaks.plant, units),
                        "quantiles": {
                            f"{share:g}": value for share, value in zip(QUANTILES, peaks.quantiles, strict=True)
                        },
                    }
                    for model, peaks in (("linear", of.linear), ("observed", of.observed))
                },
            }
            for what, of in (("contact", found.contact), ("sensor", found.sensor))
            if of is not None
        },
        "worst": [
            {
                "index": each.index,
                "plant": scenario_text(each.plant, units),
                "parameters": _parameters(found.axis, each.plant),
                "contact": each.contact,
                "sensor": each.sensor,
                "repeated_contact": each.repeated,
            }
            for each in found.worst
        ],
        "distribution": None
        if found.distribution is None
        else {"edges": list(found.distribution.edges), "counts": list(found.distribution.counts)},
    }


def _parameters(axis: str, plant: Scenario) -> dict[str, float]:
    """Return the values of a plant by their names in files."""
    values = {name: value for name, value in vars(plant).items() if value is not None}
    turns = axis in ROTATIONAL_AXES
    return {PARAMETERS[name].rotational_name if turns else name: value for name, value in values.items()}
