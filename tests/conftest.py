"""Shared fixtures: the paper's two systems with their compiled steps, the golden trajectories, small mechanisms."""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import casadi as ca
import hypothesis
import numpy as np
import pytest
import threadpoolctl
from baxter import baxter_foam_y_system
from pendulum_run import carried_out as carried_out
from pendulum_run import cli as cli
from pendulum_run import left_nothing as left_nothing
from pendulum_run import pendulum as pendulum
from pendulum_run import pendulum_data as pendulum_data
from pendulum_run import printed as printed
from pendulum_run import rubbing as rubbing
from pendulum_run import solved_pendulum as solved_pendulum
from sound_findings import assert_sound

from yid_ocp.data import recording_hdf5
from yid_ocp.integrator.step import compile_step
from yid_ocp.integrator.step_model import RolloutInputs
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.system import System
from yid_ocp.model.urdf import read_urdf

diagnose_module = importlib.import_module("yid_ocp.diagnosis.diagnose")  # the function hides its module
REPOSITORY = Path(__file__).resolve().parents[1]
ARMS = {"single": 1, "dual": 2}
STIFFNESSES = ("T1.bend", "T1.twist", "T2.bend", "T2.twist", "T3.bend", "T3.twist")

gc.disable()  # until all is imported: see `pytest_collection_finish`
hypothesis.settings.register_profile("tests", deadline=None, max_examples=20, derandomize=True)
hypothesis.settings.load_profile("tests")


# each of several processes that share the processors takes one: their libraries would start a thread for every one
if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "YID_OCP_THREADS"):
        os.environ.setdefault(name, "1")
    threadpoolctl.threadpool_limits(1)
    # looking for libraries again would take milliseconds
    threadpoolctl.threadpool_limits = lambda limits: contextlib.nullcontext()


def pytest_configure(config):
    """Keep compiled code between runs, apart from the user's own, unless a place was chosen; compile quickly.

    Most steps of the tests are compiled for a few rollouts; see `shipped_optimization` for the others.
    """
    os.environ.setdefault("YID_OCP_OPTIMIZE", "0")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # each command that a test starts would compile all modules again
    if "YID_OCP_CACHE" not in os.environ and hasattr(config, "cache"):
        folder = config.cache.mkdir("compiled")
        folder.chmod(0o700)
        os.environ["YID_OCP_CACHE"] = str(folder)


@pytest.fixture(autouse=True, scope="session")
def findings_are_sound():
    """Whatever a test diagnoses, nothing impossible is said of it."""
    text_of = diagnose_module.diagnosis_summary_text

    def checked(finding):
        text = text_of(finding)
        assert_sound(replace(finding, summary=text))
        return text

    diagnose_module.diagnosis_summary_text = checked
    yield
    diagnose_module.diagnosis_summary_text = text_of


def pytest_collection_finish():
    """What is imported and collected stays: the garbage collector need not look through it again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _unchanged_files_are_tried_once():
    """A file that could be read, and did not change since, is not tried in a fork again by the same process."""
    check, known = recording_hdf5.check_readable_in_child_process, set()

    def once(path, complaint, noun):
        state = os.stat(path) if os.path.exists(path) else None
        state = state and (state.st_ino, state.st_size, state.st_mtime_ns, state.st_mode)
        if (path, complaint, state) not in known:
            check(path, complaint, noun)
            known.add((path, complaint, state))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording_hdf5, "check_readable_in_child_process", once)
        yield


@pytest.fixture(scope="session")
def c_compiler() -> str:
    """Path of the C compiler that the package takes."""
    wanted = os.environ.get("CC")
    path = next(filter(None, map(shutil.which, [wanted] if wanted else ["cc", "gcc", "clang"])), None)
    return path or pytest.skip("this machine has no C compiler")


@pytest.fixture
def shipped_optimization(monkeypatch):
    """Code compiled as users have it."""
    monkeypatch.delenv("YID_OCP_OPTIMIZE")


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPOSITORY


@pytest.fixture(scope="session")
def clean(repository) -> Path:
    """The paper's four experiments with exact torques, held over each sample: `benchmarks/make_recordings.py`."""
    return repository / "tests" / "data" / "clean"


@pytest.fixture(scope="session")
def urdf_folder(repository) -> Path:
    return repository / "models" / "urdf"


@pytest.fixture(scope="session")
def robot(urdf_folder) -> Mechanism:
    """Two rods that hang from each other by the joints shoulder and elbow."""
    return read_urdf(urdf_folder / "double_pendulum.urdf")


@pytest.fixture(scope="session")
def shared(repository) -> Path:
    """The folder of reference data that stands beside the repository."""
    folder = repository.parent / "shared"
    if not (folder / "golden").is_dir():
        pytest.skip(f"the reference data is not there: {folder}")
    return folder


