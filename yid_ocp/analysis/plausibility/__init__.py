"""Data-quality checks of recordings against a model: joint limits, efforts, point positions, clocks, excitation."""

from yid_ocp.analysis.plausibility.arm import Arm as Arm
from yid_ocp.analysis.plausibility.arm import check_limits as check_limits
from yid_ocp.analysis.plausibility.efforts import check_efforts as check_efforts
from yid_ocp.analysis.plausibility.excitation import check_asked as check_asked
from yid_ocp.analysis.plausibility.excitation import check_motion as check_motion
from yid_ocp.analysis.plausibility.fit import check_fit as check_fit
from yid_ocp.analysis.plausibility.points import check_cable as check_cable
from yid_ocp.analysis.plausibility.points import check_held_points as check_held_points
from yid_ocp.analysis.plausibility.points import check_object as check_object
from yid_ocp.analysis.plausibility.points import check_reach as check_reach
