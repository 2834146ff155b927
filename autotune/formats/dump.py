"""Write plain trees as YAML that YAML 1.2 and 1.1 parsers read alike, and as JSON."""

import io
import json
import re
from collections.abc import Mapping
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter

from .canonical import plain

_LONGEST_FLOW_LIST = 12
_WIDTH = 2**24
_SURELY_TEXT = re.compile(r"[A-Za-z_][A-Za-z0-9_/.+-]*( [A-Za-z0-9_/.+-]+)*")
_WORDS = frozenset({"yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity"})
"""Plain words that YAML 1.1, or a careless reader, takes for something other than text."""


class _Representer(SafeRepresenter):
    """Quotes whatever another parser could take for something else; repeats shared parts instead of naming them."""

    def ignore_aliases(self, data: Any) -> bool:
        del data
        return True

    def text(self, data: str) -> ScalarNode:
        is_safe = _SURELY_TEXT.fullmatch(data) is not None and data.lower() not in _WORDS
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=None if is_safe else '"')

    def number(self, data: float) -> ScalarNode:
        return self.represent_scalar("tag:yaml.org,2002:float", number_text(data))

    def items(self, data: list[Any]) -> SequenceNode:
        is_flow = len(data) <= _LONGEST_FLOW_LIST and not any(_is_block(item) for item in data)
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=is_flow)


_Representer.add_representer(str, _Representer.text)
_Representer.add_representer(float, _Representer.number)
_Representer.add_representer(list, _Representer.items)


def _is_block(item: object) -> bool:
    return isinstance(item, dict) or (isinstance(item, list) and any(isinstance(part, dict | list) for part in item))


def number_text(number: float) -> str:
    """Return the shortest decimal that reads back to the same double, with a point: `1.0e-05`, not `1e-05`."""
    text = repr(number)
    return text if "." in text else text.replace("e", ".0e")


def dump_yaml(tree: Mapping[str, object]) -> str:
    """Return `tree` as YAML, keys in the given order, numbers exact to the last bit, short lists on one line.

    Raises ParameterError: a number is not finite, or something has no plain form.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Representer = _Representer
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # annotated by its default alone
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.width = _WIDTH
    stream = io.StringIO()
    yaml.dump(plain(tree), stream)
    return stream.getvalue()


def dump_json(tree: Mapping[str, object]) -> str:
    """Return `tree` as indented ASCII JSON, keys in the given order, numbers exact to the last bit.

    Raises ParameterError: a number is not finite, or something has no plain form.
    """
    text = json.dumps(plain(tree), indent=2, allow_nan=False)
    return text.replace("\x7f", "\\u007f") + "\n"
