"""The part of the page that saves: a button, what it would replace, and what became of the last save."""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from bokeh.document import Document
from bokeh.models.widgets import Button, Div
from numpy.typing import NDArray

from autotune.formats.records import ROTATIONAL_AXES
from problems.errors import AutotuneError

from . import words
from .batched_update import Sender
from .save import save_controller
from .source import Exploration
from .target import Target

FloatArray = NDArray[np.float64]
Designs = Mapping[str, FloatArray]
_Result = TypeVar("_Result")


class Saver:
    """Save the designs of a page, and never let words about one design stand beside another.

    `status` tells what became of the last save, `held` what the next one replaces.
    """

    def __init__(
        self, exploration: Exploration, target: Target, document: Document, designs: Designs, look: Mapping[str, Any]
    ) -> None:
        """Prepare to save `designs`, which the page goes on changing; `look` is how widgets look."""
        self._exploration, self._target, self._document, self._designs = exploration, target, document, designs
        self.button = Button(label=f"Validate and save {target.path.name}", name="save", button_type="default", **look)
        self.status, self.held = Div(name="status", **look), Div(name="held", **look)
        self._expected = target.standing()
        self.held.text = words.held_line(target.path, self._expected)
        self._told = ""
        self._of: Designs | None = None
        self._is_busy = False
        self.button.on_click(self._asked)

    def connect(self, sender: Sender) -> None:
        """Send words through `sender`, as all that changes."""
        self._sender = sender

    def tell(self, line: str, of: Designs | None = None) -> None:
        """Put a line on the page, which is about the designs `of`, or about none."""
        self._told, self._of = line, of
        self.follow()

    def note(self, text: str) -> None:
        """Put a remark on the page, unless it has to tell of a save, which is one of all axes."""
        if self._of is None:
            self.tell(words.plain_line(text))

    def follow(self) -> None:
        """Say of a line about other designs than the present ones that it is so."""
        of = self._of
        is_earlier = of is not None and any(not np.array_equal(of[name], now) for name, now in self._designs.items())
        self._sender.put(self.status, text=words.earlier_line(self._told) if is_earlier else self._told)

    def _snapshot(self) -> dict[str, FloatArray]:
        return {name: np.array(design) for name, design in self._designs.items()}

    def _asked(self) -> None:
        if not self._is_busy:
            self._is_busy = True
            self.tell(words.BUSY)
            self._sender.send()
            # Bokeh awaits what a callback returns; its types do not say so.
            self._document.add_next_tick_callback(self.save)  # type: ignore[arg-type]

    async def save(self) -> None:
        """Save beside the event loop, so that the connection stays alive; the page waits for the answer."""
        designs, expected = self._snapshot(), self._expected
        try:
            saved = await _beside(lambda: save_controller(self._exploration, designs, self._target, expected))
            first = "N·m" if set(designs) <= ROTATIONAL_AXES else "N"
            self.tell(words.saved_line(saved, first), designs)
        except AutotuneError as error:
            self.tell(words.refused_line(str(error)), designs)
        finally:
            self._is_busy = False
        self._expected = self._target.standing()
        self._sender.put(self.held, text=words.held_line(self._target.path, self._expected))
        self._sender.send()


async def _beside(work: Callable[[], _Result]) -> _Result:
    """Run `work` in a thread that nobody waits for at the end of the process, and return what it returns."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[_Result] = loop.create_future()

    def answer(settle: Callable[[Any], None], value: object) -> None:
        if not future.done():
            settle(value)

    def run() -> None:
        # Where the loop is closed already, nobody wants the answer.
        with contextlib.suppress(RuntimeError):
            try:
                result = work()
            except Exception as error:  # noqa: BLE001 - raised again where it is awaited
                loop.call_soon_threadsafe(answer, future.set_exception, error)
            else:
                loop.call_soon_threadsafe(answer, future.set_result, result)

    threading.Thread(target=run, name="save", daemon=True).start()
    return await future
