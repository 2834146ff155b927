"""The plants and contacts beside those of the scenarios, stacked as the compiled loops take them: held, and led.

And their responses over the admittance's band and where a noise that is not white has its power.
"""

from collections.abc import Sequence

import numpy as np

from ..arrays import FloatArray
from ..contact.transient import SampledContact
from ..model.response import PlantResponse
from .batch_kernel import (
    Band,
    Contacts,
    Loops,
    Plants,
    Spectrum,
    responses_at,
    stack_contacts,
    stack_grids,
    stack_loops,
    stack_responses,
)
from .evaluation import PreparedScenarios
from .requirements import ContactAtSpeed, HeldByHand, NoiseLimit, Requirements
from .requirements.contact_at_speed import led_contacts
from .requirements.held_by_hand import held_plants

HELD, LED = "held_by_hand", "contact_at_speed"
"""Names of the requirements that ask for them."""


def hands_of(asked: Requirements) -> HeldByHand:
    """Return the hands of the modulus that is asked."""
    held = asked.further[HELD]
    assert isinstance(held, HeldByHand)  # the requirement of that name
    return held


def stack_held(prepared: PreparedScenarios) -> Plants:
    """Return all plants in all hands, as `find_moduli` takes them."""
    asked = hands_of(prepared.problem.requirements)
    held = [each for plant in prepared.plants for each in held_plants(asked, plant.sampled)]
    return stack_loops([each.sampled for each in held]), stack_responses(held), stack_grids(held)


def led_limit(asked: Requirements) -> ContactAtSpeed:
    """Return the limit of contacts that are led by hand."""
    limit = asked.further[LED]
    assert isinstance(limit, ContactAtSpeed)  # the requirement of that name
    return limit


def stack_led(prepared: PreparedScenarios) -> tuple[Loops, Contacts]:
    """Return all contacts as a hand leads them, as `find_contact_peaks` takes them."""
    asked = led_limit(prepared.problem.requirements)
    by_hand = zip(*(led_contacts(pair, asked.hand, asked.hand_mass_kg) for pair in prepared.pairs), strict=True)
    return stack_judged([each for contacts in by_hand for each in contacts])


def stack_judged(contacts: Sequence[SampledContact]) -> tuple[Loops, Contacts]:
    """Return the loops of contacts, then those before they touch, and what is simulated of them."""
    sides = [each.contact for each in contacts] + [each.free for each in contacts]
    return stack_loops(sides), stack_contacts(contacts)


def stack_spectrum(limit: NoiseLimit | None, responses: FloatArray, sample_time_s: float) -> Spectrum | None:
    """Return a limited noise and the plants' responses, as `times_spectral_ratios` takes them, None where it is white.

    The same where none is limited.
    """
    if limit is None or limit.noise_spectrum is None:
        return None
    omega, spectral, white = limit.noise_spectrum.nodes(sample_time_s)
    tangent = np.tan(0.5 * sample_time_s * omega)
    # |1 − 1/z| is 2 sin(ωh/2).
    power = np.sin(0.5 * sample_time_s * omega) ** 2
    return tangent, (spectral * power, white * power), *responses_at(responses, tangent)


def stack_band(responses: Sequence[PlantResponse]) -> Band:
    """Return responses one after the other; of the wrench's filter |G| needs |F_m/F| alone."""
    if not responses:
        return np.zeros(0), np.zeros(0, dtype=np.complex128), np.zeros(0, dtype=np.complex128)
    return (
        np.concatenate([each.frequency_rad_per_s * _wrench_gain(each) for each in responses]),
        np.concatenate([each.z for each in responses]),
        np.concatenate([each.position for each in responses]),
    )


def _wrench_gain(target: PlantResponse) -> FloatArray | float:
    return 1.0 if target.wrench is None else np.abs(target.wrench)
