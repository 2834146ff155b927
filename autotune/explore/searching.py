"""Search from the present design beside the page: a button that begins and cancels, and its progress."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bokeh.document import Document
from bokeh.models.widgets import Button, Div

from autotune.tuning.search import SearchResult, solve_design
from problems.arrays import FloatArray
from problems.design.problem import DesignProblem
from problems.errors import AutotuneError

from .saving import run_in_thread
from .words import line

_LABEL = "Optimize from here"
# How often progress is shown.
_EVERY_S = 0.25


class SearchCancelledError(AutotuneError):
    """The search was cancelled on the page."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTask:
    """What is searched: the problem of an axis, from a design (n,) on."""

    axis: str
    problem: DesignProblem
    design: FloatArray


class Searcher:
    """One search at a time, seeded: `ask` says of what, `done` gets what was found.

    `status` says how the gains were last moved other than by hand. The search runs in a thread, which is left to
    itself when the server ends.
    """

    def __init__(
        self,
        document: Document,
        look: Mapping[str, Any],
        ask: Callable[[], SearchTask],
        done: Callable[[SearchTask, SearchResult], str],
    ) -> None:
        """Prepare the button; `done` returns what to say of the result, in one sentence."""
        self._document, self._ask, self._done = document, ask, done
        self.button = Button(label=_LABEL, name="search", button_type="default", **look)
        self.status = Div(name="moved", visible=False, **look)
        self._cancelled: threading.Event | None = None
        self.button.on_click(self._clicked)

    def say(self, text: str) -> None:
        """Show a line, unless a search is under way, which has the place."""
        if self._cancelled is None:
            self._show(text)

    def _show(self, text: str) -> None:
        if self.status.text != text:
            self.status.update(text=text, visible=bool(text))

    def forget(self) -> None:
        """Take away what is said of other gains than the present ones."""
        self.say("")

    def cancel(self) -> None:
        """Let a search that is under way end at its next step."""
        if self._cancelled is not None:
            self._cancelled.set()

    def _clicked(self) -> None:
        if self._cancelled is not None:
            self.cancel()
            self.button.label = "Cancelling …"
            return
        self._cancelled = threading.Event()
        self.button.label = "Cancel the search (0 %)"
        self._show(line("quiet busy", "Searching over the whole set, from the present design …"))
        # Bokeh awaits what a callback returns; its types do not say so.
        self._document.add_next_tick_callback(self.search)  # type: ignore[arg-type]

    async def search(self) -> None:
        """Search beside the event loop, and hand over what was found."""
        task, cancelled = self._ask(), self._cancelled or threading.Event()
        try:
            found = await run_in_thread(
                lambda: solve_design(task.problem, start=task.design, progress=self._progress(cancelled))
            )
            if cancelled.is_set():
                raise SearchCancelledError
            message = line("good", self._done(task, found))
        except SearchCancelledError:
            message = line("quiet", "The search was cancelled; the gains are as they were.")
        except AutotuneError as error:
            message = line("bad", f"Nothing found. {error}")
        finally:
            self._cancelled, self.button.label = None, _LABEL
        self._show(message)

    def _progress(self, cancelled: threading.Event) -> Callable[[float], None]:
        """Return the progress callback of the search; it raises SearchCancelledError once it is cancelled."""
        share, shown_at = 0.0, time.monotonic()

        def show() -> None:
            if self._cancelled is not None and not self._cancelled.is_set():
                self.button.label = f"Cancel the search ({100.0 * share:.0f} %)"

        def progress(more: float) -> None:
            nonlocal share, shown_at
            if cancelled.is_set():
                raise SearchCancelledError
            share = min(share + more, 1.0)
            if time.monotonic() - shown_at > _EVERY_S:
                shown_at = time.monotonic()
                self._document.add_next_tick_callback(show)

        return progress
