"""Generated code: the order of elimination, and batches, whose members give what they give one by one."""

import ctypes
import math
import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator import codegen, compiled, compiler
from yid_ocp.integrator.codegen import _simd_c_source
from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.step_model import RolloutInputs, SensitivityDirections

pytestmark = pytest.mark.usefixtures("c_compiler")

# Newton stops at 1e-14 in these cases; the rest is rounding of sums in another order
TOLERANCE = 1e-9
VALUES = ("state", "multipliers", "effort")
RESULTS = (*VALUES, "torque", *(f"{name}_sensitivity" for name in VALUES))


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    """Batches from the first question on."""
    monkeypatch.setattr(compiled, "MIN_STEPS_TO_COMPILE_BATCH", 0)


def watched(monkeypatch, kernel):
    """How many members every call of compiled code had."""
    calls = []
    original = kernel._rolled_out

    def counted(library, members):
        calls.append(len(members))
        return original(library, members)

    monkeypatch.setattr(kernel, "_rolled_out", counted)
    return calls


def members_of(case, count=8):
    """Members with their own parameters, lengths, starts, gains and directions, the last without any of the latter."""
    rng, sizes = np.random.default_rng(3), case.step.sizes
    names = case.step.system.parameters.names
    made = []
    for i in range(count):
        steps = len(case.torque) - i % 4
        chosen = tuple(names[i % 3 : i % 3 + 1 + i % 2]) if i < count - 1 else ()
        width = len(chosen) + i % 3
        given = [None, None]
        if i % 2:
            given = [rng.normal(size=(steps, sizes["nu"], width)), rng.normal(size=(steps + 1, sizes["nc"], width))]
        directions = SensitivityDirections(chosen, 0.1 * rng.normal(size=(sizes["nx"], width)), *given)
        theta, loop = case.theta * np.exp(0.02 * rng.normal(size=len(case.theta))), case.feedback
        feedback = replace(loop, gain=loop.gain[:steps] * (1 + 0.02 * i), reference=loop.reference[:steps])
        torque = case.torque[:steps] * (1 + 0.02 * i)
        made.append(RolloutInputs(theta, case.start, torque, case.path[: steps + 1], feedback, directions))
    return made


def alone(case, member):
    return case.step.kernel.rollout(member)


def assert_same(one, other, tolerance=0.0):
    assert (one.status.code, one.status.completed_steps) == (other.status.code, other.status.completed_steps)
    for name in RESULTS:
        first, second = getattr(one, name), getattr(other, name)
        if second is None or not second.size:
            assert first is None or not first.size
            continue
        scale = max(float(np.nanmax(np.abs(second), initial=0.0)), 1e-9)
        np.testing.assert_allclose(first, second, rtol=0, atol=tolerance * scale, err_msg=name)


