"""From a log of a robot cell, or a plant in a few numbers, to an admittance controller that is proved stable.

>>> import autotune as at
>>> plant = at.identify(at.read_log("run7.mcap"))                                          # doctest: +SKIP
>>> design = at.optimize(plant, payload_mass=(10, 22), environment_stiffness=(2e4, 5e5))   # doctest: +SKIP

All numbers are in SI. Everything here is imported on first use: `import autotune` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from autotune.api import (
        from_control,
        identify,
        load,
        optimize,
        predict,
    )
    from autotune.campaign.result import Campaign, run_campaign
    from autotune.design import Design
    from autotune.errors import AutotuneError, CertificateError, InfeasibleError, UsageError
    from autotune.formats.plant import Plant
    from autotune.formats.problem import ProblemSpec as Problem
    from autotune.formats.quantity import Uncertain
    from autotune.formats.robot import Robot
    from autotune.log import Log, read_log, simulate_log
    from autotune.prediction.result import PredictedContact
    from autotune.results import Identification, Validation
    from autotune.validation.report import Check
    from autotune.version import __version__
    from identification.errors import EstimateError, LogError
    from identification.result import Estimate, Finding, Status
    from problems.contact.transient import Approach
    from problems.design.requirements import (
        AdmittanceTarget,
        ContactAtSpeed,
        MultiplicativeError,
        NoiseLimit,
        PassivityTarget,
        Requirements,
    )
    from problems.errors import ParameterError
    from problems.model.plant import Bumper
    from problems.stability.margins import UnstableLoopError

_HOMES: dict[str, tuple[str, ...]] = {
    "autotune.api": ("from_control", "identify", "load", "optimize", "predict"),
    "autotune.campaign.result": ("Campaign", "run_campaign"),
    "autotune.design": ("Design",),
    "autotune.errors": ("AutotuneError", "CertificateError", "InfeasibleError", "UsageError"),
    "autotune.formats.plant": ("Plant",),
    "autotune.formats.robot": ("Robot",),
    "autotune.formats.quantity": ("Uncertain",),
    "autotune.formats.problem": ("Problem",),
    "autotune.log": ("Log", "read_log", "simulate_log"),
    "autotune.prediction.result": ("PredictedContact",),
    "autotune.results": ("Identification", "Validation"),
    "autotune.validation.report": ("Check",),
    "autotune.version": ("__version__",),
    "identification.errors": ("EstimateError", "LogError"),
    "identification.result": ("Estimate", "Finding", "Status"),
    "problems.contact.transient": ("Approach",),
    "problems.design.requirements": (
        "AdmittanceTarget",
        "ContactAtSpeed",
        "MultiplicativeError",
        "NoiseLimit",
        "PassivityTarget",
        "Requirements",
    ),
    "problems.errors": ("ParameterError",),
    "problems.model.plant": ("Bumper",),
    "problems.stability.margins": ("UnstableLoopError",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
_OTHER_NAMES = {"Problem": "ProblemSpec"}

__all__ = [
    "AdmittanceTarget",
    "Approach",
    "AutotuneError",
    "Bumper",
    "Campaign",
    "CertificateError",
    "Check",
    "ContactAtSpeed",
    "Design",
    "Estimate",
    "EstimateError",
    "Finding",
    "Identification",
    "InfeasibleError",
    "Log",
    "LogError",
    "MultiplicativeError",
    "NoiseLimit",
    "ParameterError",
    "PassivityTarget",
    "Plant",
    "PredictedContact",
    "Problem",
    "Requirements",
    "Robot",
    "Status",
    "Uncertain",
    "UnstableLoopError",
    "UsageError",
    "Validation",
    "__version__",
    "from_control",
    "identify",
    "load",
    "optimize",
    "predict",
    "read_log",
    "run_campaign",
    "simulate_log",
]


if not TYPE_CHECKING:  # else every misspelled name would have a type

    def __getattr__(name: str) -> Any:
        """Import a public name on its first use."""
        if name not in _HOME_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(_HOME_OF[name]), _OTHER_NAMES.get(name, name))
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(__all__)
