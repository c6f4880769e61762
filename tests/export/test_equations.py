"""Exported equations: files of functions have the step's values."""

import json
import subprocess

import casadi as ca
import numpy as np
import pytest
from held_rod import held_rod

from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.export import equations as exported
from yid_ocp.export.equations import _exported_step_functions, export_step_functions
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.model.kinematics import forward_kinematics

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
    return [*values, step.system.parameters.vector() * rng.uniform(0.9, 1.1, step.sizes["ntheta"]), 0.01]


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
        np.testing.assert_allclose(loaded(folder, name).call(values)[0].full(), expected, rtol=1e-5, atol=atol)


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


def test_the_c_file_compiles_to_the_same_values(step, folder, tmp_path, c_compiler):
    library = tmp_path / "equations.so"
    command = [c_compiler, "-O1", "-fPIC", "-shared", str(folder / "equations.c"), "-o", str(library), "-lm"]
    subprocess.run(command, check=True)
    for name in ("rows", "rows_by_theta"):
        compared(ca.external(name, str(library)), loaded(folder, name), arguments(step))


def test_names_say_what_stands_where(symbols, folder):
    names = json.loads((folder / "names.json").read_text())
    assert names["format"] == "yid-equations/1"
    assert list(names["functions"]) == list(FUNCTIONS)
    assert names["functions"]["rows"]["results"] == ["del", "internal", "constraint", "p1"]
    assert [name for part in names["rows"].values() for name in part] == list(symbols.row_names)
    assert [name for part in names["columns"].values() for name in part] == list(symbols.all_variable_names)
    assert names["parameters"]["T1.bend"] == {"value": 4.0, "unit": "N m/rad"}
    assert names["time_step"] == 0.01


def test_a_large_jacobian_is_left_to_the_reader(symbols, monkeypatch):
    monkeypatch.setattr(exported, "_MAX_JACOBIAN_OPERATIONS", 10)
    assert "rows_by_unknowns" not in [function.name() for function in _exported_step_functions(symbols)]
