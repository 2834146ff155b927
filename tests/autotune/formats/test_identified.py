import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings

from autotune.errors import UsageError
from autotune.formats.canonical import dump_json
from autotune.formats.identified import identified_tree, read_identified, write_identified
from autotune.formats.yaml12 import dump_yaml
from identification.result import Covariance, Estimate, Identified, Status
from problems.errors import ParameterError
from tests.autotune.formats.samples import TREES, identified_results, make_identified


@settings(deadline=None, max_examples=40)
@given(identified_results(), TREES)
def test_what_is_written_is_read_back_to_the_last_bit(result: Identified, provenance: dict[str, object]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "identified.yaml"
        write_identified(path, result, provenance)
        back = read_identified(path)
        path.write_text(dump_json(identified_tree(result, provenance)), encoding="utf-8")
        twin = read_identified(path)
    assert back.result == result
    assert repr(back.result) == repr(result)  # tells -0.0 from 0.0
    assert dict(back.provenance) == provenance
    assert twin.result == result


def test_the_keys_are_those_of_the_contract() -> None:
    tree = identified_tree(make_identified(), {"tool": "x"})
    assert list(tree) == [
        "format", "version", "sample_time_s", "payload", "axes", "sensor", "findings", "provenance",
    ]  # fmt: skip
    axis = tree["axes"]["x"]
    assert list(axis) == ["coupling", "drag_n_s_per_m", "environments", "robot"]
    assert list(axis["coupling"]) == ["stiffness_n_per_m", "damping_n_s_per_m"]
    assert list(axis["environments"][0]) == [
        "name", "stiffness_n_per_m", "secant_stiffness_n_per_m", "damping_n_s_per_m", "mass_kg", "contacts",
        "peak_force_n",
    ]  # fmt: skip
    assert list(axis["robot"]) == ["numerator", "denominator", "delay_s", "bandwidth_hz"]
    assert axis["coupling"]["stiffness_n_per_m"] == {"value": 3e5, "std": None, "status": "given"}


def test_a_rotational_axis_shows_its_units() -> None:
    axis = identified_tree(make_identified(), {})["axes"]["rz"]
    assert list(axis["coupling"]) == ["stiffness_n_m_per_rad", "damping_n_m_s_per_rad"]
    assert "drag_n_m_s_per_rad" in axis
    environment = axis["environments"][0]
    assert {"secant_stiffness_n_m_per_rad", "inertia_kg_m2", "peak_torque_n_m"} <= set(environment)
    assert not [key for key in environment if key.endswith(("_per_m", "_kg", "_n"))]


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        ("{}", "corner_hz or delay_s, one of the two"),
        (
            "{corner_hz: {value: 50.0, std: 1.0, status: identified}, delay_s: {value: 0.0, std: 0.0, status: given}}",
            "corner_hz or delay_s, one of the two",
        ),
        ("{corner_hz: {value: 0.0, std: 1.0, status: identified}}", "corner_hz.value must be greater than 0"),
        ("{delay_s: {value: -1e-3, std: 1e-5, status: identified}}", "delay_s.value must be at least 0"),
    ],
)
def test_a_wrench_filter_is_a_corner_or_a_delay(tmp_path: Path, entry: str, reason: str) -> None:
    path = tmp_path / "identified.yaml"
    text = dump_yaml(identified_tree(make_identified(), {}))
    path.write_text(text.replace("sensor:\n", f"sensor:\n  wrench_filter: {entry}\n", 1), encoding="utf-8")
    with pytest.raises(UsageError, match=rf"sensor\.wrench_filter.*{reason}"):
        read_identified(path)


@pytest.mark.parametrize(
    ("names", "values", "matrix", "must"),
    [
        (("K_s", "K_s"), (1.0, 1.0), ((1.0, 0.0), (0.0, 1.0)), "different names"),
        (("K_s",), (1.0, 2.0), ((1.0,),), "as many numbers as there are names, 1"),
        (("K_s", "B_s"), (1.0, 2.0), ((1.0, 0.0),), "2 rows of 2 numbers"),
        (("K_s", "B_s"), (1.0, 2.0), ((1.0, 0.5), (0.4, 1.0)), "symmetric"),
        (("K_s", "B_s"), (1.0, 2.0), ((4.0, 7.0), (7.0, 9.0)), "product of both deviations .*found '7 of K_s and B_s'"),
        (("K_s",), (3e5,), ((-1.0,),), "0 or more on the diagonal, which holds variances, found -1"),
    ],
)
def test_a_covariance_that_is_none_is_refused(
    names: tuple[str, ...], values: tuple[float, ...], matrix: tuple[tuple[float, ...], ...], must: str
) -> None:
    with pytest.raises(ParameterError, match=must):
        Covariance(names=names, values=values, matrix=matrix)


def test_a_covariance_that_is_none_is_refused_with_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "identified.yaml"
    result, covariance = make_identified(), Covariance(names=("omega",), values=(20.0,), matrix=((1.0,),))
    axes = {name: replace(axis, covariance=covariance) for name, axis in result.axes.items()}
    write_identified(path, replace(result, axes=axes), {})
    text = path.read_text(encoding="utf-8")
    line = next(i for i, each in enumerate(text.splitlines(), 1) if each.lstrip().startswith("matrix:"))
    path.write_text(re.sub(r"(matrix: \[\[)", r"\g<1>-", text), encoding="utf-8")
    with pytest.raises(UsageError, match=rf"identified\.yaml, line {line}: axes\.x\.covariance\.matrix must be"):
        read_identified(path)


