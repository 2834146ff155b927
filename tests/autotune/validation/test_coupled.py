"""Axes on one payload: what optimize certifies of them together, what validate confirms, and what is refused."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.cli._proved import coupled_lines
from autotune.errors import InfeasibleError, UsageError
from autotune.formats.cell import read_cell
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import Controller
from autotune.formats.coupled_record import CoupledBody, CoupledCertificate, Vector
from autotune.formats.identified import read_identified, write_identified
from autotune.formats.problem import read_problem
from autotune.tuning.coupled import TogetherAsked, TogetherCheck, check_together, coupled_body
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.coupled import build_dense_loop, check_coupled
from autotune.validation.coupled_cell import CoupledCell
from autotune.validation.coupled_proof import check_proofs, prove_together
from identification.errors import EstimateError
from identification.result import Identified, InertiaEstimate
from problems.model.coupled import PointSurface, build_coupled_loop, build_coupled_sampled_plant, coupled_poles
from problems.stability.coupled_margins import coupled_sensitivities
from tests.autotune.tuning.cases import absent, known, known_vector
from tests.autotune.tuning.turning import both_optimized, turned_axis, two_axes
from tests.problems.axes import PERIOD_S
from tests.problems.coupled_cases import LAWS, cell, wall


@cache
def tuned() -> Controller:
    return both_optimized().controller


def certificate(controller: Controller) -> CoupledCertificate:
    found = controller.certificate.coupled
    assert found is not None
    return found


def with_certificate(**changes: Any) -> Controller:
    changed = replace(certificate(tuned()), **changes)
    return replace(tuned(), certificate=replace(tuned().certificate, coupled=changed))


def moved(com_m: float, plant: Identified | None = None) -> tuple[Controller, Identified]:
    """Return controller and plant with the centre of mass elsewhere along z."""
    known_plant = two_axes() if plant is None else plant
    payload = replace(known_plant.payload, com_m=known_vector(0.0, 0.0, com_m))
    return replace(tuned(), payload=replace(tuned().payload, com_m=(0.0, 0.0, com_m))), replace(
        known_plant, payload=payload
    )


def softer(factor: float) -> Controller:
    """Return a controller of which each axis alone is stable, and both together are not."""
    axes = {
        name: replace(each, mass=factor * each.mass, damping=factor * each.damping, lead_s=0.0)
        for name, each in tuned().axes.items()
    }
    return replace(tuned(), axes=axes)


def with_x_alone() -> Controller:
    """Return the controller as if x alone had been tuned."""
    both = tuned()
    of_certificate: dict[str, Any] = {
        part: {"x": getattr(both.certificate, part)["x"]} for part in ("domain", "margins", "continuous")
    }
    bare = replace(
        both.certificate, coupled=None, held=None, peaks=None, rotational_requirements=None, **of_certificate
    )
    predicted, axes = {"x": both.predicted["x"]}, {"x": both.axes["x"]}
    return replace(both, axes=axes, limits=None, predicted=predicted, certificate=bare)


def test_two_axes_of_one_payload_are_certified_together() -> None:
    found = certificate(tuned())
    assert found.groups == (("x", "ry"),)
    # |M_xy|/sqrt(m I) of 16 kg at 0.15 m, with the inertia that x has at the lever of 0.2 m.
    assert found.coupling == pytest.approx(16.0 * 0.15 / np.sqrt(16.0 * 16.0 * 0.2**2))
    assert set(found.body.missing) == {"y", "z", "rx", "rz"}
    assert found.spectral_radius < 1.0
    assert set(found.loops) == {"x", "ry"}
    assert found.points["x"]
    lines = list(coupled_lines(tuned()))
    assert lines[0].startswith("axes together (x–ry, coupled by 0.75")
    assert "y, z, rx, rz" in lines[-1]


def test_the_file_holds_it_and_validate_confirms_it_by_another_method(tmp_path: Path) -> None:
    path = tmp_path / "controller.yaml"
    write_controller(path, tuned())
    read = read_controller(path).controller
    assert read.certificate.coupled == tuned().certificate.coupled
    (check,) = check_coupled(read)
    assert check.passed, check.message
    assert "without a grid" in check.message


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"modulus": 0.9}, "smallest singular value"),
        ({"points": "softer"}, "harder by a second method"),
    ],
)
def test_a_claim_that_is_too_good_is_refused(changes: dict[str, Any], message: str) -> None:
    if "points" in changes:
        points = certificate(tuned()).points["x"]
        weaker = tuple(replace(each, peak_contact_force_n=0.9 * each.peak_contact_force_n) for each in points)
        changes = {"points": {"x": weaker}}
    (check,) = check_coupled(with_certificate(**changes))
    assert not check.passed
    assert message in check.message


def test_a_certificate_of_other_axes_is_refused() -> None:
    (check,) = check_coupled(with_certificate(axes=("x",)))
    assert not check.passed
    assert "tuned are x, ry" in check.message


@pytest.mark.parametrize("delays", ["as they are", "none"])
@pytest.mark.parametrize("surface", [None, wall(direction=np.array([1.0, 0.2]))])
def test_the_dense_step_matrix_has_the_same_poles(surface: PointSurface | None, delays: str) -> None:
    plant = cell(surface=surface)
    if delays == "none":
        # A command that acts at once and a coupling with damping: an algebraic loop through the force.
        plants = tuple(replace(each, robot=replace(each.robot, delay_s=0.0)) for each in plant.plants)
        plant = replace(plant, plants=plants)
    dense = build_dense_loop(plant, LAWS, PERIOD_S)
    poles = coupled_poles(build_coupled_loop(build_coupled_sampled_plant(plant, PERIOD_S), LAWS))[0]
    assert dense.radius() == pytest.approx(float(np.max(np.abs(poles))), abs=1e-10)


def test_what_is_proved_together_is_proved_again_from_the_file(tmp_path: Path) -> None:
    made = prove_together(tuned(), Prover(), ProofOptions(axes="together", budget_s=30.0))
    proof, at_commands, at_points, commands_at_points = certificate(made).proofs
    assert (proof.axes, proof.share, proof.points, proof.at) == (("x", "ry"), 1.0, {}, "force")
    assert at_commands == replace(proof, at="command", cells=at_commands.cells, run_time_s=at_commands.run_time_s)
    assert (commands_at_points.share, commands_at_points.at) == (1.0, "command")
    assert any("I + L at the commands above" in line for line in coupled_lines(made))
    assert proof.modulus == pytest.approx(0.95 * certificate(made).modulus)
    assert any("x–ry together:" in line and line.endswith("proved") for line in coupled_lines(made))
    assert (at_points.axes, at_points.share) == (("x", "ry"), 1.0)
    assert at_points.points == {"x": tuple(each.point_m for each in certificate(made).points["x"])}
    assert any("touching with 5 points" in line and line.endswith("proved") for line in coupled_lines(made))
    write_controller(tmp_path / "controller.yaml", made)
    read = read_controller(tmp_path / "controller.yaml").controller
    assert [check.passed for check in check_proofs(read, Prover())] == [True] * 4
    for place, each in enumerate((at_commands, at_points)):
        claims = [replace(each, modulus=0.9) if i == place else one for i, one in enumerate((at_commands, at_points))]
        higher = replace(certificate(made), proofs=tuple(claims))
        checks = check_proofs(replace(read, certificate=replace(read.certificate, coupled=higher)), Prover())
        assert [check.passed for check in checks] == [i != place for i in range(2)]


def test_what_is_proved_at_points_holds_on_drawn_surfaces_and_nothing_false_is_proved() -> None:
    """The modulus at both cuts on a grid of frequencies, and the poles of scipy's matrices, on drawn K_e."""
    made = prove_together(tuned(), Prover(), ProofOptions(axes="together", budget_s=30.0))
    *_, proof, at_commands = certificate(made).proofs
    assert (proof.at, at_commands.at, at_commands.modulus) == ("force", "command", proof.modulus)
    of = CoupledCell.of(made, certificate(made).body)
    names, rng, least = of.names, np.random.default_rng(11), np.full(2, np.inf)
    grid = np.geomspace(0.2, 0.99 * np.pi / of.sample_time_s, 1500)
    low, high = of.domains["x"].environment_stiffness_n_per_m
    for point in proof.points["x"]:
        for stiffness in (low, high, *rng.uniform(low, high, 3).tolist()):
            plant = of.plant(names, 16.0, of.surface_at(names, "x", point, stiffness))
            assert build_dense_loop(plant, of.law(names), of.sample_time_s).radius() < 1.0
            sampled = build_coupled_sampled_plant(plant, of.sample_time_s)
            found = coupled_sensitivities(sampled, of.law(names), of.scale(names), grid)
            least = np.minimum(least, 1.0 / np.max(np.linalg.norm(found, ord=2, axis=(-2, -1)), axis=1))
    assert proof.modulus < np.min(least) < 1.06 * proof.modulus
    for each, at in zip(least.tolist(), (at_commands, proof), strict=True):
        claimed = replace(certificate(made), proofs=(replace(at, modulus=1.005 * each),))
        (check,) = check_proofs(replace(made, certificate=replace(made.certificate, coupled=claimed)), Prover())
        assert not check.passed


