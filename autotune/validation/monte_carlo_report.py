"""What the simulated contacts say of a controller file: verdicts in words, and plain data."""

from collections.abc import Iterator, Sequence

from autotune.formats.units import axis_units

from .monte_carlo import QUANTILES, SAME_PEAK, AxisMonteCarlo, SampledPeaks
from .report import Check


def monte_carlo_checks(found: Sequence[AxisMonteCarlo]) -> tuple[Check, ...]:
    """Return the verdicts: the file's own model on the sampled plants, then the full simulation."""
    return tuple(check for each in found for check in _axis_checks(each))


def _axis_checks(found: AxisMonteCarlo) -> Iterator[Check]:
    if found.unstable is not None:
        message = f"the loop is not stable at {found.unstable.name}"
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
        f"the peak {what} {units.force_name} is {of.linear.largest:.2f} {units.force} at {of.linear.plant.name}, more "
        f"than the largest predicted, {of.predicted:.2f} {units.force}"
        for what, of in both
        if of.linear.largest > of.predicted + SAME_PEAK * max(of.predicted, found.driving_force)
    ]
    told = ", ".join(f"{of.linear.largest:.1f} {units.force} at the {what}" for what, of in both)
    message = "; ".join(above) or f"largest of {found.count} plants {told}, none above the predicted"
    return Check(axis=found.axis, name="sampled peaks", passed=not above, message=message)


def _change(of: SampledPeaks) -> float:
    """Return what the disturbances add, to the digit that is told; adding nothing makes 0 of -0."""
    return round(of.observed.largest - of.linear.largest, 1) + 0.0


def _full_check(found: AxisMonteCarlo, both: Sequence[tuple[str, SampledPeaks]]) -> Check:
    """Hold the peaks with disturbances against what these explain."""
    units = axis_units(found.axis)
    above = [
        f"the peak {what} {units.force_name} is {of.observed.largest:.2f} {units.force} at {of.observed.plant.name}; "
        f"{of.predicted:.2f} {units.force} is predicted, and {_effects_told(found)} explain {of.limit:.2f} "
        f"{units.force} at most"
        for what, of in both
        if of.observed.largest > of.limit
    ]
    told = ", ".join(
        f"{of.observed.largest:.1f} {units.force} at the {what} ({_change(of):+.1f}; at most {of.limit:.1f})"
        for what, of in both
    )
    message = "; ".join(above) or f"with {_effects_told(found)} largest {told}"
    return Check(axis=found.axis, name="full simulation", passed=not above, message=message)


def _effects_told(found: AxisMonteCarlo) -> str:
    effects, units = found.effects, axis_units(found.axis)
    told = [
        f"{effects.deadband.width_n:g} {units.force} deadband" if effects.deadband is not None else "",
        f"{effects.force_noise_rms_n:.3g} {units.force} noise",
        f"clipping at {effects.force_limit_n:g} {units.force}" if effects.force_limit_n is not None else "",
        f"at most {effects.limits.speed_m_s:g} {units.speed}" if effects.limits is not None else "",
        f"{100.0 * effects.late_share:g} % of the commands late",
        f"the collision response at {effects.collision.threshold_n:g} N" if effects.collision is not None else "",
    ]
    return ", ".join(part for part in told if part)


def monte_carlo_tree(found: Sequence[AxisMonteCarlo]) -> dict[str, object]:
    """Return the results by axis as plain data."""
    return {each.axis: _axis_tree(each) for each in found}


def _axis_tree(found: AxisMonteCarlo) -> dict[str, object]:
    effects = found.effects
    return {
        "samples": found.count,
        "seed": found.seed,
        "unit": axis_units(found.axis).force,
        "effects": {
            "deadband": effects.deadband.width_n if effects.deadband is not None else 0.0,
            "noise_rms": effects.force_noise_rms_n,
            "sensor_range": effects.force_limit_n,
            "command_speed_limit": None if effects.limits is None else effects.limits.speed_m_s,
            "late_share": effects.late_share,
            "collision_threshold": None if effects.collision is None else effects.collision.threshold_n,
        },
        "unstable": None if found.unstable is None else found.unstable.name,
        "refusal": found.refusal or None,
        **{
            what: {
                "predicted": of.predicted,
                "limit": of.limit,
                **{
                    model: {
                        "largest": peaks.largest,
                        "plant": peaks.plant.name,
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
    }
