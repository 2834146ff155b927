"""Save a manual design: prove, validate and write the one file that the page may write, and report the outcome."""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from bokeh.document import Document
from bokeh.models.widgets import Button, Div

from autotune.errors import AutotuneError, CertificateError, InfeasibleError, UsageError
from autotune.formats.canonical import dump_yaml, place_to_paste, short
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.formats.units import ROTATIONAL_AXES
from autotune.tuning.compare import judge_design
from autotune.tuning.coupled import TogetherCheck
from autotune.tuning.optimize import certify
from autotune.tuning.search import SearchResult
from autotune.validation.axis_proof import ProofOptions
from problems.arrays import FloatArray
from problems.design.requirements import Requirements
from problems.progress import Progress

from .figures import Sender
from .source import ASKED_BY_HAND, Exploration, keep_deadband
from .words import line, plain_line

Designs = Mapping[str, FloatArray]
Asked = Mapping[str, Requirements]
_Result = TypeVar("_Result")

BUSY = '<p class="quiet busy">Judging the design over the whole set, proving, validating …</p>'


class SaveInterruptedError(AutotuneError):
    """The server ended before the controller was written, so it is not written."""


@dataclass(frozen=True, kw_only=True)
class Written:
    """What was written: the short form of its checksum, and what it replaced, "" where there was no file."""

    checksum: str
    replaced: str


