"""Diagnosis of the sim-to-real gap: is there one, where, which unmodelled effect makes it, how far it closes."""

from yid_ocp.diagnosis.diagnose import diagnose as diagnose
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult as DiagnosisResult
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem as AllCandidatesProblem
from yid_ocp.diagnosis.localise import GapLocation as GapLocation
from yid_ocp.diagnosis.localise import localise_gap as localise_gap
from yid_ocp.diagnosis.refit import StoredFit as StoredFit
from yid_ocp.diagnosis.refit import refit_with_effects as refit_with_effects
from yid_ocp.diagnosis.screening import candidate_detectability as candidate_detectability
from yid_ocp.diagnosis.screening import confusability_matrix as confusability_matrix
from yid_ocp.diagnosis.screening import linearize_candidates as linearize_candidates
from yid_ocp.diagnosis.screening import score_candidates as score_candidates
from yid_ocp.diagnosis.screening import score_candidates_jointly as score_candidates_jointly
from yid_ocp.diagnosis.select import held_out_gap_closure as held_out_gap_closure
from yid_ocp.diagnosis.thresholds import Thresholds as Thresholds
