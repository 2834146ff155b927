"""Build the page: sliders and figures, computed again when a slider moves."""

from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.models import CustomJS, CustomJSTickFormatter, InlineStyleSheet
from bokeh.models.widgets import Button, Div, Select, Slider
from jinja2 import Environment, StrictUndefined, Template

from autotune.formats.units import axis_units
from problems.errors import AutotuneError

from . import words
from .figures import KEYS, Figures, Sender
from .saving import Saver, Target, refused_line
from .sliders import STEPS, SliderRange, build_gain_sliders, build_plant_sliders, nominal_values, scenario_at
from .source import AxisStart, Exploration
from .view import MapWindow, PreparedView, View, build_window, compute_map, compute_view, map_pairs, prepare_view

_COLUMNS, _ROWS, _FINER = 20, 15, 2
# How long a hand rests before the map is drawn more finely.
_RESTS_MS = 350
_LOGARITHMIC = "return String(Number((10 ** tick).toPrecision(4)));"
_PLAIN = "return String(Number(tick.toPrecision(4)));"
_MAP_CAPTION = (
    "Coloured by its worst peak: a design that meets every requirement on all plants. The plain ground misses one, the "
    "reddish is unstable. Each cell is judged at its middle; the framed one around the star is the present design."
)
_STYLE = """
:host { color: inherit; font: inherit; }
p { margin: 0.2rem 0; overflow-wrap: anywhere; }
.good { color: var(--good); } .warn { color: var(--warn); } .bad { color: var(--bad); }
.quiet, .earlier p { color: var(--soft); }
dl { display: flex; flex-wrap: wrap; gap: 0.5rem 1.6rem; margin: 0; }
dt { color: var(--soft); font-size: 0.82rem; } dd { margin: 0; font-size: 1.2rem; font-variant-numeric: tabular-nums; }
.bk-slider-title { white-space: normal; }
.bk-slider-title, label { color: var(--ink); font-size: 0.85rem; }
select.bk-input { color: var(--ink); background-color: var(--pale); border-color: var(--line); }
.bk-btn { color: var(--ink); background: var(--pale); border-color: var(--line); white-space: normal; }
.bk-btn[disabled], .noUi-target[disabled], select[disabled] { opacity: 0.4; }
.bk-btn[disabled] { color: var(--ink); background: var(--pale); }
"""


