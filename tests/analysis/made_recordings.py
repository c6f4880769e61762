"""Recordings made up on a grid or by a model, and a pendulum that holds a rod."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from yid_ocp.analysis.experiment_design import UnchangedExperiment
from yid_ocp.data.recording import PointGroup, Recording
from yid_ocp.model import FlexibleSegment, Grasp, Mechanism, System, flexible_object
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.measurements import TimeGrid

GRID = TimeGrid(10.0, 0.1, 20)


def group(name="points_camera", names=("a", "b"), t=(10.0, 10.5, 11.0), std=2e-3, **more):
    return PointGroup(name, tuple(names), np.array(t), np.ones((len(t), len(names), 3)), std, **more)


def setting(*groups, sensors=None, frames=("a", "b", "tip"), **more):
    """A setting of one made-up recording with these groups, in a model with these frames."""
    episode = SimpleNamespace(recording=Recording(None, groups, name="run"), grid=GRID)
    problem = SimpleNamespace(
        episodes=(episode,),
        options=ProblemOptions(sensors=sensors or {}),
        system=SimpleNamespace(mechanism=Mechanism("made", (), dict.fromkeys(frames))),
    )
    return UnchangedExperiment(problem, np.zeros(1), **more), episode


def holding_pendulum(folder, links=3):
    """A pendulum of two motors that takes the end of a rod on the ground."""
    robot = read_urdf(folder / "double_pendulum.urdf")
    rod = flexible_object([FlexibleSegment("T1", 0.6, 0.1, 0.02, links=links, bend=4.0, twist=3.0)])
    grasps = [Grasp("hand", "tip", "w_T1")]
    return System.build(robot, objects=[(rod, None, None)], grasps=grasps, driven=["shoulder", "elbow"])


def chain_of_motors(folder, **joints):
    """A robot of joints (kind, axis) one behind the other on a wall, the last link called hand."""
    inertia = '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>'
    parent, parts, limit = "wall", [], '<limit lower="-1" upper="2" effort="100" velocity="5"/>'
    for i, (name, (kind, axis)) in enumerate(joints.items(), 1):
        link = "hand" if i == len(joints) else f"{name}_link"
        ends = f'<parent link="{parent}"/><child link="{link}"/><axis xyz="{axis}"/>'
        parts.append(f'<joint name="{name}" type="{kind}">{ends}{limit if kind == "prismatic" else ""}</joint>')
        parts.append(f'<link name="{link}"><inertial><mass value="0.5"/>{inertia}</inertial></link>')
        parent = link
    file = folder / "motors.urdf"
    file.write_text(f'<robot name="motors"><link name="wall"/>{"".join(parts)}</robot>')
    return read_urdf(file)


def twin_recording(problem: EstimationProblem, x: np.ndarray, seed: int) -> Recording:
    """The problem's recording as the model itself would measure it, with the sensors' noise."""
    rng = np.random.default_rng(seed)
    evaluation = problem.evaluate(x, derivatives=False)
    assert evaluation.ok, evaluation.message
    recording = problem.episodes[0].recording
    groups = []
    for group, predicted in zip(recording.points, evaluation.episode_predictions[0].predicted_outputs, strict=True):
        count = len(predicted)
        position, std = group.position[:count], group.std[:count]
        seen = predicted.reshape(position.shape) + std * rng.standard_normal(position.shape)
        seen[~np.isfinite(position)] = np.nan
        groups.append(replace(group, t=group.t[:count], position=seen, std=std))
    return replace(recording, points=tuple(groups))
