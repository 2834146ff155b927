"""Contacts and fitted signals of a log: every contact is told, and what is drawn is what was measured."""

import numpy as np
import pytest

from autotune.charts.chart import Heat, Line
from autotune.formats.units import axis_units
from autotune.report.identify_charts import (
    contact_charts,
    contact_table,
    contacts_seen,
    correlation_chart,
    residual_charts,
)
from identification.evidence import AxisEvidence
from identification.joint_fit.result import FittedSpan
from identification.result import Covariance

PERIOD_S = 1e-3
COUNT = 11


def touched() -> AxisEvidence:
    """Eleven contacts, the k-th with a peak of 10 + k at 100 ms, the model 2 % above; then a free span."""
    shape = np.sin(np.pi * np.arange(400) / 200.0)
    spans = [
        FittedSpan(
            start=2000 * k, surface=0, measured=-(10.0 + k) * shape, predicted=-1.02 * (10.0 + k) * shape, white=shape
        )
        for k in range(COUNT)
    ]
    free = FittedSpan(start=40_000, surface=None, measured=shape, predicted=shape, white=shape)
    return AxisEvidence(spans=(free, *reversed(spans)))


def test_every_contact_is_in_the_table_and_the_strongest_are_drawn_on_one_scale() -> None:
    units, seen = axis_units("x"), contacts_seen(touched(), 0)
    table = contact_table("x", units, [("x1", seen)], PERIOD_S)
    assert len(table.rows) == COUNT
    texts = [[cell.text for cell in row] for row in table.rows]
    assert texts[0][:5] == ["0.10", "x1", "10", "10.2", "+2.0"]
    # RMS of 0.02 · 10 · sin over whole waves is 0.2/√2, written with three digits.
    assert float(texts[0][5]) == pytest.approx(0.2 / np.sqrt(2.0), rel=5e-3)
    assert [float(row[0]) for row in texts] == pytest.approx([2.0 * k + 0.1 for k in range(COUNT)])
    charts = list(contact_charts("x", units, "x1", seen, PERIOD_S))
    panels = [panel for chart in charts for panel in chart.panels]
    assert [len(chart.panels) for chart in charts] == [3, 3, 3]
    assert [panel.title for panel in panels] == [f"at {2.0 * k + 0.1:.1f} s" for k in range(2, COUNT)]
    assert len({panel.y.limits for panel in panels}) == 1
    for k, panel in enumerate(panels, 2):
        measured, model = (each for each in panel.elements if isinstance(each, Line))
        assert (measured.label, model.label) == ("measured", "model")
        assert measured.y[measured.x == 0.0] == pytest.approx(-(10.0 + k))
        low, high = panel.y.limits or (0.0, 0.0)
        assert low < np.min(model.y)
        assert np.max(model.y) < high
    assert "the table has all" in charts[-1].caption
    assert list(contact_charts("x", units, "x2", contacts_seen(touched(), 1), PERIOD_S)) == []


def test_the_fitted_signal_stands_above_what_the_model_leaves_of_it_also_of_a_turn() -> None:
    chart = next(iter(residual_charts("rz", axis_units("rz"), touched(), PERIOD_S)))
    signal, left = chart.panels
    assert signal.y.label == "torque [N·m]"
    measured, model = (each for each in signal.elements if isinstance(each, Line))
    (residual,) = (each for each in left.elements if isinstance(each, Line))
    assert np.nanmin(measured.y) == pytest.approx(-20.0)
    assert residual.y == pytest.approx(measured.y - model.y, nan_ok=True)


def test_correlations_are_rounded_to_what_is_written_and_none_is_minus_zero() -> None:
    names = ("K_s", "omega")
    covariance = Covariance(names=names, values=(1.0, 1.0), matrix=((4.0, -0.004), (-0.004, 1.0)))
    chart = correlation_chart("x", covariance)
    (heat,) = (each for each in chart.panels[0].elements if isinstance(each, Heat))
    assert heat.values.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert not np.any(np.signbit(heat.values))
    assert heat.names == (("K_s", "robot ω"), ("K_s", "robot ω"))
    assert "the pole of the model" in chart.caption
