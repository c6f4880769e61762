"""Times of points whose clock is uncertain: corrected by fits, and noise of all samples together."""

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.analysis.clock_checks import clock_and_noise_issues_from_residuals, problem_with_fitted_clocks_and_issues
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.integrator.step import compile_step
from yid_ocp.model.servos_and_springs import StiffnessAndRest
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.problem.options import SensorOptions
from yid_ocp.solvers import GaussNewton, fit_problem

BENCH = """<mujoco><option timestep="0.00025" integrator="implicitfast"/><worldbody><body name="upper" pos="0 0 1">
<joint name="shoulder" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.6"/>
<body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" {elbow}/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.015" mass="0.3"/><site name="tip" pos="0 0 -0.3"/></body></body>
</worldbody><actuator><position joint="shoulder" kp="4000" dampratio="1"/></actuator></mujoco>"""


def swung(late, frequency, seed):
    """Two seconds of MuJoCo's bench: the shoulder's angle, and its tip to half a millimetre, marked `late` [s] late."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(BENCH.format(elbow='stiffness="3" damping="0.02"'))
    data, noise, begin = mujoco.MjData(model), np.random.default_rng(seed), round(late / 0.00025)
    t, angle, place = 0.01 * np.arange(200), [], []
    for k in range(8000):
        mujoco.mj_kinematics(model, data)
        if k % 40 == 0:
            angle.append(data.qpos[:1] + 1e-4 * noise.standard_normal())
        if (k + begin) % 40 == 0:
            place.append(data.site("tip").xpos + 5e-4 * noise.standard_normal(3))
        data.ctrl = 0.7 * np.sin(2 * np.pi * frequency * k / 4000) * np.sin(np.pi * k / 8000) ** 2
        mujoco.mj_step(model, data)
    seen = PointGroup("points", ("tip",), t + 0.01, np.array(place)[:, None])
    return Recording(JointGroup(("shoulder",), t, np.array(angle)), (seen,), name=f"run_{seed}")


def test_damping_is_right_where_markers_are_late(tmp_path):
    file = tmp_path / "bench.xml"
    file.write_text(BENCH.format(elbow=""))
    seen = {"prescribed": ["shoulder"], "point_frames": ["tip"], "springs": {"elbow": StiffnessAndRest(2.0, 0.0)}}
    step = compile_step(System.build(read_urdf(file), damping={"elbow": 0.05}, **seen), 0.005)
    late = [swung(0.0005, frequency, i) for i, frequency in enumerate((0.9, 1.4))]
    truth, problems = {"elbow.stiffness": 3.0, "elbow.damping": 0.02}, {}
    for std in (0.0, None):
        sensors = {"joints.position": SensorOptions(std=1e-4), "points": SensorOptions(std=5e-4, clock_offset_std=std)}
        told = ProblemOptions(path_cutoff=20.0, sensors=sensors, has_uncertain_point_clocks=True)
        problems[std] = EstimationProblem(step, late, tuple(truth), told)
    far = [
        replace(made, points=(replace(made.points[0], t=made.points[0].t + shift, clock_offset_std=0.03),))
        for made, shift in zip((*late, swung(0.0005, 1.1, 2)), (0.03, -0.02, 0.025), strict=True)
    ]
    problem = EstimationProblem(step, far[:2], tuple(truth), told, held_out=far[2:])
    problems["fitted"], doubts = problem_with_fitted_clocks_and_issues(problem)
    fitted = [episode.recording for episode in (*problems["fitted"].episodes, *problems["fitted"].held_out)]
    shifts = [1e3 * (own.points[0].t - made.points[0].t)[0] for own, made in zip(far, fitted, strict=True)]
    assert shifts == pytest.approx([30.5, -19.5, 25.5], abs=0.5), "of held-out recordings too"
    assert [doubt.what.partition(" and")[0][-10:] for doubt in doubts] == [".6 ms late", "5 ms early", ".5 ms late"]
    assert not any("tolerated" in doubt.what for doubt in doubts), "within what is stated"
    sure = [replace(own, points=(replace(own.points[0], clock_offset_std=0.01),)) for own in far]
    _, doubts = problem_with_fitted_clocks_and_issues(
        EstimationProblem(step, sure[:2], tuple(truth), told, held_out=sure[2:])
    )
    assert [doubt.recording for doubt in doubts if "tolerated" in doubt.what] == [sure[0].name, sure[2].name]
    assert " ms late and corrects them" in doubts[0].what
    fits = (fit_problem(own, GaussNewton()) for own in (problem, problems["fitted"]))
    before, after = (fit.goodness_of_fit.chi2_per_dof for fit in fits)
    assert (before > 1.5, after) == (True, pytest.approx(1.0, abs=0.15))
    unstated = [replace(own, points=(replace(own.points[0], clock_offset_std=None),)) for own in far[:2]]
    for recordings, said in ((late, []), (unstated, [(30, "late."), (19, "early.")])):
        problem = EstimationProblem(step, recordings, tuple(truth), told)
        fit = fit_problem(problem, GaussNewton())
        doubts = clock_and_noise_issues_from_residuals(problem, fit.x, fit.evaluation)
        words = [doubt.what.partition("roughly ")[2].split()[:3] for doubt in doubts]
        assert [(int(float(size)), side) for size, _, side in words] == said
    found = {std: fit_problem(problem, GaussNewton()).parameters for std, problem in problems.items()}
    off = {std: (own["elbow.damping"].value - 0.02) / own["elbow.damping"].std for std, own in found.items()}
    assert all(found[std][name].verdict == "identifiable" for std in (None, "fitted") for name in truth)
    assert max(abs(off[None]), abs(off["fitted"])) < 2.5
    assert abs(off[0.0]) > 5.0, "an offset that is denied is taken for damping"
