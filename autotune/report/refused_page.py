"""The page of what was refused: the verdict, the reason, and what could be read all the same."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from autotune.errors import AutotuneError, CertificateError, InfeasibleError
from autotune.formats.canonical import checksum, short
from autotune.formats.identified import IdentifiedFile
from autotune.formats.yaml12 import load_document
from identification.errors import LogError
from identification.logs.containers.formats import digests
from identification.logs.read import read_recording
from identification.signals.recording import Recording

from .identify_page import health_blocks, summaries_of
from .page import Block, Fact, Facts, Note, Page, Section, Tone, build_table
from .sensor_charts import logged_charts

if TYPE_CHECKING:
    from autotune.pipeline import IdentifyOptions


NOT_IDENTIFIED = "NOT identified"
NOT_VALID = "NOT valid"
NO_CONTROLLER = "NO controller"
VALID_NOT_COMPARED = "valid, NOT compared"
NOT_PREDICTED = "NOT predicted"
NOT_SHOWN = "NOT shown"


def refuse(
    verdict: str,
    error: Exception,
    page: Page | None = None,
    *,
    facts: Sequence[Fact] = (),
    blocks: Sequence[Block] = (),
    tone: Tone = "bad",
) -> Page:
    """Return a page that begins with `verdict` in large type and the sentence of `error`, then what `page` shows.

    `facts` are beside the verdict, `blocks` below the sentence; `tone` says how grave it is.
    """
    sentence = " ".join(str(error).split())
    large = Fact(label="outcome", value=verdict, tone=tone, is_large=True)
    kind = "error" if tone == "bad" else "not done"
    whole = (Facts(facts=(large, *facts)), Note(text=sentence, kind=kind, tone=tone), *blocks)
    section = Section(key="refusal", title="Outcome", blocks=whole)
    rest = () if page is None else page.sections
    return Page(
        title=verdict if page is None else page.title,
        lead=f"{verdict}: {sentence}",
        tone=tone,
        sections=(section, *rest),
        footer="" if page is None else page.footer,
    )


def refused_estimate_page(error: Exception, page: Page) -> Page:
    """Return the page of logs that do not identify every parameter: what `identify` shows, below what is missing."""
    return refuse(NOT_IDENTIFIED, error, replace(page, title="The log does not identify every parameter"))


def refused_log_page(error: Exception, logs: Sequence[Path], options: "IdentifyOptions") -> Page:
    """Return the page of logs of which nothing was identified: their health, and the wrench where it can be read."""
    summaries = summaries_of(logs, options)
    blocks: list[Block] = list(health_blocks(summaries))
    blocks += [Note(text=sentence, kind="missing", tone="bad") for each in summaries for sentence in each.missing]
    read = _readable(logs, options)
    blocks += [] if read is None else logged_charts(read)
    section = Section(key="log", title="The log", blocks=tuple(blocks))
    sections = (section,) if blocks else ()
    return refuse(NOT_IDENTIFIED, error, Page(title="The log cannot be used", lead="", sections=sections))


def _readable(logs: Sequence[Path], options: "IdentifyOptions") -> Recording | None:
    try:
        return read_recording(tuple(logs), options.declared(), salvage=options.salvage, span=options.span)
    except AutotuneError:
        # Why it cannot be read is what the page says already.
        return None


def refused_controller_page(error: Exception, path: Path) -> Page:
    """Return the page of a controller file that was refused: its name, and the checksum beside that of its content."""
    try:
        tree = load_document(path, error=CertificateError).tree
        stated, found = str(tree.get("checksum", "none")), checksum(tree)
    except AutotuneError:
        facts = [Fact(label="file", value=path.name)]
    else:
        facts = [
            Fact(label="file", value=path.name),
            Fact(label="the file says", value=short(stated), detail=stated, is_large=True),
            Fact(
                label="its content has",
                value=short(found),
                detail=found,
                tone="good" if stated == found else "bad",
                is_large=True,
            ),
        ]
    page = Page(title="A controller that must not be used", lead="", sections=(), footer=_digest(path))
    return refuse(NOT_VALID, error, page, facts=facts)


def _digest(path: Path) -> str:
    try:
        return ", ".join(f"{name} (sha256 {digest[:12]}…)" for name, digest in digests([path]).items())
    except (LogError, OSError):
        return str(path)


def refused_search_page(error: Exception, plant: IdentifiedFile | None) -> Page:
    """Return the page of a search without a controller: what would have to be eased, and the plant it was asked for."""
    facts, footer = [], ""
    if plant is not None:
        facts = [Fact(label="plant", value=plant.path.name, detail=f"axes {', '.join(plant.result.axes)}")]
        footer = f"from {plant.path} (sha256 {plant.sha256[:12]}…)"
    eased = error.relaxations if isinstance(error, InfeasibleError) else ()
    rows = [(name, f"{required:g}", f"{possible:.4g}") for name, required, possible in eased]
    caption = "One of these, eased alone, would be enough (units of problem.yaml)"
    table = build_table(caption, ("requirement", "asked", "possible"), rows, numbers=(1, 2))
    page = Page(title="No controller was written", lead="", sections=(), footer=footer)
    return refuse(NO_CONTROLLER, error, page, facts=facts, blocks=(table,) if rows else ())
