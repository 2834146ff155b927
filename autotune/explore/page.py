"""Build the page: sliders and figures, computed again when a slider moves."""

from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.models import CustomJS, CustomJSTickFormatter, InlineStyleSheet
from bokeh.models.widgets import Button, Div, Select, Slider
from jinja2 import Environment, StrictUndefined, Template

from autotune.charts.palette import dark_colours
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.tuning.search import SearchResult
from problems.arrays import FloatArray
from problems.design.problem import DesignProblem
from problems.errors import AutotuneError

from . import words
from .design_map import map_pairs
from .figures import KEYS, Figures, Sender
from .kept import Keeper
from .map_panel import MapPanel
from .saving import Saver, Target, refused_line
from .searching import Searcher, SearchTask
from .sliders import (
    ASKED,
    STEPS,
    SliderRange,
    build_gain_sliders,
    build_plant_sliders,
    build_requirement_sliders,
    nominal_values,
    requirements_at,
    scenario_at,
    shown_thresholds,
)
from .source import AxisStart, Exploration, with_requirements, worst_few
from .view import (
    PreparedView,
    View,
    compute_view,
    find_way_back,
    prepare_view,
)

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
.bk-slider-value { display: none; }
.bk-clearfix:empty { display: none !important; }
.noUi-target { background: var(--pale); border-color: var(--line); box-shadow: none; }
.noUi-connect { background-color: var(--filled) !important; }
.noUi-handle { background: var(--handle); border-color: var(--soft); box-shadow: none; }
:host, .bk-clearfix { min-width: 0; max-width: 100%; }
.table { overflow-x: auto; } table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th { color: var(--soft); font-weight: normal; text-align: right; white-space: nowrap; }
th, td { padding: 0.1rem 0.6rem 0.1rem 0; }
td { text-align: right; white-space: nowrap; }
td button { min-width: 1.8rem; color: var(--ink); background: var(--pale); border: 1px solid var(--line);
  border-radius: 0.25rem; font: inherit; cursor: pointer; }
