"""Configuration files: reading, defaults, settings over the file, what is written back, the schema, and the systems."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from ruamel.yaml import YAML

import yid_ocp as yid
from yid_ocp.config.reader import DEFAULT, dump_config, load_config, schema
from yid_ocp.config.settings import SegmentedObject, YObject
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.solvers import GaussNewton, SteepestDescent
from yid_ocp.workflow.build import build_problem, build_system, load_problem, load_system, problem_options


@pytest.fixture
def written(tmp_path):
    def write(text: str, name: str = "run.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_the_embedded_default_is_the_one_in_configs(repository):
    embedded = repository / "yid_ocp" / "data" / "defaults" / DEFAULT
    assert embedded.read_bytes() == (repository / "configs" / DEFAULT).read_bytes()
    assert load_config() == dataclasses.replace(load_config(repository / "configs" / DEFAULT))


def test_numbers_as_in_yaml_1_2(written):
    run = load_config(
        written(
            "solver: {time_step: 1e-3, huber_threshold: .inf, iterations: 010, path_cutoff: 5}\ndescription: 'yes'\n"
        )
    )
    assert run.problem.time_step == 1e-3
    assert math.isinf(run.problem.huber_threshold)
    assert run.solver.method == GaussNewton(iterations=10)
    assert run.problem.path_cutoff == 5.0
    assert run.description == "yes"


def test_an_empty_file_is_all_defaults(written):
    run = load_config(written(""))
    assert run.model.object is None
    assert run.model.damping == 0.05
    assert run.solver.method == GaussNewton()


def test_a_solvers_own_settings_stand_beside_the_common_ones(written):
    run = load_config(written("solver: {name: steepest_descent, iterations: 7, shrink: 0.3, time_step: 0.02}\n"))
    assert run.solver.method == SteepestDescent(iterations=7, shrink=0.3)
    assert run.problem.time_step == 0.02
    with pytest.raises(ConfigError, match="there is no key 'shrink'"):
        load_config(written("solver: {name: gauss_newton, shrink: 0.3}\n"))


def test_paths_are_relative_to_the_file(written, tmp_path):
    run = load_config(
        written(
            "model: {robot: ../arm.urdf}\n"
            "recordings: {estimate: [a/b.h5, default:x.h5], held_out: [/elsewhere/c.h5]}\n"
            "output: {folder: results}\n"
        )
    )
    assert run.model.robot == str((tmp_path.parent / "arm.urdf").resolve())
    assert run.recordings.estimate == (str(tmp_path.resolve() / "a" / "b.h5"), "default:x.h5")
    assert run.recordings.held_out == ("/elsewhere/c.h5",)
    assert run.output.folder == str(tmp_path.resolve() / "results")
    assert load_config(written("model: {robot: package:panda}\n")).model.robot == "package:panda"


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("parameters.T1.bend.initial=5", ("parameters", "T1.bend", "initial", 5.0)),
        ("parameters.kelvin_voigt@T3.tau.free=true", ("parameters", "kelvin_voigt@T3.tau", "free", True)),
        ("parameters.T*.bend.bounds=[0, 9]", ("parameters", "T*.bend", "bounds", (0.0, 9.0))),
        ("sensors.joints.effort.std=0.1", ("sensors", "joints.effort", "std", 0.1)),
        ("sensors.joints.effort.std={a: 0.1}", ("sensors", "joints.effort", "std", {"a": 0.1})),
        ("model.grasp.left.kind=weld", ("model", "grasp", "left", "kind", "weld")),
        ("solver.iterations=3", ("solver", "method", "iterations", 3)),
        ("model.object={kind: y, links: 2}", ("model", "object", "links", 2)),
        ("model.object.links=6", ("model", "object", "links", 6)),
        ("model.damping=0.1", ("model", "damping", 0.1)),
        ("model.springs.left_s1={stiffness: 20}", ("model", "springs", "left_s1", "stiffness", 20.0)),
        ("parameters.T1.bend={initial: 5, free: false}", ("parameters", "T1.bend", "free", False)),
        (
            "diagnosis.candidates=[density, kelvin_voigt@T3]",
            ("diagnosis", "candidates", ("density", "kelvin_voigt@T3")),
        ),
    ],
)
def test_settings_over_the_file(setting, value):
    node = load_config(None, [setting])
    for key in value[:-1]:
        node = node[key] if isinstance(node, dict) else getattr(node, key)
    assert node == value[-1]


def test_settings_over_the_file_keep_what_they_do_not_touch():
    run = load_config(None, ["parameters.T1.bend.initial=5"])
    assert run.parameters["T1.bend"].free
    assert len(run.parameters) == 6
    assert run.where("parameters", "T1.bend", "initial").startswith("--set parameters.T1.bend.initial")
    assert "line" in run.where("parameters", "T2.bend", "free")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("model:\n  object: {links: 4}\n", "line 2: model.object"),
        ("model:\n  object: {kind: cube}\n", "there is no kind 'cube'"),
        ("model:\n  object: 3\n", "model.object = 3 is not a section"),
        ("model:\n  object:\n    kind: segments\n    segments: {a: {length: 1, radius: 0.1}}\n", "'mass' is missing"),
        ("model:\n  grasp: {left: {holder: x}}\n", "'held' is missing"),
        ("model:\n  grasp: [left]\n", "model.grasp"),
        ("model:\n  gravity: [0, 0]\n", "a list of 3"),
        ("model:\n  arms: {joints: left_s0}\n", "a list"),
        ("solver:\n  duration: true\n", "a number"),
        ("solver:\n  time_step: '0.01'\n", "a number"),
        ("solver:\n  gains: []\n", "problem.gains"),
        ("description: 2024-01-01\n", "description"),
        ("sensors:\n  points: {std: 0}\n", "above 0"),
    ],
)
def test_refusals(written, text, message):
    with pytest.raises(ConfigError) as caught:
        load_config(written(text))
    assert message in str(caught.value)
    assert "run.yaml" in str(caught.value)
    assert "line" in str(caught.value)


@pytest.mark.parametrize("name", ["dual_arm_vision", "baxter_arm"])
def test_written_back_it_is_the_same_run(repository, tmp_path, name):
    run = load_config(repository / "configs" / f"{name}.yaml")
    (tmp_path / f"{name}.yaml").write_text(dump_config(run))
    assert load_config(tmp_path / f"{name}.yaml") == run


def test_the_schema_accepts_every_configuration_and_refuses_typos(repository):
    rules = schema()
    jsonschema.Draft202012Validator.check_schema(rules)
    files = sorted((repository / "configs").glob("*.yaml"))
    assert len(files) >= 5
    for file in files:
        jsonschema.validate(YAML(typ="safe").load(file.read_text()), rules)
    for wrong in ({"sovler": {}}, {"solver": {"time_step": "fast"}}, {"model": {"object": {"kind": "cube"}}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, rules)
    described = rules["properties"]["solver"]["properties"]["time_step"]
    assert described["description"] == "of the integrator [s]"
    assert described["default"] == 0.01


@pytest.mark.parametrize(("name", "size", "constraints"), [("single_arm_vision", 43, 3), ("dual_arm_vision", 50, 6)])
def test_the_papers_systems(repository, paper_systems, name, size, constraints):
    system = yid.load_system(repository / "configs" / f"{name}.yaml")
    assert (system.size, system.constraint_count) == (size, constraints)
    reference = paper_systems["single" if size == 43 else "dual"]
    assert system.mechanism.joint_names == reference.mechanism.joint_names
    assert system.parameters.names == reference.parameters.names
    np.testing.assert_array_equal(system.parameters.vector(), reference.parameters.vector())
    assert system.parameters.vector({"T1.bend": 22.0})[system.parameters.index("T1.bend")] == 22.0


def test_parameters_of_a_run(written):
    run = load_config(
        written(
            "model: {object: {kind: y}}\n"
            "parameters:\n"
            "  T*.bend: {initial: 5, free: true, bounds: [0, 50]}\n"
            "  T2.bend: {initial: 7, prior: 2.0}\n"
            "  T1.mass: {initial: 0.07}\n"
        )
    )
    system = build_system(run)
    assert [system.parameters[f"T{i}.bend"].value for i in (1, 2, 3)] == [5, 7, 5]
    assert system.parameters["T3.bend"].upper == 50
    assert system.parameters["T1.mass"].value == 0.07
    options = problem_options(run, system.parameters)
    assert options.priors == {"T2.bend": 2.0}


def test_an_object_of_segments_on_a_robots_hand(written):
    run = load_config(
        written(
            "model:\n"
            "  robot: package:panda\n"
            "  arms:\n"
            f"    joints: [{', '.join(f'panda_joint{i}' for i in range(1, 8))}]\n"
            "    mode: prescribed\n"
            "  object:\n"
            "    kind: segments\n"
            "    mount: {frame: panda_hand, xyz: [0, 0, 0.1], rpy: [0, 1.5708, 0]}\n"
            "    segments:\n"
            "      beam: {length: 0.5, mass: 0.3, radius: 0.01, links: 5, bend: 1.3, rigidity: true, clamped: true}\n"
            "      tip: {link_lengths: [0.1, 0.05], mass: 0.01, radius: 0.01, parent: beam, damping: 0.001}\n"
        )
    )
    assert isinstance(run.model.object, SegmentedObject)
    system = build_system(run)
    assert system.size == 7 + 15 + 6
    assert len(system.prescribed) == 7
    assert system.parameters["beam.bend"].unit == "N m^2"
    assert system.parameters["tip.damping"].value == 0.001
    finer = build_system(run, links=10)
    assert finer.size == 7 + 30 + 6
    assert finer.parameters["beam.bend"].value == 1.3
    assert finer.parameters["tip.bend"].value == 3.0


def test_more_links_keep_the_stiffness_of_a_tube(written):
    run = load_config(written("model: {object: {kind: y, mount: {xyz: [0, 0, 1]}}, damping: 0.02}\n"))
    assert isinstance(run.model.object, YObject)
    finer = build_system(run, links=8)
    assert finer.parameters["T1.bend"].value == 6.0
    assert finer.parameters["T1.damping"].value == 0.02
    assert finer.size == 72


def test_springs_on_joints(written, urdf_folder):
    run = load_config(
        written(
            f"model:\n  robot: {urdf_folder / 'mixed_joints.urdf'}\n  arms: {{mode: passive}}\n"
            "  springs:\n    hinge: {stiffness: 2.0, rest: 0.1, damping: 0.3}\n    slide: {stiffness: 50.0}\n"
            "  damping: {spin: 0.2}\n"
        )
    )
    system = build_system(run)
    parameters = system.parameters
    assert (parameters["hinge.stiffness"].unit, parameters["hinge.rest"].value) == ("N m/rad", 0.1)
    assert (parameters["slide.stiffness"].unit, parameters["slide.rest"].unit) == ("N/m", "m")
    assert [parameters[f"{joint}.damping"].value for joint in ("hinge", "spin", "slide")] == [0.3, 0.2, 0.05]
    assert (system.driven, system.prescribed) == ((), ())


def test_effects_bring_their_parameters(written):
    text = (
        "model:\n"
        "  object: {kind: y}\n"
        "  effects:\n"
        "    - {kind: kelvin_voigt, location: T3}\n"
        "    - {kind: density, location: T2, values: {scale: 1.1}}\n"
        "parameters:\n"
        "  kelvin_voigt@T3.tau: {free: true, initial: 0.02}\n"
    )
    run = load_config(written(text))
    system = build_system(run)
    assert [(effect.kind, effect.location) for effect in system.effects] == [("kelvin_voigt", "T3"), ("density", "T2")]
    assert system.parameters["kelvin_voigt@T3.tau"].value == 0.02
    assert system.parameters["density@T2.scale"].value == 1.1
    assert load_config(written(dump_config(run))) == run
    for old, new, message in (
        ("kelvin_voigt, loc", "kelvin_voight, loc", "line 4: model.effects.0"),
        ("location: T2", "location: T9", "line 5: model.effects.1"),
        ("location: T3", "locaton: T3", "did you mean 'location'?"),
        ("scale: 1.1", "scale: much", "model.effects.1.values"),
    ):
        with pytest.raises((ConfigError, ModelError)) as caught:
            load_system(written(text.replace(old, new)))
        assert message in str(caught.value)


def test_errors_of_the_model_name_the_setting(written):
    for text, message in (
        ("model:\n  robot: package:baxterr\n", "line 2: model.robot"),
        ("model:\n  robot: package:baxter\n  damping: {left_s9: 1}\n", "line 3: model.damping.left_s9"),
        ("model:\n  object: {kind: segments, segments: {a: {mass: 1, radius: 0.1}}}\n", "line 2: model.object"),
        ("model:\n  object: {kind: y}\n  points: [w_T9]\n", "line 1: model"),
    ):
        with pytest.raises((ConfigError, ModelError)) as caught:
            load_system(written(text))
        assert message in str(caught.value)


def test_a_problem_from_a_file(repository):
    problem = load_problem(
        repository / "configs" / "single_arm_vision.yaml",
        ["model.object.links=1", "problem.compiler=false", "problem.duration=0.3", "sensors.points_camera.use=false"],
    )
    assert problem.free == tuple(f"T{i}.{kind}" for i in (1, 2, 3) for kind in ("bend", "twist"))
    assert [s.sensor.group for s in problem.episodes[0].samples] == ["points_arm"]
    assert len(problem.held_out) == 1
    assert (
        build_problem(load_config(repository / "configs" / "single_arm_vision.yaml"), problem.step).free == problem.free
    )


def test_the_public_names_exist():
    for name in yid.__all__:
        assert getattr(yid, name) is not None
    assert set(yid.__all__) <= set(dir(yid))
    with pytest.raises(AttributeError, match="no attribute 'slove'"):
        yid.slove  # noqa: B018
