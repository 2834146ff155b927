"""Draw the contact of two controllers on the cell of the demo: the README's picture.

Usage: python examples/draw_contact.py CONTROLLER.yaml PICTURE.svg   (needs matplotlib)
"""

import sys
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt

from autotune.formats.controller import read_controller
from autotune.formats.controller_record import admittance_controller
from autotune.simulation.truth import SimulatedCell
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins


def main(arguments: list[str]) -> int:
    source, picture = Path(arguments[0]), Path(arguments[1])
    cell = SimulatedCell()
    sampled = build_sampled_plant(cell.contact_plant(), cell.sample_time_s)
    pair = build_sampled_contact(sampled)
    chosen = admittance_controller(read_controller(source).controller, cell.approach_axis)
    # Text stays text and ids stay the same from run to run, so that the picture is small and reproducible.
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "autotune", "font.size": 10})
    figure, axes = plt.subplots(figsize=(7.2, 3.2), layout="constrained")
    for name, controller, colour in (
        ("present controller", cell.controller, "#b3541e"),
        ("chosen by autotune", chosen, "#1e6fb3"),
    ):
        run = simulate_contact(pair, controller, Approach(force_n=30.0))
        margin = find_margins(sampled, controller).modulus
        label = f"{name}: peak {run.peak_contact_force_n:.0f} N, modulus margin {margin:.2f}"
        axes.plot(run.time_s * 1e3, run.contact_force_n, color=colour, label=label)
    axes.axhline(30.0, color="0.6", linewidth=0.8, linestyle="--")
    axes.set(xlabel="time after impact [ms]", ylabel="contact force [N]", xlim=(0.0, 400.0), ylim=(0.0, None))
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(picture, metadata={"Date": None})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