@pytest.mark.parametrize("name", ["closed_loop", pytest.param("relaxing_cable", marks=pytest.mark.slow)])
def test_a_batch_is_its_members_one_by_one(parts, urdf_folder, monkeypatch, name):
    case = parts.builders[name](urdf_folder)
    members = members_of(case)
    single = [alone(case, member) for member in members]
    assert all(rollout.status.is_converged for rollout in single)
    calls = watched(monkeypatch, case.step.kernel)
    for some in (members, [replace(member, directions=None) for member in members]):
        for one, member, other in zip(case.step.kernel.rollout_batch(some), some, single, strict=True):
            expected = other if member.directions is not None else alone(case, member)
            assert_same(one, expected, TOLERANCE)
            # at a tolerance of 1e-14 rounding decides about the last iteration
            assert abs(one.status.newton_iterations - expected.status.newton_iterations) <= 3
    width = case.step.kernel._batched(None)[1]
    assert calls[: 8 // width] == [width] * (8 // width)


def test_a_member_that_fails_fails_as_alone_and_companions_do_not_notice(parts, urdf_folder, monkeypatch):
    case = parts.builders["closed_loop"](urdf_folder)
    good = [replace(member, directions=None) for member in members_of(case)]
    expected = case.step.kernel.rollout_batch(good)
    wild = good[2].torque.copy()
    wild[4] = np.inf
    lost = replace(good[5], theta=np.full_like(good[5].theta, np.nan))
    members = [*good[:2], replace(good[2], torque=wild), *good[3:5], lost, *good[6:]]
    calls = watched(monkeypatch, case.step.kernel)
    found = case.step.kernel.rollout_batch(members)
    assert calls.count(1) == 2  # the two that failed were asked again
    for i in (2, 5):
        assert not found[i].status.is_converged
        assert_same(found[i], alone(case, members[i]))
    assert found[2].status.completed_steps == 4
    for i in set(range(8)) - {2, 5}:
        assert_same(found[i], expected[i])


def test_without_vectors_members_are_done_one_by_one(parts, urdf_folder, monkeypatch):
    case = parts.builders["closed_loop"](urdf_folder)
    members = members_of(case)
    original = compiler.compile_and_load_library

    def without_batches(text, *make):
        return None if "define BATCHED" in text else original(text, *make)

    monkeypatch.setattr(compiler, "compile_and_load_library", without_batches)
    for one, member in zip(case.step.kernel.rollout_batch(members), members, strict=True):
        assert_same(one, alone(case, member))


DRIVER = """
void yid_try(const double *in, double *out, int count) {
    for (int first = 0; first < count; first += SIMD_WIDTH) {
        real x[2], y[OUTPUTS], w[PLACES];
        const real *arg[1] = {x};
        real *res[1] = {y};
        for (int entry = 0; entry < SIMD_WIDTH; entry++)
            for (int i = 0; i < 2; i++) SIMD_ENTRY(x[i], entry) = in[2 * (first + entry) + i];
        everything(arg, res, 0, w, 0);
        for (int entry = 0; entry < SIMD_WIDTH; entry++)
            for (int o = 0; o < OUTPUTS; o++) out[OUTPUTS * (first + entry) + o] = SIMD_ENTRY(y[o], entry);
    }
}
"""


def everything():
    """A function with every operation that has a form."""
    x = ca.SX.sym("x", 2)
    a, b = x[0], x[1]
    one = [ca.sin, ca.cos, ca.tan, ca.exp, ca.tanh, ca.sinh, ca.cosh, ca.atan, ca.asinh, ca.erf, ca.expm1]
    outputs = [f(a) for f in (*one, ca.floor, ca.ceil, ca.fabs, ca.sign)]
    outputs += [ca.sqrt(a**2), ca.log(a**2 + 1), ca.log1p(a**2), ca.asin(ca.tanh(a)), ca.acos(ca.tanh(a))]
    outputs += [ca.atanh(ca.tanh(a) / 2), ca.acosh(1 + a**2), (a**2) ** b, ca.atan2(a, b), ca.fmod(a, 3.0)]
    outputs += [ca.copysign(a, b), ca.hypot(a, b), ca.remainder(a, 3.0), ca.fmin(a, b), ca.fmax(a, b), a - b, a / b]
    outputs += [a < b, a <= b, ca.eq(a, b), ca.ne(a, b), ca.logic_and(a, b), ca.logic_or(a, b), ca.logic_not(a)]
    outputs += [ca.if_else(a < 0.5, a**3, ca.inf), -a * 2, 1 / b, ca.sin(a + b) * ca.cos(a + b)]
    return ca.Function("everything", [x], [ca.vertcat(*outputs)])


MACHINES = {"this": "-march=native", "avx2": "-mavx2 -mfma", "any": ""}
# a compiler that makes code for such a machine, whatever flags it is called with
COMPILER = """#!/bin/sh
[ "$1" = --version ] && echo "{flags}"
for given; do shift; [ "$given" = -march=native ] || set -- "$@" "$given"; done
exec {program} "$@" {flags}
"""


def arithmetic_source(function, batched=True):
    """C source of a function of two numbers, for members that march together or for one, with what tries it."""
    body = _simd_c_source([function])
    assert body is not None
    arithmetic = resources.files("yid_ocp.integrator").joinpath("simd.c").read_text(encoding="utf-8")
    sizes = f"#define OUTPUTS {function.numel_out(0)}\n#define PLACES {function.sz_w()}"
    return f"{'#define BATCHED' if batched else ''}\n{sizes}\n{arithmetic}\n{body}\n{DRIVER}"


def assert_those_of_casadi(library, function):
    rng, special = np.random.default_rng(0), [[0, 0], [1, 1], [0.5, -0.0], [np.pi, 0], [3e9, 2]]
    scale = 10.0 ** rng.uniform(-3, 2, size=(400, 2))
    points = np.vstack([rng.normal(size=(400, 2)) * scale, special * 8])
    found = np.zeros((len(points), function.numel_out(0)))
    library.yid_try(ctypes.c_void_p(points.ctypes.data), ctypes.c_void_p(found.ctypes.data), len(points))
    expected = np.array([np.array(function(point)).ravel() for point in points])
    usable = np.isfinite(expected)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found[usable], expected[usable], rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("program", ["cc", "clang"])
def test_arithmetic_of_a_batch_is_that_of_one(monkeypatch, tmp_path, c_compiler, machine, program):
    path, processor = c_compiler if program == "cc" else shutil.which(program), Path("/proc/cpuinfo")
    if path is None:
        pytest.skip(f"there is no {program}")
    features = processor.read_text() if processor.is_file() else ""
    if machine == "avx2" and "avx2" not in features:
        pytest.skip("this machine has no AVX2")
    (tmp_path / "cc").write_text(COMPILER.format(program=path, flags=MACHINES[machine]))
    (tmp_path / "cc").chmod(0o755)
    monkeypatch.setenv("CC", str(tmp_path / "cc"))
    function = everything()
    library = compiler.compile_and_load_library(arithmetic_source(function))
    assert library.yid_simd_width() == (8 if machine == "this" and "avx512f" in features else 4)
    assert_those_of_casadi(library, function)


@pytest.mark.parametrize("size", [1, 7, 40])
@pytest.mark.parametrize("batched", [True, False], ids=["many", "one"])
def test_a_long_function_in_parts_is_the_same(monkeypatch, batched, size):
    function = everything()
    monkeypatch.setattr(codegen, "_LONG_INSTRUCTION_COUNT", 20)
    monkeypatch.setattr(codegen, "_PART_INSTRUCTION_COUNT", size)
    source = arithmetic_source(function, batched)
    assert source.count("noinline") == math.ceil(function.n_instructions() / size)
    library = compiler.compile_and_load_library(source)
    if batched and not library.yid_simd_width():
        pytest.skip("this machine has no vectors")
    assert_those_of_casadi(library, function)


@pytest.mark.parametrize("name", ["closed_loop", "relaxing_cable"])
def test_a_step_of_long_functions_is_the_same(parts, urdf_folder, monkeypatch, name):
    case = parts.builders[name](urdf_folder)
    members = members_of(case)
    monkeypatch.setattr(codegen, "_LONG_INSTRUCTION_COUNT", 100)
    monkeypatch.setattr(codegen, "_PART_INSTRUCTION_COUNT", 30)
    model = case.step.model
    text = codegen.kernel_c_source(model.functions, model.index_tables)
    assert "linear_3(" in text
    assert "casadi_f0" in text, "short ones are as CasADi writes them"
    kernel = compiled.CompiledKernel(model, compiler.compile_and_load_library(text))
    for member, found in zip(members, kernel.rollout_batch(members), strict=True):
        assert_same(found, alone(case, member), TOLERANCE)


def test_an_operation_without_a_form_is_refused():
    x = ca.SX.sym("x")
    functions = SimpleNamespace(all_functions=[ca.Function("odd", [x], [ca.erfinv(x)])])
    assert codegen.kernel_c_source(functions, None, batched=True) is None


def test_elimination_fills_no_more_than_the_tree(single_step):
    """Tips before roots and multipliers last: a pivot touches its ancestors, and the multipliers of grasps below it."""
    tables, system = single_step.model.index_tables, single_step.system
    size = len(tables.elimination_order)
    names = [*system.mechanism.joint_names, *[f"lam{i}" for i in range(system.n_constraints)]]
    ordered = [names[i] for i in tables.unknown_rows[tables.elimination_order]]
    assert ordered[0] == "T3_3_z"
    assert ordered[-3:] == ["lam0", "lam1", "lam2"]
    tip = [ordered[i] for i in tables.fill_in[0]]
    tree = system.mechanism
    chain = [tree.joint_names[i] for i in tree.ancestor_joint_indices(tree.joint_index("T3_3_z"))]
    assert tip == chain[-2::-1]
    assert sum(len(entries) for entries in tables.fill_in) < 0.75 * size * (size - 1) / 2


def test_a_kernel_in_the_cache_is_found_without_generating_code(parts, urdf_folder, monkeypatch):
    """The serialized equations find it again, and tell every other system's from it."""
    first = compile_step(parts.closed_loop(urdf_folder)[0], 2e-3)
    monkeypatch.setattr(codegen, "kernel_c_source", lambda *_: pytest.fail("code is generated again"))
    again = compile_step(parts.closed_loop(urdf_folder)[0], 2e-3)
    assert again.is_compiled
    texts = {
        codegen.kernel_cache_key_text(step.model.functions, step.model.index_tables)
        for step in (first, again, parts.builders["relaxing_cable"](urdf_folder).step)
    }
    assert len(texts) == 2
