"""A controller file in which anything at all was changed is refused, and says where it can what is wrong."""

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.errors import CertificateError
from autotune.formats.canonical import dump_json
from autotune.formats.controller import controller_tree, parse_controller, read_controller, write_controller
from autotune.formats.yaml12 import dump_yaml
from tests.autotune.formats.samples import make_controller

TREE = controller_tree(make_controller(("x",)))
YAML = dump_yaml(TREE)
JSON = dump_json(TREE)
BOTH = pytest.mark.parametrize("text", [YAML, JSON], ids=["yaml", "json"])


def refusal(text: str) -> str:
    """Return why the text is refused."""
    with pytest.raises(CertificateError) as caught:
        parse_controller(text, "c.yaml")
    return str(caught.value)


@BOTH
def test_each_line_counts(text: str) -> None:
    lines = text.splitlines(keepends=True)
    for index, line in enumerate(lines):
        message = refusal("".join(lines[:index] + lines[index + 1 :]))
        assert re.match(r"c\.yaml, line \d+: \S", message), (line, message)


@BOTH
def test_each_digit_counts(text: str) -> None:
    places = [match.start() for match in re.finditer("[0-9]", text)]
    assert len(places) > 200
    for at in places:
        message = refusal(f"{text[:at]}{(int(text[at]) + 1) % 10}{text[at + 1 :]}")
        assert re.match(r"c\.yaml, line \d+: \S", message), message


def test_each_digit_of_the_longest_number_counts_with_each_other_digit() -> None:
    number = "71.23456789012344"
    start = YAML.index(number)
    for at in (at for at, mark in enumerate(number) if mark != "."):
        for digit in set("0123456789") - {number[at]}:
            changed = f"{number[:at]}{digit}{number[at + 1 :]}"
            last = YAML.count("\n")
            assert re.match(
                rf"c\.yaml, line (33|{last}): ", refusal(YAML[:start] + changed + YAML[start + len(number) :])
            )


@BOTH
def test_a_truncated_file_is_refused(text: str) -> None:
    data = text.encode()
    for length in [*range(0, len(data), 50), len(data) - 1]:
        message = refusal(data[:length].decode(errors="ignore"))
        assert re.match(r"c\.yaml, line \d+: \S", message), message


def test_a_stale_checksum_is_refused_with_both_short_forms() -> None:
    other = controller_tree(make_controller(("x", "y")))["checksum"]
    message = refusal(YAML.replace(TREE["checksum"], other))
    assert f"the checksum says {other[:8]}, but the content has {TREE['checksum'][:8]}" in message
    assert message.startswith(f"c.yaml, line {YAML.count(chr(10))}: ")


def test_a_changed_gain_is_reported_as_altered() -> None:
    message = refusal(YAML.replace("mass: 12.5", "mass: 12.6"))
    assert "the file is altered" in message
    assert TREE["checksum"][:8] in message


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("mass: 12.5", "mass: 12.5\n    mass: 12.5", "line 10: the key mass occurs twice, first in line 9"),
        ("feedback_damping_s: 0.02", "feedback_damping_s: 2e-5", "line 12: axes.x.feedback_damping_s must be 0 or at"),
        ("mass: 12.5", "mass: .nan", "line 9: .nan is not a finite number"),
        ("mass: 12.5", "mass: 12,5", "line 9: axes.x.mass must be a number (with a decimal point, not a comma)"),
        ("[0.01, -0.02, 0.1]", "[0,01, -0,02, 0,1]", "0,01 may be a decimal comma"),
        ("format:", "\ufeffformat:", "line 1: a byte order mark"),
        ("    mass:", "\t mass:", "line 9: a tab"),
        ("axes:\n", "---\naxes:\n", "line 7: a second document begins"),
        ("mass: 12.5", "mass: !!float 12.5", "line 9: tags"),
        ("mass: 12.5", "mass: &m 12.5", "line 9: anchors"),
        ("mass: 12.5", "mass: " + "[" * 99 + "]" * 99, "line 9: nested more than"),
        ("version: 1", "version: 0", "line 2: version must be 1"),
        ("version: 1\n", "", "line 1: version must be 1, found no such key"),
        ("format: autotune/controller\n", "", "line 1: format must be autotune/controller, found no such key"),
        ("status: validated", "status: unvalidated", "the file is altered"),
    ],
)
def test_surprises_are_refused_with_their_line(old: str, new: str, reason: str) -> None:
    assert old in YAML
    assert reason in refusal(YAML.replace(old, new, 1))


@settings(deadline=None, max_examples=300)
@given(st.integers(0, len(YAML.encode()) - 1), st.binary(max_size=3), st.integers(0, 3))
def test_arbitrary_edits_are_refused_or_change_nothing(at: int, new: bytes, removed: int) -> None:
    data = YAML.encode()
    text = (data[:at] + new + data[at + removed :]).decode(errors="replace")
    try:
        found = parse_controller(text, "c.yaml")
    except CertificateError as error:
        assert str(error).startswith("c.yaml")  # noqa: PT017 - either outcome is right, each has its own form
    else:
        assert found.checksum == TREE["checksum"]
        assert found.controller == make_controller(("x",))


def test_a_file_of_another_kind_is_refused_from_disk(tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    write_controller(path, make_controller())
    path.write_bytes(path.read_bytes()[:-40] + b"\xff\xfe\n")
    with pytest.raises(CertificateError, match=r"controller\.yaml, line \d+: not UTF-8 text"):
        read_controller(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(CertificateError, match="line 1: not UTF-8 text"):
        read_controller(path)
