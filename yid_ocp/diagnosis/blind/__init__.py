"""Blind validation: diagnoses of synthetic recordings whose true effects stay sealed until they are scored."""

from yid_ocp.diagnosis.blind.ensemble import ENSEMBLE_PURPOSES as ENSEMBLE_PURPOSES
from yid_ocp.diagnosis.blind.ensemble import BlindCase as BlindCase
from yid_ocp.diagnosis.blind.ensemble import CaseGenerator as CaseGenerator
from yid_ocp.diagnosis.blind.ensemble import CaseLabel as CaseLabel
from yid_ocp.diagnosis.blind.ensemble import PlannedCase as PlannedCase
from yid_ocp.diagnosis.blind.ensemble import RecordingConditions as RecordingConditions
from yid_ocp.diagnosis.blind.ensemble import best_possible_closure as best_possible_closure
from yid_ocp.diagnosis.blind.ensemble import diagnose_case as diagnose_case
from yid_ocp.diagnosis.blind.ensemble import finer_chain_parameters as finer_chain_parameters
from yid_ocp.diagnosis.blind.ensemble import initial_joint_positions as initial_joint_positions
from yid_ocp.diagnosis.blind.ensemble import open_sealed_labels as open_sealed_labels
from yid_ocp.diagnosis.blind.ensemble import plan_cases as plan_cases
from yid_ocp.diagnosis.blind.ensemble import seal_labels as seal_labels
from yid_ocp.diagnosis.blind.ensemble import simulate_random_motion as simulate_random_motion
from yid_ocp.diagnosis.blind.score import CaseScore as CaseScore
from yid_ocp.diagnosis.blind.score import calibrate_thresholds as calibrate_thresholds
from yid_ocp.diagnosis.blind.score import permissive_thresholds as permissive_thresholds
from yid_ocp.diagnosis.blind.score import score_case as score_case
from yid_ocp.diagnosis.blind.score import score_ensemble as score_ensemble
