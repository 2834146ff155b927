"""What a command may replace is a file of the same kind, and what it was is said."""

from hashlib import sha256
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.controller import write_controller
from autotune.formats.kinds import check_replaced, describe_existing, kind_of
from tests.autotune.formats.samples import make_controller


def test_the_kind_is_in_the_first_lines(tmp_path: Path) -> None:
    path = tmp_path / "a"
    assert kind_of(path) == kind_of(Path("/dev/null")) == ""
    for text, kind in (
        ("", ""),
        ("format: autotune/plan\nversion: 1\n", "plan"),
        ("# a comment\nformat: autotune/identified\n", "identified"),
        ('{\n  "format": "autotune/controller"}', "controller"),
        ("/* format: autotune/c, version 1: cell.h */", "c"),
        ('<html><head><meta name="generator" content="autotune report">', "report"),
        ("# autotune/map version 1, autotune 1.0\n", "map"),
        ('{"format": "autotune/map", "version": 1', "map"),
        ("<?xml ?><svg><metadata><dc:title>autotune map</dc:title>", "picture"),
        ("<?xml ?><svg><metadata><dc:title>a drawing</dc:title>", None),
        ("x,y,is_stable\n1,2,1\n", None),
        ("notes on format: autotune/plan", None),
        ("what I saw today", None),
    ):
        path.write_text(text)
        assert kind_of(path) == kind, text


def test_what_stands_there_is_reported_with_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    assert describe_existing(path) == ""
    digest = write_controller(path, make_controller())
    assert describe_existing(path) == check_replaced(path, "controller") == f"the controller of checksum {digest[:8]}"
    path.write_text(path.read_text(encoding="utf-8").replace("mass: 12.5", "mass: 12.4"), encoding="utf-8")
    assert check_replaced(path, "controller") == "a controller that is not whole"
    plan = b"format: autotune/plan\n"
    path.write_bytes(plan)
    assert describe_existing(path) == f"the plan of sha256 {sha256(plan).hexdigest()[:8]}"


def test_anything_else_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("format: autotune/identified\n")
    with pytest.raises(UsageError, match=r"a\.yaml exists and is no controller \(identified plant\), .* with --out"):
        check_replaced(path, "controller", option="--out")
    path.write_text("axes: {}\n")
    with pytest.raises(UsageError, match="is no file of this tool, so it is not replaced"):
        check_replaced(path, "controller")
    path.write_text("")
    assert check_replaced(path, "controller") == ""
