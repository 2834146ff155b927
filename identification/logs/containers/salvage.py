"""Tell what a salvage had to leave out."""

from collections.abc import Sequence

from ...result import Finding

_TOLD = 5


def salvaged(name: str, lost: Sequence[str]) -> tuple[Finding, ...]:
    """Return one warning that names the damaged places of a file, or nothing where there are none."""
    if not lost:
        return ()
    more = f"; and {len(lost) - _TOLD} more" if len(lost) > _TOLD else ""
    return (
        Finding(
            code="salvaged",
            severity="warning",
            message=f"{name} is damaged, {len(lost)} part(s) of it are left out: {'; '.join(lost[:_TOLD])}{more}.",
            advice="Use the result to look at the data; record again before a robot relies on it.",
        ),
    )