class ExplorePage:
    """One visitor's page: the designs of all axes, and the axis that is shown.

    The designs live as long as the page. `target` is the one file that it can write.
    """

    def __init__(self, exploration: Exploration, target: Target, document: Document) -> None:
        self.exploration, self.document = exploration, document
        self.axis = next(iter(exploration.axes))
        self.designs = {name: np.array(start.design) for name, start in exploration.axes.items()}
        self.plants = {name: nominal_values(start.problem) for name, start in exploration.axes.items()}
        self.figures = Figures()
        self.ranges: dict[str, SliderRange] = {}
        self.window: MapWindow | None = None
        self.prepared: tuple[object, PreparedView] | None = None
        self.mapped: object = None
        self.asked = self.is_updating = False
        self.resting: Any = None
        look: dict[str, Any] = {"sizing_mode": "stretch_width", "stylesheets": [InlineStyleSheet(css=_STYLE)]}
        self._build_widgets(look)
        self.saver = Saver(exploration, target, document, self.designs, look)
        changing = [self.verdict, self.facts, self.saver.status, self.saver.held]
        self.sender = Sender(document, [*self.figures.changing(), *changing], self.verdict)
        self.saver.connect(self.sender)
        self._show_axis()

    @property
    def start(self) -> AxisStart:
        """The axis that is shown, as it began."""
        return self.exploration.axes[self.axis]

    def _build_widgets(self, look: dict[str, Any]) -> None:
        names = {
            span.name: span
            for axis, start in self.exploration.axes.items()
            for span in (*build_gain_sliders(start.problem, axis), *build_plant_sliders(start.problem, axis))
        }
        self.sliders = {name: Slider(start=0.0, end=1.0, value=0.0, step=0.01, name=name, **look) for name in names}
        for slider in self.sliders.values():
            slider.on_change("value", self._slider_moved)
        self.verdict, self.facts = (Div(name=key, **look) for key in ("verdict", "facts"))
        self.back = Button(label="Back to the start", name="back", button_type="default", **look)
        axes: Any = list(self.exploration.axes)
        self.choice = Select(title="Axis", name="axis", value=self.axis, options=axes, **look)
        self.over = Select(title="Map over", name="over", **look)
        self.back.on_click(self._go_back)
        self.choice.on_change("value", self._axis_chosen)
        self.over.on_change("value", self._map_chosen)

    def roots(self) -> list[Any]:
        """Return everything that the page places by its name."""
        saving = [self.saver.status, self.saver.button, self.saver.held]
        widgets = [self.verdict, self.facts, self.back, self.choice, self.over]
        return [*saving, *widgets, *self.sliders.values(), *self.figures.plots.values()]

    def _show_axis(self) -> None:
        problem = self.start.problem
        gains, plant = build_gain_sliders(problem, self.axis), build_plant_sliders(problem, self.axis)
        self.ranges = {span.name: span for span in (*gains, *plant)}
        pairs = map_pairs(problem)
        self.choice.visible = len(self.exploration.axes) > 1
        titles = [(",".join(pair), " and ".join(self.ranges[name].label for name in pair)) for pair in pairs]
        self.is_updating = True
        self.over.update(options=titles, value=titles[0][0] if titles else "", visible=len(pairs) > 1)
        self.is_updating = False
        self.figures.plots["map"].visible = bool(pairs)
        self.saver.note(self.start.note)
        view = compute_view(self._prepare(), self.start.design)
        self.figures.begin(problem, self.axis, view)
        self.window = None
        self._set_ranges()
        self._set_sliders()
        self.update()

    def _set_ranges(self) -> None:
        """Give every slider its range; one that cannot be moved is not shown."""
        self.is_updating = True
        for name, slider in self.sliders.items():
            span = self.ranges.get(name)
            slider.visible = span is not None and span.high > span.low
            if span is None or not slider.visible:
                continue
            low, high = span.ends
            form = CustomJSTickFormatter(code=_LOGARITHMIC if span.logarithmic else _PLAIN)
            slider.update(title=span.title, start=low, end=high, step=(high - low) / STEPS, format=form)
        self.is_updating = False

    def _set_sliders(self) -> None:
        values = {**dict(zip(self.start.problem.variables, self.designs[self.axis], strict=True)), **self._plant()}
        self.is_updating = True
        for name, value in values.items():
            if self.sliders[name].visible:
                self.sliders[name].value = self.ranges[name].position(float(value))
        self.is_updating = False

    def _plant(self) -> dict[str, float]:
        return self.plants[self.axis]

    def _slider_moved(self, _name: str, _old: float, _new: float) -> None:
        if not self.is_updating:
            self._ask()

    def _ask(self) -> None:
        """Compute once for all sliders that moved meanwhile: no picture is made that nobody will see."""
        if not self.asked:
            self.asked = True
            self.document.add_next_tick_callback(self._answer)

    def _answer(self) -> None:
        self.asked = False
        problem = self.start.problem
        for i, name in enumerate(problem.variables):
            if self.sliders[name].visible:
                self.designs[self.axis][i] = self.ranges[name].value(float(self.sliders[name].value))
        for name in self._plant():
            self._plant()[name] = self.ranges[name].value(float(self.sliders[name].value))
        self.update()

    def update(self) -> None:
        """Compute and show the view of the present design and plant, and the map if another one is due."""
        try:
            prepared = self._prepare()
            view = compute_view(prepared, self.designs[self.axis])
            self.figures.show(view, self.sender)
            self._show_words(view, len(prepared.scenarios))
            self._show_map(prepared)
            self._show_own(view)
            self.view = view
        except AutotuneError as error:
            refused = refused_line(str(error)).replace("Not written.", "No picture.")
            self.sender.put(self.verdict, text=refused)
        self.saver.follow()
        self.sender.send()

    def _show_words(self, view: View, count: int) -> None:
        law = self.start.problem.controller(view.design)
        hand = law.damping_n_s_per_m + self._plant()["drag_n_s_per_m"]
        self.sender.put(self.verdict, text=words.verdict(view, count))
        # The positions of the sliders, for a page whose server ends before it answers the next one.
        positions = {name: slider.value for name, slider in self.sliders.items() if slider.visible}
        self.sender.put(self.facts, text=words.facts(view, axis_units(self.axis), hand), tags=[positions])

    def _prepare(self) -> PreparedView:
        scenario = scenario_at(self.start.problem, self._plant())
        key = self.axis, scenario
        if self.prepared is None or self.prepared[0] != key:
            self.prepared = key, prepare_view(self.start.problem, scenario, self.start.scenarios)
        return self.prepared[1]

    def _show_map(self, prepared: PreparedView, finer: int = 1) -> None:
        if not self.over.value:
            return
        x, y = str(self.over.value).split(",")
        problem, design = self.start.problem, self.designs[self.axis]
        values = dict(zip(problem.variables, design.tolist(), strict=True))
        if (
            self.window is None
            or (self.window.x, self.window.y) != (x, y)
            or not self.window.holds(values[x], values[y])
        ):
            self.window = build_window(problem, design, (x, y), columns=_COLUMNS, rows=_ROWS)
            self.figures.show_window(self.window, self.ranges[x], self.ranges[y])
        key = prepared.scenario, self.axis, self.window, tuple(v for name, v in values.items() if name not in {x, y})
        if self.mapped in {(key, _FINER), (key, finer)}:
            return
        self.figures.show_map(compute_map(prepared, design, self.window.finer(finer)), self.sender)
        self.mapped = key, finer
        if self.resting is not None:
            self.document.remove_timeout_callback(self.resting)
        self.resting = None if finer > 1 else self.document.add_timeout_callback(self._rest, _RESTS_MS)

    def _show_own(self, view: View) -> None:
        """Show what the design itself is, on the plants of the map: a cell is judged elsewhere than at the star."""
        if self.window is not None:
            x, y = (
                float(view.design[self.start.problem.variables.index(name)]) for name in (self.window.x, self.window.y)
            )
            self.figures.show_own(view, (x, y), self.window, self.sender)

    def _rest(self) -> None:
        self.resting = None
        if not self.asked:
            self._show_map(self._prepare(), _FINER)
            self._show_own(self.view)
            self.sender.send()

    def _axis_chosen(self, _name: str, _old: str, new: str) -> None:
        self.axis = new
        self._show_axis()

    def _map_chosen(self, _name: str, _old: str, _new: str) -> None:
        if not self.is_updating:
            self._ask()

    def _go_back(self) -> None:
        self.designs[self.axis] = np.array(self.start.design)
        self.plants[self.axis] = nominal_values(self.start.problem)
        self._set_sliders()
        self.update()