class Target:
    """A file, what is in it, and whether it may still be written.

    Several pages may save at once, each in a thread of its own: one writes at a time, and none after `end`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_cut_short = False
        self._lock = threading.Lock()
        self._has_ended = False
        self._under_way = 0

    def existing(self) -> str:
        """Return which file is there now, in a few words; "" for none."""
        if not self.path.is_file():
            return ""
        try:
            found = read_controller(self.path, allow_unvalidated=True)
        except (CertificateError, UsageError):
            return "a file that is no whole controller"
        return f"the controller of checksum {short(found.checksum)}"

    def save(self, make: Callable[[Progress], Controller], expected: str | None = None) -> Written:
        """Write the controller that `make` returns, which is given a `progress` that stops it once the server ends.

        Raises SaveInterruptedError after `end`; UsageError where the file cannot be written, or where other than
        `expected` (a text of `existing`) is there by now; what `make` raises. Nothing is written then.
        """
        with self._lock:
            self._under_way += 1
        try:
            controller = make(self._progress)
        except BaseException:
            with self._lock:
                self._under_way -= 1
            raise
        # Under the lock, so that `end` comes before the whole of this or after it.
        with self._lock:
            self._under_way -= 1
            self._progress(0.0)
            existing = self.existing()
            if expected is not None and existing != expected:
                raise UsageError(
                    f"{self.path} has changed meanwhile: it was {expected or 'not there'}, now it is "
                    f"{existing or 'not there'}. Save again to write it all the same."
                )
            return Written(checksum=short(write_controller(self.path, controller)), replaced=existing)

    def end(self) -> None:
        """Let nothing be written from now on; `is_cut_short` then says whether something would have been."""
        with self._lock:
            if not self._has_ended:
                self._has_ended, self.is_cut_short = True, self._under_way > 0

    def _progress(self, _share: float) -> None:
        if self._has_ended:
            raise SaveInterruptedError(f"The server has ended, so {self.path} is not written.")


@dataclass(frozen=True, kw_only=True)
class Saved:
    """What was written: the file, the short form of its checksum, the worst peak of each axis [N], checks passed.

    `replaced` says which file was there before, "" for none.
    """

    path: Path
    checksum: str
    replaced: str
    peak_n: Mapping[str, float]
    checks: int


def save_controller(
    exploration: Exploration, designs: Mapping[str, FloatArray], target: Target, expected: str | None = None
) -> Saved:
    """Judge a design (n,) of every axis over the whole uncertainty, prove, validate, and write `controller.yaml`.

    `expected` is what the page says is there (`Target.existing`). Raises InfeasibleError for a design that misses
    something, CertificateError for a claim that cannot be proved or verified, UsageError where the file cannot be
    written or is no longer the expected one, SaveInterruptedError once the target has ended; nothing is written then.
    """
    searches: dict[str, SearchResult] = {}
    checks = 0

    def make(progress: Progress) -> Controller:
        nonlocal checks
        for name, start in exploration.axes.items():
            try:
                searches[name] = judge_design(start.problem, designs[name])
            except InfeasibleError as error:
                raise InfeasibleError(f"Axis {name}: {error}") from error
            progress(0.0)
        asked = exploration.together
        controller, report = certify(
            searches,
            exploration.payload,
            exploration.provenance,
            ProofOptions(),
            progress,
            strategies=exploration.strategies,
            together=None if asked is None else TogetherCheck(asked, ProofOptions()),
        )
        checks = len(report.checks)
        return keep_deadband(exploration, controller)

    written = target.save(make, expected)
    return Saved(
        path=target.path,
        checksum=written.checksum,
        replaced=written.replaced,
        peak_n={name: search.evaluation.objective_cost for name, search in searches.items()},
        checks=checks,
    )


class Saver:
    """Save the designs of a page, and show beside a design no outcome of another one.

    `status` is the outcome of the last save, `held` what the next one replaces.
    """

    def __init__(
        self,
        present: Callable[[], Exploration],
        target: Target,
        document: Document,
        designs: Designs,
        look: Mapping[str, Any],
    ) -> None:
        """Prepare to save `designs`, which the page goes on changing, for what `present` then returns.

        `look` is how widgets look.
        """
        self._present, self._target, self._document, self._designs = present, target, document, designs
        self.button = Button(label=f"Validate and save {target.path.name}", name="save", button_type="default", **look)
        self.status, self.held = Div(name="status", **look), Div(name="held", **look)
        self._expected = target.existing()
        self.held.text = held_line(target.path, self._expected)
        self._text = ""
        self._of: tuple[Designs, Asked] | None = None
        self._is_busy = False
        self.button.on_click(self._asked)

    def connect(self, sender: Sender) -> None:
        """Send texts through `sender`, like everything that changes."""
        self._sender = sender

    def show(self, text: str, of: Designs | None = None) -> None:
        """Put a line on the page, which is about the designs `of` and what is asked now, or about none."""
        self._text, self._of = text, None if of is None else (of, asked_of_axes(self._present()))
        self.follow()

    def note(self, text: str) -> None:
        """Put a remark on the page, unless the outcome of a save is there, which is one of all axes."""
        if self._of is None:
            self.show(plain_line(text))

    def follow(self) -> None:
        """Say of a line about other designs than the present ones that it is so."""
        is_earlier = False
        if self._of is not None:
            designs, asked = self._of
            is_earlier = asked != asked_of_axes(self._present())
            is_earlier |= any(not np.array_equal(designs[name], now) for name, now in self._designs.items())
        self._sender.put(self.status, text=earlier_line(self._text) if is_earlier else self._text)

    def _snapshot(self) -> dict[str, FloatArray]:
        return {name: np.array(design) for name, design in self._designs.items()}

    def _asked(self) -> None:
        if not self._is_busy:
            self._is_busy = True
            self.show(BUSY)
            self._sender.send()
            # Bokeh awaits what a callback returns; its types do not say so.
            self._document.add_next_tick_callback(self.save)  # type: ignore[arg-type]

    async def save(self) -> None:
        """Save beside the event loop, so that the connection stays alive; the page waits for the answer."""
        designs, exploration, expected = self._snapshot(), self._present(), self._expected
        try:
            saved = await run_in_thread(lambda: save_controller(exploration, designs, self._target, expected))
            first = "N·m" if set(designs) <= ROTATIONAL_AXES else "N"
            text = saved_line(saved, first) + changed_lines(exploration)
        except AutotuneError as error:
            text = refused_line(str(error))
        finally:
            self._is_busy = False
        self.show(text, designs)
        # What was asked when the button was pressed, whatever was turned meanwhile.
        self._of = designs, asked_of_axes(exploration)
        self.follow()
        self._expected = self._target.existing()
        self._sender.put(self.held, text=held_line(self._target.path, self._expected))
        self._sender.send()


def asked_of_axes(exploration: Exploration) -> dict[str, Requirements]:
    """Return what is asked on every axis."""
    return {name: start.problem.requirements for name, start in exploration.axes.items()}


async def run_in_thread(work: Callable[[], _Result]) -> _Result:
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

    threading.Thread(target=run, name="beside the page", daemon=True).start()
    return await future


def saved_line(saved: Saved, force: str) -> str:
    """Say what was written."""
    peaks = ", ".join(f"{name} {value:.4g} {force}" for name, value in saved.peak_n.items())
    replaced = f", in place of {saved.replaced}" if saved.replaced else ""
    return line(
        "good",
        f"Validated ({saved.checks} checks) and written: {saved.path}, checksum {saved.checksum}{replaced}. "
        f"Worst peak: {peaks}.",
    )


def changed_lines(exploration: Exploration) -> str:
    """Return what was asked by hand as lines for problem.yaml; "" where nothing was."""
    asked = exploration.provenance["options"].get(ASKED_BY_HAND)
    if asked is None:
        return ""
    notice = plain_line(
        "Its certificate states what is asked here, which differs from the file. In problem.yaml "
        f"{place_to_paste(asked)}:"
    )
    return f"{notice}<pre>{escape(dump_yaml(asked))}</pre>"


def held_line(path: Path, existing: str) -> str:
    """Say what saving to `path` replaces; `existing` is what is there, "" for nothing."""
    return plain_line(f"Replaces {path}, {existing}." if existing else f"Writes {path}, which does not exist yet.")


def earlier_line(text: str) -> str:
    """Return a line with the remark that it is about another design than the present one."""
    return f'<div class="earlier">{plain_line("Of an earlier design:")}{text}</div>'


def refused_line(reason: str) -> str:
    """Say why nothing was written."""
    return line("bad", f"Not written. {reason}")
