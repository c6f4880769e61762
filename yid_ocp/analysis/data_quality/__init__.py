"""Data-quality checks of recordings against a model: joint limits, efforts, point positions, clocks, excitation."""

from yid_ocp.analysis.data_quality.effort_checks import check_efforts as check_efforts
from yid_ocp.analysis.data_quality.excitation_checks import check_dynamic_excitation as check_dynamic_excitation
from yid_ocp.analysis.data_quality.excitation_checks import check_joint_excitation as check_joint_excitation
from yid_ocp.analysis.data_quality.point_checks import check_cable_points as check_cable_points
from yid_ocp.analysis.data_quality.point_checks import check_held_points as check_held_points
from yid_ocp.analysis.data_quality.point_checks import check_object_points as check_object_points
from yid_ocp.analysis.data_quality.point_checks import check_point_distances as check_point_distances
from yid_ocp.analysis.data_quality.recorded_joints import RecordedJointsModel as RecordedJointsModel
from yid_ocp.analysis.data_quality.recorded_joints import check_joint_limits as check_joint_limits
from yid_ocp.analysis.data_quality.residual_checks import check_fit_residuals as check_fit_residuals
