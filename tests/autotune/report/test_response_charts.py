"""Bode pictures of robot and coupling: the measured points lie on the model's turn, inside their circles."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.charts.chart import Band, Chart, Line, Points
from autotune.formats.units import axis_units
from autotune.report.identify_charts import response_charts
from identification.measured_response import FrequencyResponse, measured_response
from identification.result import AxisEstimate
from tests.identification.merging.test_axis import SOFT, with_surfaces

PERIOD_S = 8e-4


def _estimate() -> AxisEstimate:
    """An axis with K_s 3e5, B_s 150, B_p 330, M_p 16.2 and ω 20 rad/s, T_d 2.4 ms, and responses of just these."""
    frequency = np.geomspace(0.5, 100.0, 40)
    s = 2j * np.pi * frequency
    pose = 20.0 / (s + 20.0) * np.exp(-2.4e-3 * s)
    spring, payload = 150.0 * s + 3e5, (16.2 * s + 330.0) * s
    felt = -spring * payload / (spring + payload)
    circles = [measured_response(frequency, each, 0.1 * np.abs(each), 0.1 * np.abs(each), 1) for each in (pose, felt)]
    response = FrequencyResponse(command_to_pose=circles[0], pose_to_force=circles[1])
    return replace(with_surfaces(SOFT).axes["x"], frequency_response=response)


def _panels(chart: Chart) -> list[tuple[Band, Points, Line]]:
    return [tuple(panel.elements) for panel in chart.panels]  # type: ignore[misc]  # three of these kinds


@pytest.mark.parametrize("which", [0, 1])
def test_points_and_model_are_one_curve_and_the_band_is_their_circle(which: int) -> None:
    chart = list(response_charts("x", axis_units("x"), _estimate(), PERIOD_S))[which]
    for number, (band, points, line) in enumerate(_panels(chart)):
        model = np.interp(points.x, line.x, line.y)
        # Between 400 points on a logarithmic scale the model is drawn straight.
        assert points.y == pytest.approx(model, rel=5e-3, abs=0.5)
        half = 0.1 * points.y if number == 0 else np.full(40, np.degrees(np.arcsin(0.1)))
        assert band.high - points.y == pytest.approx(half, rel=1e-4)
        assert points.y - band.low == pytest.approx(half, rel=1e-4)
    assert "40 frequencies from 0.5 to 100 Hz" in chart.alternative


def test_a_file_without_measured_responses_shows_the_model_alone() -> None:
    charts = list(response_charts("x", axis_units("x"), replace(_estimate(), frequency_response=None), PERIOD_S))
    assert len(charts) == 2
    for chart in charts:
        assert [[type(each) for each in panel.elements] for panel in chart.panels] == [[Line], [Line]]
        assert "no measured response" in chart.alternative
