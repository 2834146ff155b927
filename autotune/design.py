"""What a design is, and what it predicts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.arguments import count, errors_in_arguments, file_path, in_arguments
from autotune.errors import CertificateError, UsageError
from autotune.formats.atomic import check_target
from autotune.formats.controller import ControllerFile, controller_tree, write_controller
from autotune.formats.controller_record import Controller
from autotune.formats.identified import IN_MEMORY
from autotune.formats.limits import Biquad
from autotune.formats.plant import Plant
from autotune.formats.units import axis_units
from autotune.formats.yaml12 import dump_yaml
from autotune.processes import MOST_SAMPLES
from autotune.results import Identification, Validation
from autotune.shown import Progress, ResultTable, Shown, data_frame, reporting
from autotune.text import NOTHING_BEFORE, scenario_text, stiffness_text
from problems.design.uncertainty import SYMBOLS, Scenario
from problems.errors import shown
from problems.model.axis_kind import AxisKind

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from autotune.charts.show import AxesLike
    from autotune.prediction.before_after import BeforeAndAfter
    from autotune.prediction.result import PredictedContact
    from autotune.report.axis_design import AxisDesign
    from autotune.tuning.optimize import Optimized
    from problems.model.plant import Bumper


@dataclass(frozen=True, kw_only=True, repr=False)
class Design(Shown):
    """A controller with what it is predicted to do and what its certificate says.

    Attributes
    ----------
    controller
        Everything that `controller.yaml` holds.
    optimized
        The searches behind it; None for a design that was loaded from a file.
    file
        The file that it was loaded from; None for a design that was optimized.

    """

    controller: Controller
    optimized: "Optimized | None" = field(default=None, compare=False)
    file: ControllerFile | None = field(default=None, compare=False)

    @cached_property
    def _axes(self) -> "dict[str, AxisDesign]":
        from autotune.report.axis_design import axis_designs  # noqa: PLC0415 - compiles nothing until asked

        return {each.name: each for each in axis_designs(self.controller)}

    def _axis(self, axis: str | None) -> "AxisDesign":
        if axis is None and len(self._axes) == 1:
            return next(iter(self._axes.values()))
        if axis is None or axis not in self._axes:
            held = ", ".join(self._axes)
            found = "no axis was named" if axis is None else f"it does not hold axis {axis}"
            raise UsageError(f"The design holds the axes {held}, and {found}; say axis=… with one of them.")
        return self._axes[axis]

    @property
    def gains(self) -> dict[str, dict[str, float]]:
        """The gains by axis: mass [kg, kg·m²], damping [N·s/m, N·m·s/rad], lead [s], feedback_damping [s]."""
        return {
            name: {
                "mass": each.mass,
                "damping": each.damping,
                "lead": each.lead_s,
                "feedback_damping": each.feedback_damping_s,
            }
            for name, each in self.controller.axes.items()
        }

    @property
    def peak_force(self) -> float:
        """Largest predicted force at the surface over all axes [N, N·m] of all contacts of the certificate.

        Of a design for an export target that of the law which the target runs.
        """
        from autotune.prediction.as_run_by import as_run_by  # noqa: PLC0415 - compiles

        targets = [as_run_by(self.controller, name) for name in self.controller.axes]
        peaks = [each.peak for each in targets if each is not None]
        own = (each.peak_contact_force_n for p in self.controller.predicted.values() for each in p.scenarios)
        return max(peaks or own)

    @property
    def before_after(self) -> dict[str, str]:
        """What the design changes, a sentence by axis: on the contacts of the log, and in free motion."""
        recorded = self.controller.provenance.get("before_after", {})
        texts = {name: str(recorded[name]["text"]) if name in recorded else NOTHING_BEFORE for name in self.gains}
        return {name: in_arguments(text) for name, text in texts.items()}

    def compare(
        self, plant: Identification | Plant, gains: "Mapping[str, Any] | Design | str | Path | None" = None
    ) -> "dict[str, BeforeAndAfter]":
        """Replay the contacts of a log with this design, beside what was measured.

        Parameters
        ----------
        plant
            What `identify` returned, with the contacts of the log.
        gains
            What runs today, as `compare` of `autotune.optimize`; those in the log unless they are said.

        Returns
        -------
        dict of str to BeforeAndAfter
            By axis: prints as a table, and draws itself with `plot()`.

        """
        from autotune.prediction.before_after import compare_before_after  # noqa: PLC0415 - compiles
        from autotune.prediction.said_gains import present_gains  # noqa: PLC0415

        if not isinstance(plant, Identification | Plant):
            raise UsageError(f"plant must be what identify returns or a Plant, found {shown(plant)}.")
        file, said = plant.file(), gains.as_file() if isinstance(gains, Design) else gains
        with errors_in_arguments(compare="gains"):
            found = compare_before_after(file, self.controller, present=present_gains(said, file, tuple(self.gains)))
        return {
            name: replace(each, example=in_arguments(each.example, compare="gains")) for name, each in found.items()
        }

    def _headline(self) -> str:
        biquads = {name: each.biquad for name, each in self.controller.axes.items()}
        listed = "; ".join(_gains_text(name, gains, biquads[name]) for name, gains in self.gains.items())
        return f"Design, {self.controller.status.value}: {listed}"

    def _answers(self) -> Sequence[str]:
        return [f"before → after, axis {name}: {text}" for name, text in self.before_after.items()]

    def _tables(self) -> Iterator[ResultTable]:
        rows = tuple(
            (
                name,
                *(f"{g[key]:.4g}" for key in ("mass", "damping")),
                *(f"{1e3 * g[key]:.4g}" for key in ("lead", "feedback_damping")),
            )
            for name, g in self.gains.items()
        )
        kinds = list(dict.fromkeys(map(axis_units, self.gains)))
        mass, damping = (", ".join(units) for units in ([k.mass for k in kinds], [k.damping for k in kinds]))
        columns = ("axis", f"M_a [{mass}]", f"B_a [{damping}]", "K_l [ms]", "B_fb [ms]")
        yield ResultTable(title="gains", columns=columns, rows=rows)
        yield ResultTable(
            title="smallest margins over the domain",
            columns=("axis", "modulus", "gain [dB]", "phase [°]", "delay [ms]"),
            rows=tuple(
                (name, f"{m.modulus:.3f}", _finite(m.gain_db), _finite(m.phase_deg), _finite(m.delay_s, 1e3))
                for name, m in self.controller.certificate.margins.items()
            ),
        )
        for name, prediction in self.controller.predicted.items():
            units = axis_units(name)
            yield ResultTable(
                title=f"predicted contacts of axis {name}",
                columns=(
                    "plant",
                    f"peak at the surface [{units.force}]",
                    f"at the sensor [{units.force}]",
                    "after [ms]",
                ),
                rows=tuple(
                    (
                        scenario_text(each.scenario(), units),
                        f"{each.peak_contact_force_n:.4g}",
                        f"{each.peak_sensor_force_n:.4g}",
                        f"{1e3 * each.time_of_peak_s:.3g}",
                    )
                    for each in prediction.scenarios
                ),
            )
        certificate = self.controller.certificate
        for title, claims in (
            ("proved", (*certificate.proved, *certificate.proved_further)),
            ("sampled, not proved", (*certificate.sampled, *certificate.sampled_further)),
        ):
            yield ResultTable(
                title=title,
                columns=("claim", "over", "method"),
                rows=tuple((each.claim, each.over_text(), each.method) for each in claims),
            )
        yield self._proved_margins()

    def _proved_margins(self) -> ResultTable:
        """Return on what share of its plants the modulus margin of each axis is proved, 0 % where it is nowhere."""
        regions = self.controller.certificate.continuous or {}
        rows = [
            (
                name,
                f"{each.modulus:.4g}",
                f"{100.0 * each.share:.4g} %",
                ", ".join(SYMBOLS[parameter] for parameter in each.over),
                " to ".join(stiffness_text(end, axis_units(name)) for end in each.environment_stiffness_n_per_m),
            )
            for name in self.gains
            for each in regions.get(name, ())
        ]
        rows += [(name, "none", "0 %", "", "") for name in self.gains if name not in regions]
        columns = ("axis", "modulus", "of the plants", "over the ranges of", "all for K_e")
        return ResultTable(title="modulus margin proved at all frequencies", columns=columns, rows=tuple(rows))

    @property
    def notes(self) -> tuple[str, ...]:
        """What should not be overlooked, a sentence each, of a loaded design too."""
        from autotune.prediction.as_run_by import own_law_notes  # noqa: PLC0415 - compiles

        return (*own_law_notes(self.controller), *self.controller.provenance.get("notes", ()))

    def _notes(self) -> Sequence[str]:
        return self.notes

    def summary(self) -> None:
        """Print what it changes, gains, margins, predicted contacts, what is proved, and what not to overlook.

        It returns nothing: call it, do not print it.
        """
        for line in self._answers():
            print(line)
        print()
        print(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the tree of `controller.yaml`."""
        return controller_tree(self.controller)

    def as_file(self) -> ControllerFile:
        """Return it as a file is handed on: the one that it was loaded from, or as `save` would write it."""
        if self.file is not None:
            return self.file
        tree = self.to_dict()
        digest = sha256(dump_yaml(tree).encode()).hexdigest()
        return ControllerFile(controller=self.controller, checksum=tree["checksum"], path=IN_MEMORY, sha256=digest)

    def to_pandas(self) -> Any:
        """Return the predicted contacts of all axes as a pandas.DataFrame; raises UsageError without pandas."""
        rows = [(name, each) for name, p in self.controller.predicted.items() for each in p.scenarios]
        columns = {"axis": [name for name, _ in rows]}
        for field_name in _PREDICTED:
            columns[field_name] = [getattr(each, field_name) for _, each in rows]
        return data_frame(columns)

    def save(self, path: Path | str) -> str:
        """Write `controller.yaml` in one step and return its checksum.

        Raises
        ------
        UsageError
            The file cannot be written, or a file of another kind would be lost.

        """
        target = file_path("path", path)
        source = self.optimized or self.file
        if source is not None and source.controller != self.controller:
            raise CertificateError("The controller was changed after its certificate was made; optimize it again.")
        check_target(target, kind="controller", option="path")
        return write_controller(target, self.controller)

    def validate(self, *, samples: int = 256, seed: int = 1, progress: Progress = None) -> Validation:
        """Verify every claim again, by other code than the search's, as `autotune validate` does.

        Parameters
        ----------
        samples
            How many plants of the certified set are simulated with deadband, noise, clipping and late commands, or 0.
        seed
            Which plants, and which noise.
        progress
            True for a bar, or a callable that takes the share of the work done since its last call.

        Returns
        -------
        Validation
            One check each; nothing is raised for one that fails (`Validation.require` does).

        """
        from autotune.validation.verify import verify  # noqa: PLC0415 - what validates is not needed before

        samples, seed = count("samples", samples, most=MOST_SAMPLES), count("seed", seed)
        with reporting(progress, "validating", 2.0 if samples else 1.0) as report:
            return Validation(checks=verify(self.controller, samples=samples, seed=seed, progress=report).checks)

    def to_control(
        self, axis: str | None = None, *, environment_stiffness: float | None = None, payload_mass: float | None = None
    ) -> Any:
        """Return the loop of one axis as python-control objects.

        Parameters
        ----------
        axis
            Which one; may be left out where there is one.
        environment_stiffness
            K_e [N/m, N·m/rad]; the stiff end of the domain unless it is said.
        payload_mass
            M_p [kg, kg·m²]; the light end of the domain unless it is said.

        Returns
        -------
        problems.model.python_control.ControlObjects
            Continuous blocks `robot`, `coupling`, `payload` … and the exact sampled loops `at_force`, `at_command` and
            `closed_loop` as state spaces with named signals (docs/method.md, "The loop").

        """
        from problems.model.python_control import to_control  # noqa: PLC0415 - python-control takes seconds to import
        from problems.model.sampled import build_sampled_plant  # noqa: PLC0415

        design = self._axis(axis)
        plant = design.plant(self._scenario(design, environment_stiffness, payload_mass))
        return to_control(build_sampled_plant(plant, design.sample_time_s), design.law)

    def _scenario(self, design: "AxisDesign", stiffness: float | None, mass: float | None) -> Scenario:
        stiff = design.domain.environment_stiffness_n_per_m[1]
        return Scenario(
            environment_stiffness_n_per_m=stiff if stiffness is None else stiffness,
            payload_mass_kg=design.domain.payload_mass_kg[0] if mass is None else mass,
        )

    def predict(
        self,
        *,
        environment_stiffness: float | None = None,
        payload_mass: float | None = None,
        approach_speed: float | None = None,
        approach_force: float | None = None,
        axis: str | None = None,
        bumper: "Bumper | None" = None,
    ) -> "PredictedContact":
        """Predict one contact; see `autotune.predict`."""
        from autotune.prediction.certified import predict_certified  # noqa: PLC0415 - compiles

        if environment_stiffness is None:
            raise UsageError("A design is predicted on a surface; say environment_stiffness=… [N/m, N·m/rad].")
        return predict_certified(
            self.controller,
            self._axis(axis).name,
            environment_stiffness,
            payload_mass=payload_mass,
            approach_speed=approach_speed,
            approach_force=approach_force,
            bumper=bumper,
        )

    def plot_contact(self, axis: str | None = None, *, ax: "AxesLike | None" = None) -> "Figure":
        """Draw the predicted contact with the highest peak, and the band of all of them.

        Raises UsageError where several axes are there and none is named.
        """
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib
        from autotune.report.controller_charts import contact_chart  # noqa: PLC0415

        chart = contact_chart(self._axis(axis))
        if chart is None:
            raise UsageError("The design predicts no contact that could be drawn.")
        return show(chart, ax)

    def plot_nyquist(self, axis: str | None = None, *, ax: "AxesLike | None" = None) -> "Figure":
        """Draw L, cut at the force and at the command, and the disk that it must not enter; on one `ax` the force."""
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib
        from autotune.report.controller_charts import nyquist_chart  # noqa: PLC0415

        return show(nyquist_chart(self._axis(axis), None), ax)

    def plot_bode(self, axis: str | None = None, *, ax: "AxesLike | None" = None) -> "Figure":
        """Draw gain and phase of the open loop, cut at the force, over frequency; on one `ax` the gain."""
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib
        from autotune.figures import bode_chart  # noqa: PLC0415

        return show(bode_chart(self._axis(axis)), ax)

    def plot_map(
        self, x: str = "damping", y: str = "lead", axis: str | None = None, *, ax: "AxesLike | None" = None
    ) -> "Figure":
        """Draw the smallest modulus margin over two of the gains, with the design in them.

        Parameters
        ----------
        x, y
            Two of `mass`, `damping`, `lead` and `feedback_damping`; `lead_s` as in `autotune map` will do too.
        axis
            Which one; may be left out where there is one.
        ax
            Axes to draw on; None for a figure of its own.

        """
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib
        from autotune.report.controller_charts import gain_map_chart  # noqa: PLC0415

        return show(gain_map_chart(self._axis(axis), x, y), ax)


_PREDICTED = (
    "environment_stiffness_n_per_m",
    "payload_mass_kg",
    "peak_contact_force_n",
    "peak_sensor_force_n",
    "time_of_peak_s",
)


def _gains_text(name: str, gains: Mapping[str, float], biquad: Biquad | None) -> str:
    units: AxisKind = axis_units(name)
    return (
        f"axis {name}: M_a {gains['mass']:.4g} {units.mass}, B_a {gains['damping']:.4g} {units.damping}, "
        f"K_l {1e3 * gains['lead']:.4g} ms, B_fb {1e3 * gains['feedback_damping']:.4g} ms"
        f"{'' if biquad is None else f', biquad: {biquad.describe()}'}"
    )


def _finite(value: float | None, scale: float = 1.0) -> str:
    return "no limit" if value is None else f"{scale * value:.4g}"