def test_axes_that_are_unstable_together_are_refused_with_what_eases_it() -> None:
    with pytest.raises(InfeasibleError, match=r"unstable together .* Hz grows .* would make it stable.*--axes apart"):
        check_together(softer(0.4), two_axes())


def test_axes_that_hardly_act_on_each_other_keep_their_margins() -> None:
    controller, plant = moved(0.01)
    found = certificate(check_together(controller, plant).controller)
    assert found.groups == (("x",), ("ry",))
    assert found.modulus == found.modulus_apart
    assert 0.0 < found.neglected < 0.2
    assert "hardly act" in next(
        coupled_lines(replace(controller, certificate=replace(controller.certificate, coupled=found)))
    )


def test_an_axis_that_is_known_and_not_tuned_swings_along() -> None:
    only = with_x_alone()
    found = certificate(check_together(only, two_axes()).controller)
    assert (found.axes, set(found.body.held), found.groups) == (("x",), {"ry"}, (("x", "ry"),))
    (check,) = check_coupled(replace(only, certificate=replace(only.certificate, coupled=found)))
    assert check.passed, check.message


def test_what_is_not_known_is_named() -> None:
    plant = replace(two_axes(), axes={"x": two_axes().axes["x"]})
    assert check_together(with_x_alone(), plant).unchecked == "not known: y, z, rx, ry, rz"
    # A proof that was asked for by name is not left out in silence.
    together = TogetherCheck(TogetherAsked(identified=plant), ProofOptions(axes="together"))
    with pytest.raises(EstimateError, match="cannot be proved together \\(not known: y, z, rx, ry, rz\\)"):
        together(with_x_alone(), Prover())
    assert TogetherCheck(TogetherAsked(identified=plant), ProofOptions())(with_x_alone(), Prover()) == with_x_alone()
    unknown = replace(tuned(), payload=replace(tuned().payload, set_in_cell=True))
    assert "com_m" in check_together(unknown, plant).unchecked
    # 16 kg at 0.25 m are more than the 0.64 kg m² of the axis.
    assert "positive definite" in check_together(*moved(0.25)).unchecked


