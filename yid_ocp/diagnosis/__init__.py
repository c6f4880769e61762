"""Diagnosis of the sim-to-real gap: is there one, where, which unmodelled effect makes it, how far it closes."""

from yid_ocp.diagnosis.diagnose import diagnose as diagnose
from yid_ocp.diagnosis.finding import Finding as Finding
from yid_ocp.diagnosis.hypotheses import CandidateProblem as CandidateProblem
from yid_ocp.diagnosis.localise import Place as Place
from yid_ocp.diagnosis.localise import localise as localise
from yid_ocp.diagnosis.refit import Refitted as Refitted
from yid_ocp.diagnosis.refit import refit as refit
from yid_ocp.diagnosis.screening import confusability as confusability
from yid_ocp.diagnosis.screening import linearise as linearise
from yid_ocp.diagnosis.screening import scores as scores
from yid_ocp.diagnosis.screening import together as together
from yid_ocp.diagnosis.screening import visibility as visibility
from yid_ocp.diagnosis.select import closure as closure
from yid_ocp.diagnosis.smoother import Smoothed as Smoothed
from yid_ocp.diagnosis.smoother import smooth as smooth
from yid_ocp.diagnosis.thresholds import Thresholds as Thresholds