def test_empty_remarks_are_left_out() -> None:
    drag = identified_tree(make_identified(), {})["axes"]["x"]["drag_n_s_per_m"]
    assert drag == {"value": None, "std": None, "status": "unidentifiable", "note": "no free motion"}


@pytest.mark.parametrize(
    ("estimate", "must"),
    [
        (Estimate(value=1.0, std=None, status=Status.UNIDENTIFIABLE), "null"),
        (Estimate(value=None, std=1.0, status=Status.IDENTIFIED), "a number"),
        (Estimate(value=-1.0, std=1.0, status=Status.IDENTIFIED), "greater than 0"),
        (Estimate(value=1.0, std=-1.0, status=Status.IDENTIFIED), "at least 0"),
        (Estimate(value=float("nan"), std=1.0, status=Status.IDENTIFIED), "finite"),
    ],
)
def test_a_contradiction_is_not_written(tmp_path: Path, estimate: Estimate, must: str) -> None:
    result = replace(make_identified(), sample_time_s=estimate)
    with pytest.raises(ParameterError, match=rf"^sample_time_s\.\w+ must be {must}"):
        write_identified(tmp_path / "identified.yaml", result, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("format: autotune/identified", "format: autotune/controller", "format must be autotune/identified"),
        ("version: 1", "version: 0", "version must be 1, which this release reads, found 0"),
        ("version: 1", "version: '1'", "version must be 1, which this release reads, found the text '1'"),
        ("value: 300000.0", "value: 3,5", "must be a number or null (with a decimal point, not a comma)"),
        ("value: 300000.0", "value: '3e5'", "must be a number or null, found the text '3e5'"),
        ("status: given", "status: sure", "status must be one of identified, weak, unidentifiable, given"),
        ("com_m:", "com:", "payload.com must be one of mass_kg, com_m"),
        ("status: given", "status: given\n  value_kg: 1", "sample_time_s.value_kg must be one of value, std"),
        ("[0.01, -0.02, 0.1]", "[0.01, -0.02]", "payload.com_m.value must be at least 3 entries long"),
        ("  x:", "  a:", "axes.a must be one of x, y, z, rx, ry, rz, found the key a"),
        ("contacts: 2", "contacts: 2.5", "environments[0].contacts must be a whole number, found 2.5"),
        ("contacts: 2", "contacts: true", "environments[0].contacts must be a whole number, found true"),
    ],
)
def test_what_breaks_the_format_is_refused_with_line_and_reason(
    tmp_path: Path, old: str, new: str, reason: str
) -> None:
    text = dump_yaml(identified_tree(make_identified(), {}))
    assert old in text
    path = tmp_path / "identified.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(UsageError) as caught:
        read_identified(path)
    message = str(caught.value)
    assert message.startswith(f"{path}, line ")
    assert reason in message
    line = int(message.removeprefix(f"{path}, line ").partition(":")[0])
    changed = text[: text.index(old)].count("\n") + 1 + new.count("\n")
    # An entry that is gone is reported with the line where its mapping begins.
    assert line == changed or ("no such key" in message and line < changed)


def test_the_digest_is_that_of_the_bytes(tmp_path: Path) -> None:
    path = tmp_path / "identified.yaml"
    write_identified(path, make_identified(), {})
    first = read_identified(path)
    path.write_bytes(path.read_bytes() + b"# a remark\n")
    second = read_identified(path)
    assert first.sha256 != second.sha256
    assert first.result == second.result
    assert second.path == path


def test_a_value_that_its_covariance_contradicts_is_refused(tmp_path: Path) -> None:
    """Someone corrected a number and left it `identified`: the confidence set would speak of another one."""
    result = make_identified()
    axis = result.axes["x"]
    stiffness, damping = axis.coupling.stiffness_n_per_m, axis.coupling.damping_n_s_per_m
    assert stiffness.value is not None
    assert damping.value is not None
    covariance = Covariance(
        names=("K_s", "B_s"), values=(stiffness.value, damping.value), matrix=((1.0, 0.0), (0.0, 1.0))
    )
    for value, status, good in (
        (stiffness.value, Status.IDENTIFIED, True),
        (1.1 * stiffness.value, Status.IDENTIFIED, False),
        (1.1 * stiffness.value, Status.GIVEN, True),
    ):
        changed = replace(stiffness, value=value, std=1.0, status=status)
        coupling = replace(axis.coupling, stiffness_n_per_m=changed)
        path = tmp_path / "identified.yaml"
        write_identified(path, replace(result, axes={"x": replace(axis, coupling=coupling, covariance=covariance)}), {})
        if good:
            assert read_identified(path).result.axes["x"].coupling.stiffness_n_per_m.value == value
        else:
            with pytest.raises(UsageError, match=r"line.*covariance of axis x holds for K_s.*status given"):
                read_identified(path)
