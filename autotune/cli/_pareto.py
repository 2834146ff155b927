"""Options of `autotune optimize` for the proof and for a Pareto front, and the printed front."""

import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from autotune.errors import UsageError

from ._common import Output
from ._options import FiniteRange
from ._terminal import print_message, print_table

if TYPE_CHECKING:
    from autotune.formats.problem import ProblemSpec
    from autotune.studies.front import FrontRequest
    from autotune.studies.points import Front, Judgement, StudyRecord
    from autotune.tuning.optimize import Optimized
    from autotune.validation.axis_proof import ProofOptions

_USUAL_STEM = "controller"
_OPTIONS = ("objectives", "require", "choose", "storage", "study", "trials", "sampler")


def _names(_context: click.Context, _option: click.Parameter, text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(part.strip() for part in text.split(",") if part.strip())


_PARETO_OPTIONS = (
    click.option(
        "--pareto",
        is_flag=False,
        flag_value=7,
        default=None,
        type=click.IntRange(min=2, max=1000),
        metavar="[POINTS]",
        help="Also write pareto.yaml (of -o fast.yaml: fast.pareto.yaml): peak force against admittance, 7 points.",
    ),
    click.option("--objectives", callback=_names, metavar="A,B", help="Objectives of the front, searched by a study."),
    click.option(
        "--require",
        callback=_names,
        metavar="A,B=LIMIT",
        help="Requirements of the study, or objectives with a limit.",
    ),
    click.option(
        "--choose",
        callback=_names,
        metavar="A,B",
        help="Let the study choose discretization, compensation, lead or feedback.",
    ),
    click.option(
        "--storage",
        metavar="URL",
        help="The study's storage: sqlite:///FILE or postgresql+psycopg://...; default pareto.db beside pareto.yaml.",
    ),
    click.option("--study", metavar="NAME", help="Name of the study to begin or continue."),
    click.option("--trials", type=click.IntRange(min=1), metavar="N", help="Finished trials in all; 200 by default."),
    click.option("--sampler", type=click.Choice(["tpe", "nsga2"]), help="Sampler of the study; tpe by default."),
)


def pareto_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a front to a command that takes `seed`, and hand it `pareto`: a request, or None."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        options = {name: kwargs.pop(name) for name in _OPTIONS}
        points = kwargs.pop("pareto")
        return function(*args, pareto=_request(points, options, kwargs["seed"]), **kwargs)

    for option in reversed(_PARETO_OPTIONS):
        command = option(command)
    return command


def _request(points: int | None, options: Mapping[str, Any], seed: int) -> "FrontRequest | None":
    given = {name: value for name, value in options.items() if value is not None}
    if points is None:
        if given:
            raise click.UsageError(f"--{next(iter(given))} is an option of --pareto; add --pareto.")
        return None
    from autotune.studies.front import FrontRequest

    if "require" in given:
        given["demands"] = given.pop("require")
    if "choose" in given:
        given["choices"] = given.pop("choose")
    return FrontRequest(points=points, seed=seed, **given)


_PROOF_OPTIONS = (
    click.option(
        "--slack",
        type=FiniteRange(min=0.1, max=50.0),
        metavar="PERCENT",
        help="Prove a modulus margin this much below the swept one; 5 by default.",
    ),
    click.option(
        "--proof-budget",
        type=FiniteRange(min=0.0, max=1e6),
        metavar="SECONDS",
        help="Time for the proof over all uncertain parameters, about (10); 0 skips it.",
    ),
    click.option(
        "--axes",
        type=click.Choice(["apart", "checked", "together"]),
        help="Axes on one payload: checked together by default; together proves it, apart leaves it out.",
    ),
)
_PROOF_NAMES = ("slack", "proof_budget", "axes")


def proof_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options to a command and hand it `proof`: what is asked, or None."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        return function(*args, proof=_proof_options(*(kwargs.pop(each) for each in _PROOF_NAMES)), **kwargs)

    for option in reversed(_PROOF_OPTIONS):
        command = option(command)
    return command


def _proof_options(
    slack: float | None, budget_s: float | None, axes: Literal["apart", "checked", "together"] | None
) -> "ProofOptions | None":
    if slack is None and budget_s is None and axes is None:
        return None
    from autotune.validation.axis_proof import ProofOptions

    usual = ProofOptions()
    return ProofOptions(
        slack=usual.slack if slack is None else 0.01 * slack,
        budget_s=max(usual.budget_s, budget_s or 0.0),
        further_s=usual.further_s if budget_s is None else budget_s,
        axes=axes or usual.axes,
    )


class FrontWriter:
    """Carries a front through the command: prepared before the search, traced after it, then written and printed.

    Does nothing without a request; `tree` is empty until something was written.
    """

    def __init__(self, request: "FrontRequest | None", out: Path) -> None:
        self.path, self.tree = _beside(out, ".yaml"), dict[str, Any]()
        self._fronts: Mapping[str, Front] = {}
        self._prepared = None
        if request is not None:
            from autotune.formats.atomic import check_target
            from autotune.studies.front import prepare_fronts

            check_target(self.path, [])
            self._prepared = prepare_fronts(request, _beside(out, ".db"))

    def check(self, spec: "ProblemSpec") -> None:
        """Refuse a front of another structure than four gains, which pareto.yaml does not hold."""
        if self._prepared is not None and spec.structure == "biquad":
            raise UsageError(
                "A Pareto front is of four gains, and pareto.yaml holds no biquad; leave --structure biquad out."
            )
        if self._prepared is not None and spec.bumper is not None:
            raise UsageError("A Pareto front is of a payload in one piece; leave payload.bumper out of problem.yaml.")

    def trace(self, output: Output, found: "Optimized") -> None:
        """Trace the front of every axis."""
        if self._prepared is not None:
            from autotune.studies.front import trace_fronts

            with output.progress("tracing the front", 1.0) as advance:
                self._fronts = trace_fronts(self._prepared, found.searches, advance)

    def write(self, found: "Optimized") -> None:
        """Write the front."""
        if self._prepared is not None:
            from autotune.studies.pareto_file import pareto_tree, write_pareto

            provenance = {**found.controller.provenance, "front": self._prepared.request.options()}
            self.tree = pareto_tree(self._fronts, provenance)
            write_pareto(self.path, self.tree)

    def print(self) -> None:
        """Print the fronts as tables."""
        if self._fronts:
            print_fronts(self._fronts, self.path)


def _beside(out: Path, suffix: str) -> Path:
    """Return where the front of a controller goes: `pareto.yaml`, beside another `fast.yaml` `fast.pareto.yaml`."""
    return out.with_name(f"pareto{suffix}" if out.stem == _USUAL_STEM else f"{out.stem}.pareto{suffix}")


def print_fronts(fronts: Mapping[str, "Front"], path: Path) -> None:
    """Print the fronts as tables, a line per controller, and where they were written."""
    from autotune.formats.units import ROTATIONAL_AXES, axis_units

    for axis, front in fronts.items():
        units = axis_units(axis)
        names = " and ".join(each.name for each in front.objectives)
        study = front.study
        by = "" if study is None else _share(study)
        print_message(f"axis {axis}: front of {names}, every point in {front.scenario_count} scenarios{by}")
        named = [(each.name, each.unit_on(turning=axis in ROTATIONAL_AXES)) for each in front.objectives]
        heads = [f"{name} [{unit}]" if unit else name for name, unit in named]
        gains = [
            f"M_a [{units.mass}]",
            f"B_a [{units.damping}]",
            "K_l [ms]",
            "B_fb [ms]",
            "form",
            f"P̂ [{units.mass}]",
            "",
        ]
        rows = [
            (*_cells(front, point), "<- written" if index == front.chosen else "")
            for index, point in enumerate(front.points)
        ]
        count = len(heads)
        numbers = (*range(count + 4), count + 5)
        print_table([(*heads, *gains), *rows], left=(count + 4, count + 6), point=numbers, indent="  ", stacks=True)
    print_message(f"written: {path}")


def _share(study: "StudyRecord") -> str:
    share = 100.0 * study.feasible / study.trials
    percent = f"{share:.0f}" if share >= 1.0 else f"{share:.1g}"
    return f"; study {study.name}: {study.feasible} of {study.trials} trials feasible ({percent} %)"


def _cells(front: "Front", point: "Judgement") -> Iterator[str]:
    law = point.controller
    for objective in front.objectives:
        yield f"{point.values[objective.name]:.4g}"
    for gain in (law.mass_kg, law.damping_n_s_per_m, 1e3 * law.lead_s, 1e3 * law.feedback_damping_s):
        yield f"{gain:.6g}"
    yield law.discretization
    yield f"{law.compensation_mass_kg:g}"
