"""What the sensor's noise makes of the command, as its spectrum was logged, beside the white noise that is counted."""

from collections.abc import Iterator, Mapping

import numpy as np

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from identification.result import Identified
from problems.design.problem import DesignProblem
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_loop, build_sampled_plant
from problems.stability.noise import command_speed_gain, spectral_speed_rms

from .noise_limit import find_sensor_noise

# Less is in the noise of the spectrum itself.
_WORTH_SAYING = 0.2


def spectrum_notes(
    controller: Controller, problems: Mapping[str, DesignProblem], identified: Identified
) -> Iterator[str]:
    """Yield for each axis whose command is limited in noise what the sensor's noise makes of it as it was logged.

    Searched and limited is white noise of the same RMS; what a filter of the sensor or a vibration makes of it is
    said where it is a fifth less or more. The larger of the nominal plant in contact and in free space counts.
    """
    spectrum = identified.sensor.noise
    if spectrum is None or len(spectrum.frequency_hz) < 2:
        return
    frequency = np.array(spectrum.frequency_hz)
    for name, problem in problems.items():
        limit, is_turning = problem.requirements.command_noise, name in ROTATIONAL_AXES
        density = np.array(spectrum.torque_n2_m2_per_hz if is_turning else spectrum.force_n2_per_hz)
        rms = find_sensor_noise(identified, name)
        # A noise that is said, or one newton where none is known, is not that of the spectrum.
        if not rms or limit is None or limit.force_noise_rms_n != rms or not density.any():
            continue
        law, nominal = admittance_controller(controller, name), problem.plants.nominal
        plants = [
            build_sampled_plant(each, problem.sample_time_s) for each in (nominal, nominal.in_contact_with(FREE_SPACE))
        ]
        white = rms * max(command_speed_gain(each, law) for each in plants)
        logged = max(spectral_speed_rms(build_loop(each, law), frequency, density) for each in plants)
        if abs(logged - white) > _WORTH_SAYING * white:
            unit = f"m{axis_units(name).speed}"
            yield (
                f"Axis {name}: with the spectrum as logged the sensor's noise makes {1e3 * logged:.3g} {unit} RMS of "
                f"the command; as white noise of its RMS, which is limited, {1e3 * white:.3g} {unit}."
            )
