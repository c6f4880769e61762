"""Identification of the stiffness of flexible objects from robot recordings, and diagnosis of the sim-to-real gap.

Each name is imported on its first use, so that `import yid_ocp` and `yid-ocp --help` are quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from yid_ocp.analysis.estimation import solve as solve
    from yid_ocp.analysis.identifiability import identifiability as identifiability
    from yid_ocp.analysis.what_if import what_if as what_if
    from yid_ocp.config.reader import load_config as load_config
    from yid_ocp.data import Recording as Recording
    from yid_ocp.data import read_recording as read_recording
    from yid_ocp.data import write_recording as write_recording
    from yid_ocp.data.readers import read_any as read_any
    from yid_ocp.diagnosis.diagnose import diagnose as diagnose
    from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult as DiagnosisResult
    from yid_ocp.errors import YidError as YidError
    from yid_ocp.integrator.step import compile_step as compile_step
    from yid_ocp.integrator.step import simulate as simulate
    from yid_ocp.model import FlexibleSegment as FlexibleSegment
    from yid_ocp.model import Grasp as Grasp
    from yid_ocp.model import System as System
    from yid_ocp.model import flexible_object as flexible_object
    from yid_ocp.problem import EstimationProblem as EstimationProblem
    from yid_ocp.problem import ProblemOptions as ProblemOptions
    from yid_ocp.problem import SensorOptions as SensorOptions
    from yid_ocp.solvers import GaussNewton as GaussNewton
    from yid_ocp.solvers import MultipleShooting as MultipleShooting
    from yid_ocp.solvers import SingleShooting as SingleShooting
    from yid_ocp.solvers import Solution as Solution
    from yid_ocp.solvers import Status as Status
    from yid_ocp.solvers import SteepestDescent as SteepestDescent
    from yid_ocp.solvers.symbolic_transcription import transcribe as transcribe
    from yid_ocp.workflow.build import load_system as load_system
    from yid_ocp.workflow.build_problem import load_problem as load_problem
    from yid_ocp.workflow.run_history import read_estimates as read_estimates

    __version__: str

# each entry is also imported above
_HOMES: dict[str, tuple[str, ...]] = {
    "analysis.estimation": ("solve",),
    "analysis.identifiability": ("identifiability",),
    "analysis.what_if": ("what_if",),
    "config.reader": ("load_config",),
    "data": ("Recording", "read_recording", "write_recording"),
    "data.readers": ("read_any",),
    "diagnosis.diagnose": ("diagnose",),
    "diagnosis.diagnosis_result": ("DiagnosisResult",),
    "errors": ("YidError",),
    "integrator.step": ("compile_step", "simulate"),
    "model": ("Grasp", "FlexibleSegment", "System", "flexible_object"),
    "problem": ("EstimationProblem", "ProblemOptions", "SensorOptions"),
    "solvers.symbolic_transcription": ("transcribe",),
    "workflow.run_history": ("read_estimates",),
    "workflow.build": ("load_system",),
    "workflow.build_problem": ("load_problem",),
    "solvers": ("GaussNewton", "MultipleShooting", "SingleShooting", "Solution", "Status", "SteepestDescent"),
}
_MODULE_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_MODULE_OF)]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module(f"{__name__}.version").package_version()
    if name in _MODULE_OF:
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    what = f"module '{__name__}' has no attribute '{name}'. It has {', '.join(sorted(_MODULE_OF))}"
    raise AttributeError(what, name=name, obj=import_module(__name__))  # for the nearest name in a traceback


def __dir__() -> list[str]:
    return __all__
