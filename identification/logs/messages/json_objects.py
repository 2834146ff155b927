"""JSON messages."""

import json
from collections.abc import Sequence

from ...errors import LogError

_LIMIT_BYTES = 2**26


def parse_json(data: bytes) -> object:
    """Parse one JSON message of UTF-8 text into mappings, lists, texts and numbers.

    `NaN`, `Infinity` and `-Infinity`, which many writers use though the standard has none, become such numbers: as
    those of any other encoding they are for the checks of a signal to report. Raises LogError for everything else that
    is not JSON, for a key that stands twice, and for messages that are too large or nested too deeply.
    """
    if len(data) > _LIMIT_BYTES:
        raise LogError(f"A JSON message of {len(data)} bytes is larger than the {_LIMIT_BYTES} that are allowed.")
    try:
        return json.loads(data.decode(), object_pairs_hook=_mapping)
    except UnicodeDecodeError as error:
        raise _refusal(f"it is not UTF-8 text at byte {error.start}") from error
    except json.JSONDecodeError as error:
        raise _refusal(f"{error.msg[:1].lower()}{error.msg[1:]} at character {error.pos}") from error
    except RecursionError as error:
        raise _refusal("it is nested too deeply") from error
    except ValueError as error:
        raise _refusal("it holds a number with too many digits") from error


def _mapping(pairs: Sequence[tuple[str, object]]) -> dict[str, object]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise _refusal(f"the key {twice[:60]!r} stands twice")
    return tree


def _refusal(reason: str) -> LogError:
    return LogError(f"A JSON message cannot be used: {reason}; correct the writer and record again.")
