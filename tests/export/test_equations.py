"""Exported equations: files of functions have the step's values; the LaTeX sheet is sound, complete, and in numbers."""

import json
import re
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from held_rod import held_rod

from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.effects import make_effect
from yid_ocp.export import equations as exported
from yid_ocp.export.equations import _exported_step_functions, export_step_functions, write_equation_sheet
from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import System
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf

FUNCTIONS = ("rows", "rows_by_theta", "rows_by_unknowns", "points", "mechanics")


@pytest.fixture(scope="module")
def step(urdf_folder):
    """Two motors that take the end of a rod with a relaxing branch; a point half way along it."""
    system = held_rod(urdf_folder, ratio=0.4, driven=["shoulder", "elbow"], point_frames=["w_T1", "T1:50%"])
    return compile_step(system, 0.01, use_compiler=False)


@pytest.fixture(scope="module")
def symbols(step):
    return NamedStepEquations.from_equations(step.equations)


@pytest.fixture(scope="module")
def folder(step, symbols, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "deep" / "folder"
    written = export_step_functions(symbols, folder, step.system.parameters.vector(), step.time_step)
    assert [path.name for path in written] == [*(f"{name}.casadi" for name in FUNCTIONS), "equations.c", "names.json"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(path.name for path in written)
    return folder


def arguments(step, seed=0):
    """Values of `rows`' arguments: any state, any parameters near their own."""
    rng = np.random.default_rng(seed)
    values = [rng.uniform(-0.5, 0.5, x.numel()) for x in step.equations.arguments[:7]]
    theta = step.system.parameters.vector() * rng.uniform(0.9, 1.1, step.sizes["ntheta"])
    return [*values, theta, 0.01]


def loaded(folder, name):
    return ca.Function.load(str(folder / f"{name}.casadi"))


def compared(function, reference, values):
    for found, expected in zip(function.call(values), reference.call(values), strict=True):
        assert found.shape == expected.shape
        np.testing.assert_allclose(np.array(found.full()), np.array(expected.full()), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_is_loaded_back_has_the_same_values(step, symbols, folder, name):
    reference = {f.name(): f for f in _exported_step_functions(symbols)}[name]
    again, values, v = loaded(folder, name), arguments(step), np.ones(step.sizes["n"])
    assert (again.name_in(), again.name_out()) == (reference.name_in(), reference.name_out())
    values = {"points": [values[0], values[7]], "mechanics": [values[0], v, values[7]]}.get(name, values)
    compared(again, reference, values)


def test_the_loaded_rows_vanish_along_a_step(step, folder):
    """What the kernel solves is what was written: DEL, inner equations and constraints are met, p1 is the momentum."""
    theta = step.system.parameters.vector()
    rest = EquilibriumSolver(step).solve(np.array([0.3, -0.6]), theta, None)
    n = step.sizes["n"]
    q0, p0, z0 = rest.state[:n], rest.state[n : 2 * n], rest.state[2 * n :]
    torque = rest.holding_torque + 0.5
    q1, p1, lam, status = step(q0, p0, torque, theta, None, z0)
    assert status.is_converged
    state = {"q0": q0, "q1": q1, "p0": p0, "z0": z0, "z1": status.internal_coordinates, "lam": lam, "u": torque}
    found = loaded(folder, "rows")(**state, theta=theta, time_step=step.time_step)
    for name in ("del", "internal", "constraint"):
        assert np.max(np.abs(found[name].full()), initial=0.0) < 1e-9, name
    np.testing.assert_allclose(found["p1"].full().ravel(), p1, atol=1e-12)


def test_the_loaded_slopes_are_those_of_the_rows(step, folder):
    rows, values = loaded(folder, "rows"), arguments(step)

    def slopes(which):
        ends = {}
        for i in range(len(values[which])):
            for sign in (1, -1):
                moved = [np.array(x, float) for x in values]
                moved[which][i] += sign * 1e-6
                ends[i, sign] = np.concatenate([x.full().ravel() for x in rows.call(moved)])
        return [(ends[i, 1] - ends[i, -1]) / 2e-6 for i in range(len(values[which]))]

    for name, parts, atol in (("rows_by_theta", (7,), 1e-7), ("rows_by_unknowns", (1, 4, 5), 1e-6)):
        expected = np.transpose([slope for which in parts for slope in slopes(which)])
        found = loaded(folder, name).call(values)[0].full()
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=atol)


def test_points_and_mechanics_are_the_models(step, folder):
    points = loaded(folder, "points")
    assert points.name_out() == ["w_T1", "T1_50"]
    theta = step.system.parameters.vector()
    q = np.random.default_rng(1).uniform(-0.5, 0.5, step.sizes["n"])
    symbol = ca.SX.sym("q", len(q))
    kinematics = forward_kinematics(step.system.mechanism, symbol)
    place = ca.Function("at", [symbol, step.system.parameters.symbols], [kinematics.frame_position("T1:50%")])
    np.testing.assert_allclose(points.call([q, theta])[1].full(), place(q, theta).full(), atol=1e-14)
    v = np.random.default_rng(2).normal(size=len(q))
    mass, _, momentum = (x.full() for x in loaded(folder, "mechanics").call([q, v, theta]))
    np.testing.assert_allclose(mass, mass.T, atol=1e-14)
    assert np.min(np.linalg.eigvalsh(mass)) > 0
    np.testing.assert_allclose(mass @ v[:, None], momentum, rtol=1e-12)


def test_the_c_file_compiles_to_the_same_values(step, folder, tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("there is no C compiler")
    library = tmp_path / "equations.so"
    command = [compiler, "-O1", "-fPIC", "-shared", str(folder / "equations.c"), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    for name in ("rows", "rows_by_theta"):
        compared(ca.external(name, str(library)), loaded(folder, name), arguments(step))


def test_names_say_what_stands_where(symbols, folder):
    names = json.loads((folder / "names.json").read_text())
    assert names["format"] == "yid-equations/1"
    assert list(names["functions"]) == list(FUNCTIONS)
    assert names["functions"]["rows"]["results"] == ["del", "internal", "constraint", "p1"]
    assert [name for part in names["rows"].values() for name in part] == list(symbols.row_names)
    assert [name for part in names["columns"].values() for name in part] == list(symbols.column_names)
    assert names["parameters"]["T1.bend"] == {"value": 4.0, "unit": "N m/rad"}
    assert names["time_step"] == 0.01


def test_a_large_jacobian_is_left_to_the_reader(symbols, monkeypatch):
    monkeypatch.setattr(exported, "_MAX_JACOBIAN_OPERATIONS", 10)
    assert "rows_by_unknowns" not in [function.name() for function in _exported_step_functions(symbols)]


@pytest.fixture(scope="module")
def held(urdf_folder):
    """A driven shoulder, an elbow with a spring and an effect with inner coordinates on a rod that is held."""
    system = held_rod(urdf_folder, links=1, ratio=0.4, driven=["shoulder"], springs={"elbow": RobotJointSpring(3.25)})
    return NamedStepEquations.from_equations(discrete_equations(system))


def sheet(symbols, tmp_path, free=("T1.bend",), time_step=0.01):
    path = tmp_path / "equations.tex"
    write_equation_sheet(path, symbols, symbols.equations.system.parameters.vector(), free, time_step)
    check_latex(path.read_text())
    return path.read_text()


def check_latex(text):
    """Braces, environments and mathematics are closed in the order in which they were opened."""
    depth = 0
    for letter in re.sub(r"\\[{}$\\]", "", text):
        depth += {"{": 1, "}": -1}.get(letter, 0)
        assert depth >= 0
    assert depth == 0
    opened = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+\*?)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert not opened
    body = text[text.index(r"\begin{document}") :]
    for line in body.splitlines():
        assert len(re.findall(r"(?<!\\)\$", line)) % 2 == 0, line
        for part in re.findall(r"(?<!\\)\$(.*?)(?<!\\)\$", line):
            assert part.count("(") == part.count(")"), part
            assert len(re.findall(r"\\left\b", part)) == len(re.findall(r"\\right\b", part)), part
    # outside mathematics, nothing that only mathematics may have
    outside = re.sub(r"(?<!\\)\$.*?(?<!\\)\$", "", re.sub(r"(?s)\\begin\{align\*\}.*?\\end\{align\*\}", "", body))
    assert not re.search(r"(?<!\\)[_^]", outside), re.search(r".*(?<!\\)[_^].*", outside)


def test_the_sheet_is_sound_and_names_every_row(held, tmp_path):
    text = sheet(held, tmp_path)
    for block in held.row_blocks:
        for label in block.labels:
            assert rf"\mathrm{{{label.replace('_', chr(92) + '_')}}}" in text, label
    for title in ("Letters that stay", "Joints", "Bodies", "Rows"):
        assert rf"\section*{{{title}}}" in text
    assert r"h = 0.01$ s" in text


def test_numbers_stand_for_all_but_what_is_free(held, tmp_path):
    text = sheet(held, tmp_path)
    letters = set(re.findall(r"\\theta_\{\\mathrm\{([^}]*)\}\}", text))
    assert letters == {"T1.bend"}
    assert r"T1.bend & $4$ & $\mathrm{N\,m/rad}$ \\" in text
    # half the elbow's spring is a number
    elbow = next(line for line in text.splitlines() if line.startswith(r"$\displaystyle R_{k,\,\mathrm{elbow}}"))
    assert "1.625" in elbow
    text = sheet(held, tmp_path, free=())
    assert not re.search(r"\\theta_", text)
    assert "Letters that stay" not in text
    assert re.search(r"\\varphi_\{k\+1,\\,\\mathrm\{hand.x\}\} = ", text)


def test_rules_say_what_the_step_does(held, tmp_path):
    assert r"\tfrac{h}{2} F - \tfrac12" in sheet(held, tmp_path)
    system = held.equations.system
    left = NamedStepEquations.from_equations(discrete_equations(system, "left", "node"))
    text = sheet(left, tmp_path)
    assert r"- L_v(q_m, v_m) + h F - D\varphi(q_k)^{T} \lambda_k" in text
    assert "p_{k+1} &= \\tfrac{h}{2} L_q(q_m, v_m) + L_v(q_m, v_m) \\\\\n" in text
    assert "multiplied by it" not in text
    added = [make_effect("grasp_compliance", "hand", system, {}), make_effect("mount_compliance", "base", system, {})]
    soft = NamedStepEquations.from_equations(discrete_equations(system.with_effects(added)))
    assert soft.equations.constraint_relaxation_gain is not None
    assert soft.equations.system.joint_compliances
    text = sheet(soft, tmp_path, free=())
    assert r"+ T \left(" in text
    assert "multiplied by it" in text


def test_without_grasps_there_is_no_word_of_them(urdf_folder, tmp_path):
    system = System.build(read_urdf(urdf_folder / "mixed_joints.urdf"))
    text = sheet(NamedStepEquations.from_equations(discrete_equations(system)), tmp_path, free=())
    assert not any(word in text for word in ("varphi", "lambda", "pull of the grasps"))


def test_short_rows_are_written_out(tmp_path, urdf_folder):
    """One pendulum about one axis: the whole equation fits, its numbers are those of the file."""
    urdf = """<robot name="one"><link name="wall"/><joint name="hinge" type="continuous"><parent link="wall"/>
      <child link="rod"/><axis xyz="0 1 0"/></joint><link name="rod"><inertial><origin xyz="0 0 -0.5"/>
      <mass value="2"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link></robot>"""
    (tmp_path / "one.urdf").write_text(urdf)
    system = System.build(read_urdf(tmp_path / "one.urdf"), damping=0.125)
    text = sheet(NamedStepEquations.from_equations(discrete_equations(system)), tmp_path, free=())
    row = next(line for line in text.splitlines() if line.startswith(r"$\displaystyle R_{k"))
    assert "B_{" not in row
    assert all(part in row for part in ("0.125", "9.81", r"\sin("))
    assert "2 & $(0,\\, 0,\\, -0.5)$" in text.replace("$2$", "2")


def test_the_sheet_compiles_where_there_is_tex(held, tmp_path):
    tex = next((found for name in ("pdflatex", "lualatex", "tectonic") if (found := shutil.which(name))), None)
    if tex is None:
        pytest.skip("there is no TeX")
    sheet(held, tmp_path)
    options = [] if tex.endswith("tectonic") else ["-interaction=nonstopmode", "-halt-on-error"]
    done = subprocess.run([tex, *options, "equations.tex"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "equations.pdf").stat().st_size > 1000


def test_formulas_are_mathematics_to_another_reader(held, tmp_path):
    """matplotlib's own parser takes every formula that has no matrix."""
    from matplotlib.mathtext import MathTextParser

    parser = MathTextParser("path")
    parts = re.findall(r"(?<!\\)\$(.*?)(?<!\\)\$", sheet(held, tmp_path))
    plain = [part.replace(r"\displaystyle", "").replace(r"\,", " ").replace(r"\tfrac", r"\frac") for part in parts]
    assert sum("matrix" not in part for part in plain) > 40
    for part in plain:
        if "matrix" not in part:
            parser.parse(f"${part}$")