@pytest.fixture(scope="session")
def golden(shared):
    """Trajectory arrays (`.q`, `.p`, ...) and the model numbers (`.model`) of `single` or `dual`."""

    def load(name: str) -> SimpleNamespace:
        with np.load(shared / "golden" / f"trep_{name}_arm.npz") as arrays:
            entries = {key: arrays[key] for key in arrays.files}
        text = (shared / "golden" / f"trep_{name}_arm.model.json").read_text(encoding="utf-8")
        return SimpleNamespace(**entries, model=json.loads(text))

    loaded = {name: load(name) for name in ARMS}
    return loaded.__getitem__


@pytest.fixture(scope="session")
def paper_systems():
    """Baxter with one (`single`) or two (`dual`) arms on the foam Y."""
    return {name: baxter_foam_y_system(arms) for name, arms in ARMS.items()}


@pytest.fixture(scope="session")
def single_arm(paper_systems) -> System:
    return paper_systems["single"]


@pytest.fixture(scope="session")
def dual_arm(paper_systems) -> System:
    return paper_systems["dual"]


@pytest.fixture(scope="session")
def single_step(single_arm):
    return compile_step(single_arm, 0.01, "left", "node")


@pytest.fixture(scope="session")
def dual_step(dual_arm):
    return compile_step(dual_arm, 0.01, "left", "node")


@pytest.fixture(scope="session")
def theta_golden(golden, paper_systems):
    """Parameters of the golden trajectories: theta_golden("single")."""

    def theta(name: str) -> np.ndarray:
        return paper_systems[name].parameters.vector(dict(zip(STIFFNESSES, golden(name).rho, strict=True)))

    return theta


@pytest.fixture(scope="session")
def roll():
    """roll(step, theta, q0, p0, steps, ...): a converged rollout from a state, torque zero and path held by default."""

    def rollout(step, theta, q0, p0, steps, torque=None, path=None, z0=None, feedback=None, directions=None):
        sizes = step.sizes
        start = np.concatenate([q0, p0, np.zeros(sizes["nz"]) if z0 is None else z0])
        torque = np.zeros((steps, sizes["nu"])) if torque is None else torque
        fixed = list(step.system.prescribed_coordinate_indices)
        path = np.tile(start[fixed], (steps + 1, 1)) if path is None else path
        start[fixed] = path[0]
        inputs = RolloutInputs(np.asarray(theta, float), start, torque, path, feedback, directions)
        found = step.kernel.rollout(inputs)
        assert found.status.is_converged, found.status.message
        return found

    return rollout


@pytest.fixture(scope="session")
def momentum():
    """momentum(step, q, v, theta): dL/dv of the bodies."""

    def evaluate(step, q, v, theta):
        e = step.equations
        function = ca.Function("momentum", [e.q0, e.q1, e.theta, e.time_step], [e.rigid_body_terms.lagrangian_by_v])
        half = 0.5 * step.time_step * np.asarray(v, float)
        return np.array(function(np.asarray(q) - half, np.asarray(q) + half, theta, step.time_step)).ravel()

    return evaluate


@pytest.fixture(scope="session")
def violation():
    """violation(step, q, theta): phi(q) of the grasps."""

    def evaluate(step, q, theta):
        e = step.equations
        old, zero = [e.z1, e.lam], [np.zeros(e.z1.shape), np.zeros(e.lam.shape)]
        phi = ca.substitute([e.constraint_residual], old, [ca.SX(ca.DM(x)) for x in zero])[0]
        return np.array(ca.Function("phi", [e.q1, e.theta, e.time_step], [phi])(q, theta, step.time_step)).ravel()

    return evaluate


@pytest.fixture(scope="session")
def benchmark_module(repository):
    """benchmark_module(name, **neighbours): a module of benchmarks/, beside a loaded package of the same name."""

    def load(name: str, **neighbours: ModuleType) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, repository / "benchmarks" / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        with pytest.MonkeyPatch.context() as patch:
            patch.syspath_prepend(repository / "benchmarks")
            for key, value in {name: module, **neighbours}.items():
                patch.setitem(sys.modules, key, value)
            spec.loader.exec_module(module)
        sys.modules.setdefault(name, module)  # dataclasses look their module up
        return module

    return load


@pytest.fixture(scope="session")
def refused_with():
    """refused_with(error, words): what stands below must end in an error that says all of them."""

    @contextlib.contextmanager
    def block(error, words):
        with pytest.raises(error) as caught:
            yield
        assert all(word in str(caught.value) for word in words), str(caught.value)

    return block


@pytest.fixture
def written(tmp_path):
    """Write a configuration file and return its path."""

    def write(text: str, name: str = "run.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write
