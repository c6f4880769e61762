"""Blind validation: diagnoses of synthetic recordings whose true effects stay sealed until they are scored."""

from yid_ocp.diagnosis.blind.ensemble import ENSEMBLE_PURPOSES as ENSEMBLE_PURPOSES
from yid_ocp.diagnosis.blind.ensemble import BlindCase as BlindCase
from yid_ocp.diagnosis.blind.ensemble import BlindCaseGenerator as BlindCaseGenerator
from yid_ocp.diagnosis.blind.ensemble import CaseGroundTruth as CaseGroundTruth
from yid_ocp.diagnosis.blind.ensemble import PlannedBlindCase as PlannedBlindCase
from yid_ocp.diagnosis.blind.ensemble import SyntheticRecordingConditions as SyntheticRecordingConditions
from yid_ocp.diagnosis.blind.ensemble import diagnose_blind_case as diagnose_blind_case
from yid_ocp.diagnosis.blind.ensemble import initial_driven_joint_positions as initial_driven_joint_positions
from yid_ocp.diagnosis.blind.ensemble import open_sealed_labels as open_sealed_labels
from yid_ocp.diagnosis.blind.ensemble import plan_blind_cases as plan_blind_cases
from yid_ocp.diagnosis.blind.ensemble import scale_parameters_to_more_links as scale_parameters_to_more_links
from yid_ocp.diagnosis.blind.ensemble import seal_labels_with_hash as seal_labels_with_hash
from yid_ocp.diagnosis.blind.ensemble import simulate_random_motion as simulate_random_motion
from yid_ocp.diagnosis.blind.ensemble import true_effects_gap_closure as true_effects_gap_closure
from yid_ocp.diagnosis.blind.score import BlindCaseScore as BlindCaseScore
from yid_ocp.diagnosis.blind.score import calibrate_thresholds as calibrate_thresholds
from yid_ocp.diagnosis.blind.score import ensemble_success_rates as ensemble_success_rates
from yid_ocp.diagnosis.blind.score import permissive_thresholds as permissive_thresholds
from yid_ocp.diagnosis.blind.score import score_blind_case as score_blind_case
