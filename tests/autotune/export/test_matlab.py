"""The MATLAB file holds the loop whose margin the certificate states, and the same bytes each time."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from autotune.export.export import export_controller
from autotune.formats.controller import write_controller
from tests.autotune.tuning.cases import small_controller


def test_the_loop_in_the_file_has_the_margins_of_its_certificate(tmp_path: Path) -> None:
    controller = small_controller()
    write_controller(tmp_path / "controller.yaml", controller)
    for name in ("one.mat", "two.mat"):
        export_controller(tmp_path / "controller.yaml", "mat", tmp_path / name)
    assert (tmp_path / "one.mat").read_bytes() == (tmp_path / "two.mat").read_bytes()
    content = loadmat(tmp_path / "one.mat", simplify_cells=True)
    axis = content["axis_x"]
    assert axis["gains"]["damping"] == controller.axes["x"].damping
    h = content["sample_time_s"]
    z = np.exp(1j * 2.0 * np.pi * np.geomspace(0.05, 0.499 / h, 20_000) * h)
    smallest = []
    for place in ("contact", "free_space"):
        loop = axis[place]["at_force"]
        a, b, c = loop["A"], np.reshape(loop["B"], (-1, 1)), np.reshape(loop["C"], (1, -1))
        values, vectors = np.linalg.eig(a)
        left, right = (c @ vectors).ravel(), np.linalg.solve(vectors, b).ravel()
        response = loop["D"] + np.sum(left * right / (z[:, None] - values), axis=1)
        smallest.append(float(np.min(np.abs(1.0 + response))))
    # The certificate's margin is the smallest over more plants and both places where the loop may be cut.
    assert min(smallest) >= controller.certificate.margins["x"].modulus * (1.0 - 1e-3)
    assert min(smallest) < 1.0
    numerator, denominator = (axis["contact"]["robot"][part] for part in ("num", "den"))
    assert np.ravel(numerator)[-1] / np.ravel(denominator)[-1] == pytest.approx(1.0)  # r(0) = 1


def test_a_file_of_matlab_itself_is_not_replaced(tmp_path: Path) -> None:
    from autotune.errors import UsageError

    write_controller(tmp_path / "controller.yaml", small_controller())
    (tmp_path / "own.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: PCWIN64".ljust(128))
    with pytest.raises(UsageError, match="not replaced"):
        export_controller(tmp_path / "controller.yaml", "mat", tmp_path / "own.mat")
