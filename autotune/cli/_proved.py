"""What the terminal says of a law: its gains, what is proved, contacts of a led payload, the worst simulated."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from ._terminal import print_message, print_table

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller
    from autotune.tuning.optimize import Optimized
    from autotune.validation.monte_carlo import AxisMonteCarlo


def _proved(claim: str, share: float) -> str:
    """Return a claim with how much of it is proved."""
    if share == 1.0:
        return f"{claim}, proved"
    proved = f"proved for {100.0 * share:.3g} % of the set" if share > 0.0 else "swept, nothing of it proved"
    return f"{claim}, {proved} (--proof-budget SECONDS goes further)"


def peak_lines(controller: "Controller") -> Iterator[str]:
    """Say which force is proved for every first contact."""
    from autotune.formats.units import axis_units
    from autotune.prediction.as_run_by import designed_for

    for name, peak in (controller.certificate.peaks or {}).items():
        if not designed_for(controller):
            claim = f"no first contact exceeds {peak.force_n:.4g} {axis_units(name).force}"
            yield f"axis {name}: {_proved(claim, peak.share)}"


def rest_lines(controller: "Controller") -> Iterator[str]:
    """Say of every axis whether its contacts are proved to come to rest, or how many impacts were followed."""
    from autotune.prediction.as_run_by import designed_for
    from problems.design.uncertainty import SYMBOLS

    for name, each in (controller.certificate.bouncing or {}).items():
        if designed_for(controller):
            continue
        sampled = f"{each.impacts:g} impacts on plants of the whole set come to rest, sampled"
        if each.share == 0.0:
            yield f"axis {name}: no contact found that bounces for ever; {sampled}"
            continue
        over = ", ".join(SYMBOLS[key] for key in each.over)
        more = f"; {sampled}" if each.impacts > 0.0 else ""
        yield f"axis {name}: {_proved(f'every contact comes to rest, over {over}', each.share)}{more}"
    yield from _bumper_lines(controller)


def _bumper_lines(controller: "Controller") -> Iterator[str]:
    """Say what the axes do with a payload that is soft inside."""
    from autotune.prediction.as_run_by import designed_for

    found = controller.certificate.bumper
    if found is None or designed_for(controller):
        return
    for name, each in found.axes.items():
        yield (
            f"axis {name}, with {found.describe()}: at most {each.peak_contact_force_n:.4g} N at the contact and "
            f"{each.peak_sensor_force_n:.4g} N at the sensor, |1 + L| at least {each.modulus:.3g}, "
            f"{each.plants:g} plants sampled"
        )
        claimed = each.proved_modulus or each.modulus
        yield f"axis {name}, with the bumper: {_proved(f'stable, |1 + L| > {claimed:.3g}', each.share)}"


def led_lines(controller: "Controller", limit: tuple[float, str] | None = None) -> Iterator[str]:
    """Say how hard a payload that is led by hand touches, and up to which speed a force is not exceeded.

    `limit` is the force [N] with its name: by default the one of `contact_at_speed`, else that of a clamped hand.
    """
    from autotune.formats.units import ROTATIONAL_AXES
    from autotune.prediction.as_run_by import capped_speed_text, designed_for, led_speed_text, peak_per_speed
    from autotune.validation.certified_requirements import asked_of
    from problems.design.requirements import BODY_REGIONS, ContactAtSpeed

    target = designed_for(controller)
    runs = f" as {target} runs it" if target else ""
    for name in controller.predicted:
        per_speed, asked = peak_per_speed(controller, name), asked_of(controller, name).get("contact_at_speed")
        if per_speed is None or name in ROTATIONAL_AXES:
            continue
        said = (asked.max_force_n, "contact_at_speed") if isinstance(asked, ContactAtSpeed) else None
        force, label = limit or said or (BODY_REGIONS["hand"], "ISO/TS 15066, clamped hand")
        does = {"pushes_on": "while the hand pushes on", "lets_go": "when it lets go"}
        if per_speed.hand_mass_kg is not None:
            does["holds"] = f"where {per_speed.hand_mass_kg:g} kg of it move with the payload"
        hands = [hand for hand in ("pushes_on", "holds", "lets_go") if hand in does]
        *others, last = (led_speed_text(controller, name, force, hand) for hand in hands)
        speeds = f"{', '.join(others)} and {last} m/s"
        peaks = ", ".join(f"{getattr(per_speed, hand):.4g} N per m/s {does[hand]}" for hand in hands)
        capped = " (* the limit of the command)" if "*" in speeds else ""
        yield f"axis {name}, led by hand{runs}: {peaks}; at most {force:g} N ({label}) up to {speeds}{capped}"
        if per_speed.drives is not None and per_speed.arm is not None:
            arm, safe = per_speed.arm.describe(), capped_speed_text(controller, name, force / per_speed.drives)
            yield (
                f"axis {name}, driven on for {per_speed.drives_for_s:g} s after the touch by {arm}: "
                f"{per_speed.drives:.4g} N per m/s, at most {force:g} N up to {safe} m/s; simulated"
            )


def held_lines(controller: "Controller") -> Iterator[str]:
    """Say what is left of the modulus while a hand holds the payload."""
    from autotune.formats.units import ROTATIONAL_AXES
    from autotune.prediction.as_run_by import designed_for

    for name, held in (controller.certificate.held or {}).items():
        if designed_for(controller):
            continue
        hand = held.hand.describe(turning=name in ROTATIONAL_AXES)
        if held.modulus == 0.0:
            yield f"axis {name}: {hand} may make the loop unstable; the requirement held_by_hand excludes it"
        else:
            yield f"axis {name}, held by {hand}: {_proved(f'stable, |1 + L| > {held.modulus:.3g}', held.share)}"


def coupled_lines(controller: "Controller", unchecked: str = "") -> Iterator[str]:
    """Say what the axes do together; `unchecked` is why nothing is known of that."""
    from autotune.prediction.as_run_by import designed_for

    found = controller.certificate.coupled
    if found is None or designed_for(controller):
        if unchecked and found is None:
            yield f"axes together: not checked, {unchecked}"
        return
    yield from found.sentences()
    for each in found.proofs:
        claim = f"stable, smallest singular value of I + L at the {each.at}s above {each.modulus:.3g}"
        yield f"{each.of_what()}: {_proved(claim, each.share)}"


def print_samples(simulated: "Sequence[AxisMonteCarlo]") -> None:
    """Print the quantiles of the sampled contact force, and of a study that is larger than usual the worst plants."""
    from autotune.formats.units import axis_units
    from autotune.text import scenario_text
    from autotune.validation.monte_carlo import QUANTILES, SAMPLES

    for found in simulated:
        if found.contact is None:
            continue
        units = axis_units(found.axis)
        quantiles = zip(QUANTILES, found.contact.observed.quantiles, strict=True)
        text = ", ".join(f"{value:.2f} {units.force} in {100.0 * share:g} %" for share, value in quantiles)
        print_message(f"axis {found.axis}, contact force of {found.count} plants: at most {text}")
        if found.count <= SAMPLES:
            continue
        rows = [(f"worst plants of {found.axis}", "contact", "sensor"), ("", units.force, units.force)]
        rows += [
            (scenario_text(each.plant, units), f"{each.contact:.2f}", f"{each.sensor:.2f}") for each in found.worst
        ]
        print_table(rows)


def noise_lines(found: "Optimized", name: str) -> Iterator[str]:
    """Yield how to have the noise of the command in the place of bounds that hold the design."""
    if name not in found.noise_limitable:
        return
    active = found.optimality_reports[name].active
    held = {entry.name.partition(" bound of ")[2] for entry in active if entry.price > 0.0}
    problem = found.searches[name].problem
    if held & {"mass", "lead_s", "feedback_damping_s"} and problem.requirements.command_noise is None:
        yield "or limit the noise of the command in the place of these bounds: --structure noise (docs/limit.md)"


def law_lines(found: "Optimized", name: str) -> Iterator[str]:
    """Yield the law of an axis: the gains, and what it has beside them."""
    from autotune.formats.units import axis_units
    from problems.design.problem import FURTHER_VARIABLES

    controller, units = found.controller, axis_units(name)
    gains = controller.axes[name]
    yield (
        f"axis {name}: M_a {gains.mass:g} {units.mass}, B_a {gains.damping:g} {units.damping}, "
        f"K_l {1e3 * gains.lead_s:g} ms, B_fb {1e3 * gains.feedback_damping_s:g} ms"
    )
    if gains.biquad is not None:
        yield f"  biquad in the path of the force: {gains.biquad.describe()}"
    if set(found.searches[name].problem.variables) & set(FURTHER_VARIABLES):
        filters, compensation = controller.filters, controller.compensation_mass_kg
        yield (
            f"  ω_v {filters.velocity_rad_per_s:g} rad/s, ω_a {filters.acceleration_rad_per_s:g} rad/s, "
            f"P̂ {compensation:g} kg"
        )
