"""Blind validation: diagnoses of synthetic recordings whose true effects stay sealed until they are scored."""

from yid_ocp.diagnosis.blind.answers import answer as answer
from yid_ocp.diagnosis.blind.answers import best_closure as best_closure
from yid_ocp.diagnosis.blind.calibrate import calibrate as calibrate
from yid_ocp.diagnosis.blind.calibrate import opened_wide as opened_wide
from yid_ocp.diagnosis.blind.ensemble import Case as Case
from yid_ocp.diagnosis.blind.ensemble import Conditions as Conditions
from yid_ocp.diagnosis.blind.ensemble import Ensemble as Ensemble
from yid_ocp.diagnosis.blind.ensemble import Label as Label
from yid_ocp.diagnosis.blind.ensemble import finer_values as finer_values
from yid_ocp.diagnosis.blind.ensemble import first_posture as first_posture
from yid_ocp.diagnosis.blind.ensemble import opened as opened
from yid_ocp.diagnosis.blind.ensemble import recorded as recorded
from yid_ocp.diagnosis.blind.ensemble import seal as seal
from yid_ocp.diagnosis.blind.plan import PURPOSES as PURPOSES
from yid_ocp.diagnosis.blind.plan import Planned as Planned
from yid_ocp.diagnosis.blind.plan import planned as planned
from yid_ocp.diagnosis.blind.score import Mark as Mark
from yid_ocp.diagnosis.blind.score import mark as mark
from yid_ocp.diagnosis.blind.score import score as score
