"""The section of a report on axes that act on each other through the payload."""

from autotune.formats.controller_record import Controller

from .page import Block, Note, Section, build_table


def coupled_section(controller: Controller) -> Section:
    """Return what the axes do together, empty where the file does not say it."""
    found = controller.certificate.coupled
    blocks: list[Block] = []
    if found is not None:
        blocks += [Note(text=line, kind="together", tone="quiet") for line in found.sentences()]
        if found.loops:
            rows = [(name, f"{each.modulus:.3g}", f"{each.disk:.3g}") for name, each in found.loops.items()]
            blocks.append(
                build_table(
                    "Margins of each axis while the loops of all others are closed; swept over the ends of K_e and M_p",
                    ("axis", "modulus", "disk margin"),
                    rows,
                    numbers=(1, 2),
                )
            )
        for name, points in found.points.items():
            contacts = [
                (
                    ", ".join(f"{each:.3g}" for each in point.point_m),
                    f"{point.peak_contact_force_n:.1f}",
                    f"{100.0 * (point.largest_ratio - 1.0):+.1f} %",
                    f"{point.leaves:g}",
                )
                for point in points
            ]
            blocks.append(
                build_table(
                    f"Axis {name} touching with points of the payload: largest peak, and beside the axis alone",
                    ("point [m]", "peak [N]", "beside", "leaves"),
                    contacts,
                    numbers=(1, 2, 3),
                )
            )
    return Section(key="together", title="Axes together", blocks=tuple(blocks), is_folded=True)