pre { margin: 0.2rem 0; overflow-x: auto; font-size: 0.85rem; }
.bk-slider-title, label { color: var(--ink); font-size: 0.85rem; }
select.bk-input { color: var(--ink); background-color: var(--pale); border-color: var(--line); }
.bk-btn { color: var(--ink); background: var(--pale); border-color: var(--line); white-space: normal; }
.bk-btn:hover:not([disabled]) { color: var(--ink); background: var(--line); border-color: var(--soft); }
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
        kinds: dict[bool, dict[str, float]] = {}
        # Axes of a kind share what is asked, as they do in a certificate.
        self.asked_now = {
            name: kinds.setdefault(name in ROTATIONAL_AXES, shown_thresholds(start.problem.requirements))
            for name, start in exploration.axes.items()
        }
        self.scenarios = {name: start.scenarios for name, start in exploration.axes.items()}
        self.figures = Figures()
        self.ranges: dict[str, SliderRange] = {}
        self.map_panel = MapPanel(document, self.figures)
        self.prepared: tuple[object, PreparedView] | None = None
        self.limits: object = None
        self.asked = self.is_updating = False
        look: dict[str, Any] = {"sizing_mode": "stretch_width", "stylesheets": [InlineStyleSheet(css=_STYLE)]}
        self._build_widgets(look)
        self.saver = Saver(self.present, target, document, self.designs, look)
        self.searcher = Searcher(document, look, self._search_task, self._found)
        self.keeper = Keeper(look, self._take, self.update)
        changing = [self.verdict, self.facts, self.saver.status, self.saver.held, self.way_back, self.keeper.table]
        self.sender = Sender(document, [*self.figures.changing(), *changing], self.verdict)
        self.saver.connect(self.sender)
        self.map_panel.connect(self.sender)
        self._show_axis()

    @property
    def start(self) -> AxisStart:
        """The axis that is shown, as it began."""
        return self.exploration.axes[self.axis]

    @property
    def problem(self) -> DesignProblem:
        """The problem of the axis that is shown, under the requirements that are set."""
        return self._problem(self.axis)

    def _problem(self, axis: str) -> DesignProblem:
        problem = self.exploration.axes[axis].problem
        asked = requirements_at(problem.requirements, self.asked_now[axis])
        return problem if asked == problem.requirements else replace(problem, requirements=asked)

    def present(self) -> Exploration:
        """Return the exploration under the requirements that are set."""
        asked = {name: self._problem(name).requirements for name in self.exploration.axes}
        return with_requirements(self.exploration, asked)

    def _build_widgets(self, look: dict[str, Any]) -> None:
        names = {span.name: span for axis, start in self.exploration.axes.items() for span in _spans(start, axis)}
        self.sliders = {name: Slider(start=0.0, end=1.0, value=0.0, step=0.01, name=name, **look) for name in names}
        for slider in self.sliders.values():
            slider.on_change("value", self._slider_moved)
        self.verdict, self.facts = (Div(name=key, **look) for key in ("verdict", "facts"))
        labels = {"back": "Back to the start", "keep": "Keep this design", "way-back": "To the nearest feasible design"}
        self.back, self.keep, self.way_back = (
            Button(label=label, name=name, button_type="default", **look) for name, label in labels.items()
        )
        axes: Any = list(self.exploration.axes)
        self.choice = Select(title="Axis", name="axis", value=self.axis, options=axes, **look)
        self.over = Select(title="Map over", name="over", **look)
        self.back.on_click(self._go_back)
        self.keep.on_click(self._keep)
        self.way_back.on_click(self._go_to_feasible)
        self.choice.on_change("value", self._axis_chosen)
        self.over.on_change("value", self._map_chosen)

    def roots(self) -> list[Any]:
        """Return everything that the page places by its name."""
        saving = [self.saver.status, self.saver.button, self.saver.held]
        widgets = [self.verdict, self.facts, self.back, self.keep, self.way_back, self.choice, self.over]
        moving = [self.searcher.button, self.searcher.status, self.keeper.table]
        return [*saving, *widgets, *moving, *self.sliders.values(), *self.figures.plots.values()]

    def _show_axis(self) -> None:
        problem = self.start.problem
        self.ranges = {span.name: span for span in _spans(self.start, self.axis)}
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
        self.map_panel.begin_axis()
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
            # What a number that is typed beside it means.
            scale = {"logarithmic": span.logarithmic, "low": span.scale * span.low, "high": span.scale * span.high}
            slider.update(title=span.title, start=low, end=high, step=(high - low) / STEPS, format=form, tags=[scale])
        self.is_updating = False

    def _set_sliders(self) -> None:
        gains = dict(zip(self.start.problem.variables, self.designs[self.axis], strict=True))
        values = {**gains, **self._plant(), **self.asked_now[self.axis]}
        self.is_updating = True
        for name, value in values.items():
            if name in self.ranges and self.sliders[name].visible:
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
        asked = self.asked_now[self.axis]
        for name in asked:
            if name in self.ranges:
                asked[name] = self.ranges[name].value(float(self.sliders[name].value))
        self.searcher.forget()
        self.update()

    def update(self) -> None:
        """Compute and show the view of the present design and plant, and the map if another one is due."""
        try:
            prepared = self._prepare()
            if self.over.value:
                x, y = str(self.over.value).split(",")
                self.map_panel.begin(prepared, self.designs[self.axis], (x, y), self.ranges)
            view = compute_view(prepared, self.designs[self.axis])
            # The map comes first: what is sent first is drawn first.
            self.map_panel.show(view)
            self._show_limits(prepared)
            self.figures.show(view, self.sender)
            self._show_words(view, len(prepared.scenarios))
            self._show_kept(prepared)
            self.sender.put(self.way_back, visible=not view.evaluation.is_feasible)
        except AutotuneError as error:
            refused = refused_line(str(error)).replace("Not written.", "No picture.")
            self.sender.put(self.verdict, text=refused)
        self.saver.follow()
        self.sender.send()

    def _show_limits(self, prepared: PreparedView) -> None:
        asked = prepared.problem.requirements
        if self.limits != (self.axis, asked):
            self.limits = self.axis, asked
            self.figures.show_limits(asked, self.sender)

    def _show_kept(self, prepared: PreparedView) -> None:
        gains = build_gain_sliders(self.start.problem, self.axis)
        views = self.keeper.follow(self.axis, prepared, gains, axis_units(self.axis), self.sender)
        if views is not None:
            self.figures.show_kept(views, self.sender)

    def _show_words(self, view: View, count: int) -> None:
        law = self.start.problem.controller(view.design)
        hand = law.damping_n_s_per_m + self._plant()["drag_n_s_per_m"]
        self.sender.put(self.verdict, text=words.verdict(view, count))
        # The positions of the sliders, for a page whose server ends before it answers the next one.
        positions = {name: slider.value for name, slider in self.sliders.items() if slider.visible}
        self.sender.put(self.facts, text=words.facts(view, axis_units(self.axis), hand), tags=[positions])

    def _prepare(self) -> PreparedView:
        problem, scenarios = self.problem, self.scenarios[self.axis]
        scenario = scenario_at(problem, self._plant())
        key = self.axis, scenario, problem.requirements, scenarios
        if self.prepared is None or self.prepared[0] != key:
            self.prepared = key, prepare_view(problem, scenario, scenarios)
        return self.prepared[1]

    def _axis_chosen(self, _name: str, _old: str, new: str) -> None:
        self.axis = new
        self._show_axis()

    def _map_chosen(self, _name: str, _old: str, _new: str) -> None:
        if not self.is_updating:
            self._ask()

    def _go_back(self) -> None:
        self.designs[self.axis] = np.array(self.start.design)
        self.plants[self.axis] = nominal_values(self.start.problem)
        self.asked_now[self.axis].update(shown_thresholds(self.start.problem.requirements))
        self.searcher.forget()
        self._set_sliders()
        self.update()

    def _take(self, design: FloatArray) -> None:
        """Show another design of the axis."""
        self.designs[self.axis] = np.array(design)
        self.searcher.forget()
        self._set_sliders()
        self.update()

    def end(self) -> None:
        """End what is under way: nobody looks any more."""
        self.searcher.cancel()
        self.map_panel.stop()

    def _keep(self) -> None:
        self.searcher.say(words.plain_line(self.keeper.keep(self.axis, self.designs[self.axis])))
        self.update()

    def _go_to_feasible(self) -> None:
        prepared, design = self._prepare(), self.designs[self.axis]
        found = find_way_back(prepared, design, self.start.design, self.map_panel.map)
        if found is None:
            warning = (
                "Neither the way to the start nor the map has a design that meets everything: search, or ask for less."
            )
            self.searcher.say(words.line("warn", warning))
            return
        self._take(found.design)
        self.searcher.say(words.line("good", f"Moved to {found.found}."))

    def _search_task(self) -> SearchTask:
        return SearchTask(axis=self.axis, problem=self.problem, design=np.array(self.designs[self.axis]))

    def _found(self, task: SearchTask, found: SearchResult) -> str:
        """Take what a search found, unless something else is asked by now; return what to say of it."""
        if self._problem(task.axis) != task.problem:
            return "Other requirements are set by now, so what was found for the earlier ones is not taken."
        self.designs[task.axis] = np.array(found.design)
        # What the search found worst belongs to what is looked at.
        self.scenarios[task.axis] = tuple(dict.fromkeys((*self.scenarios[task.axis], *worst_few(found))))
        if task.axis == self.axis:
            self._take(found.design)
        force = axis_units(task.axis).force
        return (
            f"Axis {task.axis}: {found.evaluation.objective_cost:.4g} {force} in the worst case over the whole set, "
            f"the best of {found.evaluations} designs (seed 0)."
        )


