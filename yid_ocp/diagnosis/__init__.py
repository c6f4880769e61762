"""Diagnosis of the sim-to-real gap: whether it exists, where it is, and which effects cause and close it.

Names load on first use, because settings of all commands contain `Thresholds`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from yid_ocp.diagnosis.thresholds import Thresholds as Thresholds

if TYPE_CHECKING:
    from yid_ocp.diagnosis.diagnose import diagnose as diagnose
    from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult as DiagnosisResult
    from yid_ocp.diagnosis.refit import StoredFit as StoredFit


def __getattr__(name: str) -> Any:
    homes = {"diagnose": "diagnose", "DiagnosisResult": "diagnosis_result", "StoredFit": "refit"}
    if name in homes:
        return getattr(import_module(f"{__name__}.{homes[name]}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
