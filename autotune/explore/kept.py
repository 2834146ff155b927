"""Designs that are kept while exploring: a table of them beside each other, and which of them a click means."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from bokeh.core.properties import String
from bokeh.model import DataModel
from bokeh.models.widgets import Div

from problems.arrays import FloatArray
from problems.design.requirements import Requirements
from problems.model.axis_kind import AxisKind

from .figures import Sender
from .sliders import SliderRange
from .view import PreparedView, View, compute_view

MOST = 8
_ADMITTANCE = "free_space_admittance"
_NONE = "–"


@dataclass(frozen=True, kw_only=True, eq=False)
class KeptDesign:
    """A design by its number, and what it does on the plants and under the requirements of the page."""

    number: int
    view: View


def kept_table(kept: Sequence[KeptDesign], gains: Sequence[SliderRange], asked: Requirements, units: AxisKind) -> str:
    """Return the kept designs as a table of HTML, with a button to return to each and one to remove it."""
    if not kept:
        return ""
    head = ["", *(f"{span.symbol} [{span.unit}]" if span.unit else span.symbol for span in gains)]
    head += [f"worst peak [{units.force}]", "modulus margin", f"|G| [{units.admittance}]", "", ""]
    titles = "".join(f'<th scope="col">{escape(title)}</th>' for title in head)
    rows = "".join(_row(each, gains, asked) for each in kept)
    return f'<div class="table"><table><thead><tr>{titles}</tr></thead><tbody>{rows}</tbody></table></div>'


def _row(kept: KeptDesign, gains: Sequence[SliderRange], asked: Requirements) -> str:
    own, view = kept.view.evaluation, kept.view
    peak = max((each.peak_contact_force_n for each in own.peaks), default=None)
    modulus = _achieved(view, asked, "modulus_margin")
    if modulus is None and view.margins is not None:
        modulus = view.margins.modulus
    numbers = [f"{span.scale * value:.4g}" for span, value in zip(gains, view.design, strict=True)]
    numbers += [
        _NONE if value is None else f"{value:.4g}" for value in (peak, modulus, _achieved(view, asked, _ADMITTANCE))
    ]
    tone, said = (
        ("good", "feasible") if own.is_feasible else ("warn", "misses") if own.is_stable else ("bad", "unstable")
    )
    cells = "".join(f"<td>{number}</td>" for number in numbers)
    back = _button("return", kept.number, str(kept.number), f"Return to design {kept.number}")
    drop = _button("remove", kept.number, "×", f"Remove design {kept.number}")
    return f'<tr><td>{back}</td>{cells}<td class="{tone}">{said}</td><td>{drop}</td></tr>'


def _achieved(view: View, asked: Requirements, name: str) -> float | None:
    """Return what a design achieves of a requirement that is asked, worst over the plants; None where unstable."""
    ratio, value = view.ratios.get(name), asked.asked().get(name)
    return None if ratio is None or value is None else asked.kind(name).achieved_at(value, ratio)


def _button(action: str, number: int, text: str, label: str) -> str:
    return f'<button type="button" data-kept="{action} {number}" aria-label="{label}" title="{label}">{text}</button>'


def read_click(said: str) -> tuple[str, int] | None:
    """Return the action, "return" or "remove", and the number that a click says; None for anything else."""
    action, _, rest = said.partition(" ")
    number = rest.partition(" ")[0]
    return (action, int(number)) if action in {"return", "remove"} and number.isdecimal() else None


class KeptClick(DataModel):
    """What the page says when a button of the table is clicked: action, number, and a count of clicks."""

    said: Any = String(default="")


class Keeper:
    """The kept designs of every axis, in the order in which they were kept.

    `give_back` gets the design that was clicked, `changed` is called once one was removed.
    """

    def __init__(
        self, look: Mapping[str, Any], give_back: Callable[[FloatArray], None], changed: Callable[[], None]
    ) -> None:
        self._give_back, self._changed = give_back, changed
        self._designs: dict[str, dict[int, FloatArray]] = {}
        self._axis, self._count = "", 0
        self._shown: tuple[object, tuple[int, ...]] | None = None
        self._views: dict[int, View] = {}
        click = KeptClick(name="kept-click")
        click.on_change("said", self._clicked)
        self.table = Div(name="kept", tags=[click], **look)

    def keep(self, axis: str, design: FloatArray) -> str:
        """Keep a design of an axis; return why not, "" where it is kept."""
        own = self._designs.setdefault(axis, {})
        if any(np.array_equal(design, each) for each in own.values()):
            return "This design is kept already."
        if len(own) == MOST:
            return f"At most {MOST} designs are kept; remove one first."
        self._count += 1
        own[self._count] = np.array(design)
        return ""

    def follow(
        self, axis: str, prepared: PreparedView, gains: Sequence[SliderRange], units: AxisKind, sender: Sender
    ) -> Mapping[int, View] | None:
        """Show the designs of an axis as they are on the plants looked at; return their views, None if none changed."""
        self._axis, own = axis, self._designs.get(axis, {})
        key = prepared, tuple(own)
        if self._shown is not None and self._shown[0] is prepared and self._shown[1] == key[1]:
            return None
        known = self._views if self._shown is not None and self._shown[0] is prepared else {}
        self._views = {n: known[n] if n in known else compute_view(prepared, each) for n, each in own.items()}
        self._shown = key
        kept = [KeptDesign(number=number, view=view) for number, view in self._views.items()]
        sender.put(self.table, text=kept_table(kept, gains, prepared.problem.requirements, units))
        return self._views

    def _clicked(self, _name: str, _old: str, new: str) -> None:
        found, own = read_click(new), self._designs.get(self._axis, {})
        if found is None or found[1] not in own:
            return
        if found[0] == "return":
            self._give_back(own[found[1]])
        else:
            del own[found[1]]
            self._changed()
