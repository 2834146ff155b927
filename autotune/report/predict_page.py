"""The page of a prediction: one contact with its interval, or the contacts of a log beside what was measured."""

from autotune.prediction.against_touches import TouchComparison
from autotune.prediction.result import PredictedContact

from .page import Block, Note, Page, Section, build_table


def build_predict_page(found: PredictedContact | TouchComparison) -> Page:
    """Build the report of a prediction."""
    headline, tables, notes = found.parts()
    blocks: list[Block] = [found.chart()]
    for table in tables:
        numbers = range(1, len(table.columns) - 1) if isinstance(found, TouchComparison) else (1, 3)
        blocks.append(build_table(table.title, table.columns, table.rows, numbers=numbers))
    blocks += [Note(text=note, kind="note") for note in notes]
    title = "Predicted beside measured contacts" if isinstance(found, TouchComparison) else "A predicted contact"
    section = Section(key="prediction", title="Peaks", blocks=tuple(blocks))
    return Page(title=title, lead=f"{headline}.", sections=(section,))
