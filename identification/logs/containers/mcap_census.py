"""Know how many messages each piece of an MCAP file holds: from its indexes if they are confirmed, else by counting."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from .file_bytes import FileBytes
from .mcap_layout import Layout
from .mcap_pieces import Opened, Opener
from .mcap_records import Damage, Piece
from .ordered import map_in_order


def total_counts(pieces: Iterable[Piece]) -> Counter[int]:
    """Return the messages per channel id of all pieces together, as far as they are known."""
    total: Counter[int] = Counter()
    for piece in pieces:
        total.update(piece.counts or {})
    return +total


def complete(layout: Layout, file: FileBytes, opener: Opener) -> Layout:
    """Return the layout with the counts of all pieces known and all their channels defined.

    Raises Damage where the summary, the indexes and the messages contradict each other.
    """
    known = _from_indexes(layout) or _count(layout, opener)
    _check_statistics(known)
    for piece in known.pieces:
        for channel_id in piece.counts or {}:
            if not layout.definitions.has_all((channel_id,)):
                raise Damage(piece.start, f"a message names channel {channel_id}, which is not defined")
    if layout.data_crc and not is_protected(layout) and file.crc32(0, layout.data_stop) != layout.data_crc:
        raise Damage(layout.data_stop, "the CRC of the data section does not agree with its content")
    return known


def is_protected(layout: Layout) -> bool:
    """Tell whether all that matters has a CRC of its own, so that the one of the whole data section is not needed."""
    return bool(layout.pieces) and layout.summary_crc != 0 and all(piece.crc for piece in layout.pieces)


def counted(opened: Opened) -> Piece:
    """Return the piece with what has been counted in it."""
    tally = opened.tally
    return replace(opened.piece, counts=tally.counts, start_ns=tally.start_ns, end_ns=tally.end_ns)


def without_data(opened: Opened) -> Opened:
    """Return what is known of an opened piece, without its content, which the next piece takes the place of."""
    return replace(opened, data=np.empty(0, dtype=np.uint8))


def _from_indexes(layout: Layout) -> Layout | None:
    """Take the counts from the indexes if the statistics confirm them; messages outside of chunks were counted."""
    total = total_counts(layout.pieces)
    told = layout.statistics
    if not layout.definitions.has_all(total):
        return None
    if told is None:
        return None if any(piece.is_chunk for piece in layout.pieces) or layout.has_strangers else layout
    if told.message_count != total.total() or not all(_has_times(piece, layout) for piece in layout.pieces):
        return None
    return replace(layout, pieces=tuple(replace(piece, counts=piece.counts or {}) for piece in layout.pieces))


def _has_times(piece: Piece, layout: Layout) -> bool:
    """Tell whether the recording times of a piece are known: counted, or told by the chunk and by its index."""
    return not piece.is_chunk or not piece.counts or (piece.has_span and bool(layout.chunk_indexes))


def _count(layout: Layout, opener: Opener) -> Layout:
    pieces: list[Piece] = []
    has_strangers = layout.has_strangers
    for opened in map_in_order(lambda piece: without_data(opener.open(piece)), layout.pieces):
        for definition in opened.definitions:
            layout.definitions.add(*definition)
        has_strangers |= opened.has_strangers
        pieces.append(counted(opened))
    if has_strangers and layout.statistics is None:
        raise Damage(0, "it holds records of unknown kinds, and no count tells whether they were messages")
    return replace(layout, pieces=tuple(pieces))


def _check_statistics(layout: Layout) -> None:
    told = layout.statistics
    if told is None:
        return
    total = total_counts(layout.pieces)
    chunks = sum(piece.is_chunk for piece in layout.pieces)
    per_channel = {key: count for key, count in told.channel_message_counts.items() if count}
    are_others = bool(per_channel) and per_channel != total
    if (told.message_count, told.chunk_count) != (total.total(), chunks) or are_others:
        raise Damage(
            layout.data_stop,
            f"its summary counts {told.message_count} messages in {told.chunk_count} chunks, "
            f"the data hold {total.total()} in {chunks}{', of other channels' if are_others else ''}",
        )
