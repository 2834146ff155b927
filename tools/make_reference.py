"""Write the schemas that records make (`make_schema`), and docs/reference.md from all schemas.

The page lists every entry of every file; `--check` only says whether both are up to date.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SCHEMAS, PAGE = ROOT / "autotune" / "formats" / "schemas", ROOT / "docs" / "reference.md"
MEANINGS = ROOT / "tools" / "entries.md"
ORDER = ("controller", "identified", "plant", "problem", "cell", "plan", "pareto", "schedule", "campaign")
HEAD = """# Every entry of every file

Made by `python tools/make_reference.py` from the JSON Schemas in `autotune/formats/schemas`, against which every
file is
checked when it is read and when it is written. [files.md](files.md) has what a person writes, and the rules. A name in
angle brackets means any of those that are listed, or for a name of yours; `[ ]` is an entry of a list. Entries marked •
must be there where their mapping is. An entry that is not listed is refused, but for mappings of which none is listed.
"""
AXES, TURNING = ("x", "y", "z"), ("rx", "ry", "rz")
# Ends of names and their units, longer ends first.
UNITS = (
    ("_n_m_per_rad_per_s", "N·m/(rad/s)"), ("_n_m_per_rad_s", "N·m/(rad/s)"), ("_n_m_s_per_rad", "N·m·s/rad"),
    ("_n_m_per_rad", "N·m/rad"), ("_n_per_m_s", "N/(m/s)"), ("_n_s_per_m", "N·s/m"), ("_n_per_m", "N/m"),
    ("_rad_s_per_n_m", "rad/s/(N·m)"), ("_m_s_per_n", "m/s/N"), ("_rad_per_s", "rad/s"), ("_n2_m2_per_hz", "N²·m²/Hz"),
    ("_n2_per_hz", "N²/Hz"), ("_kg_m2", "kg·m²"), ("_per_s", "1/s"), ("_rad_s", "rad/s"), ("_m_s", "m/s"),
    ("_n_m", "N·m"), ("_kg", "kg"), ("_hz", "Hz"), ("_db", "dB"), ("_deg", "°"), ("_rad", "rad"), ("_percent", "%"),
    ("_n", "N"), ("_m", "m"), ("_s", "s"),
)  # fmt: skip
TWO_UNITS = {
    "mass": "kg, kg·m²",
    "damping": "N·s/m, N·m·s/rad",
    "deadband": "N, N·m",
    "speed": "m/s, rad/s",
    "acceleration": "m/s², rad/s²",
    "approach_speed": "m/s, rad/s",
    "impulse": "N·s, N·m·s",
    **dict.fromkeys(
        ("peak_force", "peak_interval", "held_force", "desired_force", "measured_peak", "predicted_peak"), "N, N·m"
    ),
}
TYPES = {
    "array": "list", "boolean": "true or false", "integer": "whole number", "null": "null", "number": "number",
    "object": "mapping", "string": "text",
}  # fmt: skip
BOUNDS = (("minimum", "≥ {}"), ("exclusiveMinimum", "> {}"), ("maximum", "≤ {}"), ("exclusiveMaximum", "< {}"))
SIZES = (
    ("minItems", "at least {} entries"), ("maxItems", "at most {} entries"), ("minLength", "at least {} characters"),
    ("maxLength", "at most {} characters"), ("minProperties", "at least {} of them"),
    ("maxProperties", "at most {} of them"),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Row:
    """One entry: where it stands, whether it must be there, what it is, its unit and what else must hold."""

    path: str
    required: bool
    type: str
    unit: str
    rule: str

    def text(self) -> str:
        """Return the line of the table."""
        return f"| {'•' if self.required else ''} | `{self.path}` | {self.type} | {self.unit} | {self.rule} |"


class Schema:
    """A JSON Schema whose references lead into itself."""

    def __init__(self, tree: dict[str, Any]) -> None:
        self.tree = tree

    def rows(self) -> Iterator[Row]:
        """Yield every entry, depth first."""
        yield from self._inside(self.tree, "")

    def _resolved(self, node: Any) -> dict[str, Any]:
        """Return a node with what its reference holds, its own words first."""
        found: dict[str, Any] = node if isinstance(node, dict) else {}
        while "$ref" in found:
            target: Any = self.tree
            for part in found["$ref"].removeprefix("#/").split("/"):
                target = target[part]
            found = {**target, **{key: value for key, value in found.items() if key != "$ref"}}
        return found

    def _inside(self, node: dict[str, Any], path: str) -> Iterator[Row]:
        required = set(node.get("required", ()))
        for names, child in self._grouped(node.get("properties", {})):
            at = f"{path}.{names}" if path else names
            yield from self._entry(child, at, required=names in required)
        other = node.get("additionalProperties")
        if isinstance(other, dict):
            yield from self._entry(other, f"{path}.<name>" if path else "<name>", required=False)
        if "items" in node:
            items = self._resolved(node["items"])
            if _has_entries(items):
                yield from self._inside(items, f"{path}[ ]")
        for choice in (*node.get("anyOf", ()), *node.get("oneOf", ()), *node.get("allOf", ())):
            yield from self._inside(self._resolved(choice), path)

    def _grouped(self, properties: dict[str, Any]) -> Iterator[tuple[str, Any]]:
        """Yield names with their schema; axes that are alike go together."""
        done: set[str] = set()
        for name, child in properties.items():
            if name in done:
                continue
            groups = ((*AXES, *TURNING), AXES, TURNING)
            alike = next((group for group in groups if self._alike(properties, group, name)), None)
            done.update(alike or (name,))
            yield (f"<{' '.join(alike)}>" if alike else name), child

    @staticmethod
    def _alike(properties: dict[str, Any], group: tuple[str, ...], name: str) -> bool:
        return name in group and all(properties.get(each) == properties[name] for each in group)

    def _entry(self, child: Any, path: str, *, required: bool) -> Iterator[Row]:
        node = self._resolved(child)
        last = path.rpartition(".")[2]
        yield Row(path=path, required=required, type=self._type(node), unit=_unit(last, node), rule=self._rule(node))
        yield from self._inside(node, path)

    def _type(self, node: dict[str, Any]) -> str:
        if "const" in node:
            return f"`{json.dumps(node['const'])}`"
        if "enum" in node:
            return ", ".join(f"`{json.dumps(value)}`" for value in node["enum"])
        if "type" in node:
            names = [node["type"]] if isinstance(node["type"], str) else node["type"]
            kinds = " or ".join(TYPES[name] for name in names)
            items = self._resolved(node["items"]) if "items" in node else {}
            return f"{kinds} of: {self._type(items)}" if items and not _has_entries(items) else kinds
        choices = [self._resolved(each) for each in (*node.get("anyOf", ()), *node.get("oneOf", ()))]
        return " or ".join(dict.fromkeys(self._type(each) for each in choices)) or "anything"

    def _rule(self, node: dict[str, Any]) -> str:
        rules = [words.format(_number(node[key])) for key, words in BOUNDS if key in node]
        if node.get("minItems", 0) == node.get("maxItems"):
            rules.append(f"{node['minItems']} entries")
        else:
            rules += [words.format(_number(node[key])) for key, words in SIZES if key in node]
        items = self._resolved(node["items"]) if "items" in node else {}
        rules += [f"each {words.format(_number(items[key]))}" for key, words in BOUNDS if key in items]
        if "description" in node:
            rules.append(str(node["description"]).replace("|", "\\|"))
        return "; ".join(rules)


def _has_entries(node: dict[str, Any]) -> bool:
    return any(key in node for key in ("properties", "anyOf", "oneOf")) or isinstance(
        node.get("additionalProperties"), dict
    )


def _unit(name: str, node: dict[str, Any]) -> str:
    """Return the unit that the end of a name gives, of numbers only."""
    if node.get("type") in ("string", "boolean"):
        return ""
    if name in TWO_UNITS and node.get("type") in ("number", "array"):
        return TWO_UNITS[name]
    return next((unit for end, unit in UNITS if name.endswith(end)), "")


def _number(value: float) -> str:
    return f"{value:g}"


def page() -> str:
    """Return the whole page."""
    from autotune.formats.problem import problem_schema
    from autotune.formats.schema import load_schema

    parts, meanings = [HEAD], entry_meanings()
    for name in ORDER:
        tree = problem_schema({}) if name == "problem" else load_schema(name)
        rows = dict.fromkeys(row.text() for row in Schema(tree).rows())
        table = ["| | entry | is | unit | must be |", "|---|---|---|---|---|", *rows]
        said = f"{meanings[name]}\n\n" if name in meanings else ""
        parts.append(f"## {name}.yaml\n\n{tree['title']}.\n\n{said}" + "\n".join(table) + "\n")
    return "\n".join(parts)


def entry_meanings() -> dict[str, str]:
    """Return what entries hold, by the name of the file."""
    sections = re.split(r"^## (\w+)\.yaml\n", MEANINGS.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {name: text.strip() for name, text in zip(sections[1::2], sections[2::2], strict=True)}


def main(argv: list[str] | None = None) -> int:
    """Write schema and page, or with `--check` return 1 if one of them is not up to date."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="change nothing; fail if the page is out of date")
    options = parser.parse_args(argv)
    # The project of this folder, installed or not.
    sys.path.insert(0, str(ROOT))
    from tools.make_schema import texts

    late = False
    # The page last: it is made from what the others write.
    for path, made in (*((SCHEMAS / f"{name}.schema.json", text) for name, text in texts().items()), (PAGE, None)):
        wanted = page() if made is None else made
        if not options.check:
            path.write_text(wanted, encoding="utf-8")
        elif not path.is_file() or path.read_text(encoding="utf-8") != wanted:
            print(f"{path.name} is out of date; run python tools/make_reference.py", file=sys.stderr)
            late = True
    return int(late)


if __name__ == "__main__":
    sys.exit(main())
