"""Two hundred random edits of a good file, each of which changes its content: none loads."""

import random
import re
from collections import Counter
from collections.abc import Callable

import pytest

from autotune.errors import CertificateError
from autotune.formats.canonical import checksum
from autotune.formats.controller import controller_tree, parse_controller
from autotune.formats.yaml12 import dump_yaml
from tests.autotune.formats.samples import make_controller

YAML = dump_yaml(controller_tree(make_controller(("x", "rz"))))
LINES = YAML.splitlines(keepends=True)
Edit = Callable[[random.Random], str]


def another_digit(rng: random.Random) -> str:
    at = rng.choice([match.start() for match in re.finditer("[0-9]", YAML)])
    return YAML[:at] + rng.choice([d for d in "0123456789" if d != YAML[at]]) + YAML[at + 1 :]


def a_digit_more(rng: random.Random) -> str:
    """Beside another digit; only a zero at the end of a fraction would leave the number as it is."""
    at = rng.choice([match.end() for match in re.finditer(r"[0-9](?=[0-9.])", YAML)])
    return YAML[:at] + rng.choice("123456789") + YAML[at:]


def a_line_less(rng: random.Random) -> str:
    at = rng.randrange(len(LINES))
    return "".join(LINES[:at] + LINES[at + 1 :])


def a_line_twice(rng: random.Random) -> str:
    at = rng.randrange(len(LINES))
    return "".join([*LINES[: at + 1], *LINES[at:]])


def another_letter_in_a_key(rng: random.Random) -> str:
    names = list(re.finditer(r"(?m)^ *(?:- )?([a-z][a-z0-9_]*):", YAML))
    name = rng.choice(names)
    at = rng.choice([i for i in range(*name.span(1)) if YAML[i].isalpha()])
    return YAML[:at] + rng.choice([c for c in "abcdefghijklmnopqrstuvwxyz" if c != YAML[at]]) + YAML[at + 1 :]


def a_cut(rng: random.Random) -> str:
    # Three characters before the end a digit of the checksum goes with it.
    return YAML[: rng.randrange(len(YAML) - 2)]


def a_step_to_the_side(rng: random.Random) -> str:
    """One space more before a line that is a value of the line above, so that it hangs elsewhere or nowhere."""
    deep = [i for i, line in enumerate(LINES) if line.startswith("  ") and i + 1 < len(LINES)]
    alike = [i for i in deep if _depth(LINES[i]) == _depth(LINES[i - 1])]
    at = rng.choice(alike)
    return "".join([*LINES[:at], " " + LINES[at], *LINES[at + 1 :]])


def _depth(line: str) -> int:
    return len(line) - len(line.lstrip(" "))


EDITS: tuple[tuple[Edit, int], ...] = (
    (another_digit, 60),
    (a_digit_more, 20),
    (a_line_less, 30),
    (a_line_twice, 20),
    (another_letter_in_a_key, 30),
    (a_cut, 30),
    (a_step_to_the_side, 10),
)


def test_the_file_loads_unless_it_is_edited() -> None:
    assert parse_controller(YAML, "c.yaml").controller == make_controller(("x", "rz"))
    assert sum(count for _, count in EDITS) == 200


@pytest.mark.parametrize(("edit", "count"), EDITS, ids=[edit.__name__ for edit, _ in EDITS])
def test_no_edit_loads(edit: Edit, count: int) -> None:
    rng, seen = random.Random(f"{edit.__name__} 2024"), Counter[str]()
    while sum(seen.values()) < count:
        text = edit(rng)
        assert text != YAML
        with pytest.raises(CertificateError) as caught:
            parse_controller(text, "c.yaml")
        message = re.match(r"c\.yaml, line (\d+): (.)", str(caught.value))
        assert message is not None, caught.value
        # An empty file is reported as such in its first line.
        assert 1 <= int(message[1]) <= max(1, text.count("\n") + 1)
        seen[text] += 1
    # Edits are drawn anew, not one over and over.
    assert len(seen) > 0.5 * count


@pytest.mark.parametrize("key", ["environment_stiffness_n_per_m", "break_point"])
def test_text_where_a_margin_is_smallest_is_refused(key: str) -> None:
    tree = controller_tree(make_controller(("x",)))
    tree["certificate"]["margins"]["x"]["worst"]["modulus"][key] = "stiff"
    tree["checksum"] = checksum(tree)
    with pytest.raises(CertificateError, match=rf"margins\.x\.worst\.modulus\.{key} must be a number, found"):
        parse_controller(dump_yaml(tree), "c.yaml")
