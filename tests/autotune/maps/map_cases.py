"""Sources that several tests read, and what is made of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from autotune.formats.controller_record import Controller
from autotune.formats.limits import CollisionResponse
from autotune.maps.options import MapOptions
from autotune.maps.setup import MapSetup, build_setup
from autotune.maps.source import MapSource, read_source
from identification.result import Estimate, Identified, Status
from problems.maps.maps import MapRequest, MapResult, compute_map
from tests.autotune.formats.samples import make_controller, make_identified


def controller_file() -> Controller:
    """A controller whose collision response is none, so that everything in it is part of the loop."""
    made = make_controller(("x",))
    return replace(made, collision=replace(made.collision, response=CollisionResponse.NONE, threshold_n=None))


def identified() -> Identified:
    """The sample plant with its drag known."""
    found = make_identified()
    drag = Estimate(value=630.0, std=1.0, status=Status.IDENTIFIED)
    return replace(found, axes={"x": replace(found.axes["x"], drag_n_s_per_m=drag)})


def read(path: Path, axis: str | None = None, controller: Path | None = None) -> MapSource:
    return read_source(path, axis=axis, controller=controller)


def plan_of(folder: Path, source: str = "controller.yaml", **asked: Any) -> MapSetup:
    axis = asked.pop("axis", None)
    options = MapOptions(source=folder / source, picture=folder / "map.svg", axis=axis, **asked)
    return build_setup(options, read(options.source, axis, options.controller))


def small_map(folder: Path, show: str = "delay") -> tuple[MapSetup, MapResult]:
    setup = plan_of(folder, show=show, x="damping=50:8000:7", y="lead_s=0:0.06:5", where="free_space")
    assert isinstance(setup.request, MapRequest)
    return setup, compute_map(setup.request)
