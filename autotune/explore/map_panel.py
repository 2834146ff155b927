"""The map of a page: a coarse one as soon as another is due, and finer ones while the hand rests."""

from collections.abc import Callable
from typing import Any

from bokeh.document import Document

from problems.arrays import FloatArray

from .design_map import DesignMap, MapRun, MapWindow, build_window
from .figures import Figures, Sender
from .sliders import SliderRange
from .view import PreparedView, View

# Few cells first: with the browser beside it, a hand sees the map of another plant within 50 ms.
_COLUMNS, _ROWS = 8, 6
# How many times as fine the map becomes in turn, and how long the hand rests before that.
_FINER_AFTER_MS = ((2, 60), (5, 350))
_LOOKS_MS = 15


class MapPanel:
    """Computes the map beside the page and shows it; `map` is the one that is shown.

    `begin` and `show` belong to one turn of a slider: what the page computes in between is computed meanwhile.
    """

    def __init__(self, document: Document, figures: Figures) -> None:
        self._document, self._figures = document, figures
        self.window: MapWindow | None = None
        self.map: DesignMap | None = None
        self._of: tuple[PreparedView, object] | None = None
        self._run: MapRun | None = None
        self._timer: Any = None
        self._refined = 0
        self._view: View | None = None

    def connect(self, sender: Sender) -> None:
        """Send pictures through `sender`."""
        self._sender = sender

    def begin_axis(self) -> None:
        """Forget the map of another axis."""
        self.stop()
        self.window = self.map = None

    def begin(
        self, prepared: PreparedView, design: FloatArray, pair: tuple[str, str], ranges: dict[str, SliderRange]
    ) -> None:
        """Begin the coarse map over two variables around a design (n,), if another one than the last is due."""
        x, y = pair
        values = dict(zip(prepared.problem.variables, design.tolist(), strict=True))
        window = self.window
        if window is None or (window.x, window.y) != pair or not window.holds(values[x], values[y]):
            window = build_window(prepared.problem, design, pair, columns=_COLUMNS, rows=_ROWS)
            self._figures.show_window(window, ranges[x], ranges[y])
        key = window, tuple(value for name, value in values.items() if name not in pair)
        self.window = window
        if self._of is not None and self._of[0] is prepared and self._of[1] == key:
            return
        self.stop()
        self._of, self._design, self._refined = (prepared, key), design.copy(), 0
        self._run = MapRun(prepared.screen, self._design, window)

    def show(self, view: View) -> None:
        """Show the coarse map that was begun, and the view's design in it."""
        self._view = view
        if self._run is not None and self._refined == 0:
            self._finish(self._run)
        self._show_own()

    def stop(self) -> None:
        """Show nothing that is still to come of the present map."""
        if self._timer is not None:
            self._document.remove_timeout_callback(self._timer)
        if self._run is not None:
            self._run.cancel()
        self._timer = self._run = self._of = None

    def refine(self) -> None:
        """Begin the next finer map, which is shown once it is there."""
        if self._of is None or self.window is None:
            return
        factor, _ = _FINER_AFTER_MS[self._refined]
        self._refined += 1
        self._run = MapRun(self._of[0].screen, self._design, self.window.finer(factor))
        self.look()

    def look(self) -> None:
        """Show the finer map if it is there, and look again soon if not."""
        if self._run is None:
            return
        if not self._run.is_done:
            self._after(_LOOKS_MS, self.look)
            return
        self._finish(self._run)
        self._show_own()
        self._sender.send()

    def _finish(self, run: MapRun) -> None:
        self._run = self._timer = None
        self.map = run.collect()
        self._figures.show_map(self.map, self._sender)
        if self._refined < len(_FINER_AFTER_MS):
            self._after(_FINER_AFTER_MS[self._refined][1], self.refine)

    def _after(self, waits_ms: int, call: Callable[[], None]) -> None:
        """Call later, unless `stop` comes first: one that is due may wait for the document and be called after it."""

        def due() -> None:
            if self._timer is timer:
                self._timer = None
                call()

        timer = self._timer = self._document.add_timeout_callback(due, waits_ms)

    def _show_own(self) -> None:
        """Show what the design itself is, on the plants of the map: a cell is judged elsewhere than at the star."""
        if self.window is not None and self._view is not None:
            design, names = self._view.design, self._view.variables
            x, y = (float(design[names.index(name)]) for name in (self.window.x, self.window.y))
            self._figures.show_own(self._view, (x, y), self.window.finer(2), self._sender)