def body_of(identified: Identified, contact_points_m: Sequence[Vector] = ()) -> CoupledBody:
    controller = tuned()
    domains = {name: controller.certificate.domain[name] for name in controller.axes}
    found = coupled_body(domains, controller.payload, identified, contact_points_m)
    assert found is not None
    return found


def test_products_of_inertia_come_from_the_tensor_or_from_the_centre() -> None:
    third = replace(two_axes(), axes={**two_axes().axes, "rx": turned_axis()})
    body = body_of(third)
    x, y, _ = tuned().payload.com_m
    assert body.inertia_kg_m2["xy"] == pytest.approx(-16.0 * x * y)
    assert "inertia xy" in body.missing
    tensor = InertiaEstimate(xx=known(0.7), yy=known(0.6), zz=absent(), xy=known(0.011), xz=absent(), yz=absent())
    seen = body_of(replace(third, payload=replace(third.payload, inertia_kg_m2=tensor)))
    assert (seen.inertia_kg_m2["xy"], seen.inertia_kg_m2["xx"]) == (0.011, 0.7)
    assert seen.inertia_kg_m2["yy"] == pytest.approx(0.64)  # that of its own loop


def test_contact_points_are_those_that_are_given(tmp_path: Path) -> None:
    point = (0.1, 0.0, 0.4)
    (tmp_path / "problem.yaml").write_text("payload: {contact_points_m: [[0.1, 0, 0.4]]}\n", encoding="utf-8")
    spec = read_problem(tmp_path / "problem.yaml")
    assert spec.contact_points_m == (point,)
    found = certificate(check_together(tuned(), two_axes(), spec.contact_points_m).controller)
    assert [each.point_m for each in found.points["x"]] == [point]


def test_contact_points_of_the_cell_are_taken_where_the_problem_names_none(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("format: autotune/cell\nversion: 1\npayload: {contact_points_m: [[0.1, 0, 0.4]]}\n", "utf-8")
    points = read_cell(path).cell.payload.contact_points_m
    cell_of = two_axes()
    declared = replace(cell_of, payload=replace(cell_of.payload, contact_points_m=points))
    of_cell, of_problem = body_of(declared), body_of(declared, [(0.0, 0.2, 0.3)])
    assert (of_cell.contact_points_m, of_problem.contact_points_m) == (((0.1, 0.0, 0.4),), ((0.0, 0.2, 0.3),))
    write_identified(tmp_path / "identified.yaml", declared, {})
    assert read_identified(tmp_path / "identified.yaml").result.payload.contact_points_m == points
    path.write_text("format: autotune/cell\nversion: 1\npayload: {contact_points_m: [[0.1, 9, 0.4]]}\n", "utf-8")
    with pytest.raises(UsageError, match=r"contact_points_m"):
        read_cell(path)


def test_the_box_has_the_inertia_of_the_payload() -> None:
    """Of a uniform box with half edges a, b, c the moments are m (b² + c²)/3 and so on."""
    body = certificate(tuned()).body
    half = np.array([0.1, 0.15, 0.2])
    moments = 16.0 / 3.0 * (np.sum(half**2) - half**2)
    x, y, z = np.array(body.com_m) ** 2
    about = moments + 16.0 * np.array([y + z, x + z, x + y])
    inertia = {"xx": about[0], "yy": about[1], "zz": about[2]}
    boxed = CoupledCell.of(tuned(), replace(body, inertia_kg_m2=inertia))
    np.testing.assert_allclose(boxed.half_edges_m(), half, rtol=1e-9)
