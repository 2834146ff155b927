"""What an MCAP file lacks that would protect its messages."""

from ...result import Finding
from .mcap_layout import Layout


def file_findings(layout: Layout) -> tuple[Finding, ...]:
    """Tell of messages without a checksum, and of a file without a summary."""
    found = []
    total = sum(sum((piece.counts or {}).values()) for piece in layout.pieces)
    bare = sum(sum((piece.counts or {}).values()) for piece in layout.pieces if not piece.crc)
    if bare and not layout.data_crc:
        found.append(
            Finding(
                code="crc-absent",
                severity="info",
                message=f"{bare} of {total} messages carry no checksum (CRC): "
                "a flipped bit in the file would not be noticed.",
                advice="Let the recorder write chunk CRCs (rosbag2: storage option `noChunkCRC: false`).",
            )
        )
    if layout.statistics is None:
        found.append(
            Finding(
                code="summary-absent",
                severity="info",
                message=f"The file has no summary that would confirm that all its {total} messages are there.",
                advice="Let the recorder write a summary (rosbag2: storage option `noSummary: false`).",
            )
        )
    return tuple(found)
