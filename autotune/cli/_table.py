"""Aligned columns of text for people."""

from collections.abc import Iterator, Sequence


def printable(text: str) -> str:
    """Replace control characters, which a name from a file could otherwise send to the terminal."""
    return "".join(character if character.isprintable() else "?" for character in text)


def table_lines(rows: Sequence[Sequence[str]], *, left: Sequence[int] = (0,), indent: str = "") -> Iterator[str]:
    """Yield one line per row, columns aligned; those in `left` to the left, the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (
            text.ljust(width) if column in left else text.rjust(width)
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        yield printable(indent + "  ".join(cells).rstrip())