def _spans(start: AxisStart, axis: str) -> tuple[SliderRange, ...]:
    """Return the ranges of all sliders of an axis: gains, plant, requirements."""
    problem = start.problem
    gains, plant = build_gain_sliders(problem, axis), build_plant_sliders(problem, axis)
    return (*gains, *plant, *build_requirement_sliders(problem.requirements, axis))


def build_page(exploration: Exploration, target: Target, document: Document) -> ExplorePage:
    """Fill a document with the page of an exploration; `target` is the file that it may write."""
    page = ExplorePage(exploration, target, document)
    for root in page.roots():
        document.add_root(root)
    asked = [name for name in page.sliders if name.startswith(ASKED)]
    gains = [name for name in page.sliders if name not in {*page.plants[page.axis], *asked}]
    document.on_session_destroyed(lambda _context: page.end())
    document.title = f"autotune explore {exploration.path.name}"
    # A page whose server has gone says so and stops; a new server would know nothing of its designs.
    document.config.update(reconnect_session=False, notify_connection_status=False)
    document.js_on_event(DocumentReady, CustomJS(code="explore.begin()"))
    document.js_on_event(ConnectionLost, CustomJS(code="explore.end()"))
    document.template = _template()
    document.template_variables.update(
        gains=gains,
        asked=asked,
        plant=list(page.plants[page.axis]),
        figures=_descriptions(exploration),
        keys=KEYS,
        source=exploration.path.name,
    )
    document.template_variables.update(lines=page.figures.lines, script=_script(), dark_colours=dark_colours())
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
