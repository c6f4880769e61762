"""Diagnosis of the sim-to-real gap: whether it exists, where it is, and which effects cause and close it."""

from yid_ocp.diagnosis.diagnose import diagnose as diagnose
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult as DiagnosisResult
from yid_ocp.diagnosis.refit import StoredFit as StoredFit
from yid_ocp.diagnosis.thresholds import Thresholds as Thresholds