def build_page(exploration: Exploration, target: Target, document: Document) -> ExplorePage:
    """Fill a document with the page of an exploration; `target` is the file that it may write."""
    page = ExplorePage(exploration, target, document)
    for root in page.roots():
        document.add_root(root)
    gains = [name for name in page.sliders if name not in page.plants[page.axis]]
    document.title = f"autotune explore {exploration.path.name}"
    # A page whose server has gone says so and stops; a new server would know nothing of its designs.
    document.config.update(reconnect_session=False, notify_connection_status=False)
    document.js_on_event(DocumentReady, CustomJS(code="explore.begin()"))
    document.js_on_event(ConnectionLost, CustomJS(code="explore.end()"))
    document.template = _template()
    document.template_variables.update(
        gains=gains,
        plant=list(page.plants[page.axis]),
        figures=_descriptions(exploration),
        keys=KEYS,
        source=exploration.path.name,
    )
    document.template_variables.update(lines=page.figures.lines, script=_script())
    return page


def _descriptions(exploration: Exploration) -> dict[str, tuple[str, str]]:
    """Return, for each figure, its heading and what there is to see, for whoever cannot see it."""
    kinds = dict.fromkeys(axis_units(name).force_name for name in exploration.axes)
    return {
        "contact": (
            "Contact transient",
            f"{' or '.join(kinds).capitalize()} over time after the payload touches the surface.",
        ),
        "admittance": ("Free-space admittance", "Magnitude of G over frequency, with the least that is asked."),
        "nyquist": ("Nyquist", "Both open loops around −1, with the circle that the modulus margin asks for."),
        "requirements": ("Requirements", "Required over achieved of each requirement; up to 1 is met."),
        "map": ("Feasible designs", _MAP_CAPTION),
    }


@lru_cache(maxsize=1)
def _script() -> str:
    return (files("autotune.explore") / "explore.js").read_text("utf-8")


@lru_cache(maxsize=1)
def _template() -> Template:
    text = (files("autotune.explore") / "explore.html.jinja").read_text("utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(text)
