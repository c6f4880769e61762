"""Reading: defaults, numbers, paths, settings over the file, and what is refused with which words."""

import dataclasses
import io
import math
from dataclasses import MISSING
from typing import Literal, get_args, get_origin

import pytest
from annotated_types import Ge, Gt, Le, Lt
from ruamel.yaml import YAML

from yid_ocp import options
from yid_ocp.config.reader import SHIPPED_DEFAULT_CONFIG_FILE_NAME, load_config
from yid_ocp.config.schema import section_variants_from_annotation
from yid_ocp.config.settings import RunSettings
from yid_ocp.errors import ConfigError
from yid_ocp.solvers import GaussNewton, SteepestDescent

RENAMED = "CHANGELOG.md of the project has the new names of older ones"


def test_the_embedded_default_is_the_one_in_configs(repository):
    embedded = repository / "yid_ocp" / "data" / "defaults" / SHIPPED_DEFAULT_CONFIG_FILE_NAME
    assert embedded.read_bytes() == (repository / "configs" / SHIPPED_DEFAULT_CONFIG_FILE_NAME).read_bytes()
    assert load_config() == dataclasses.replace(load_config(repository / "configs" / SHIPPED_DEFAULT_CONFIG_FILE_NAME))


def test_numbers_as_in_yaml_1_2(written):
    text = "problem: {time_step: 1e-3, huber_threshold: .inf, path_cutoff: 5}\n"
    run = load_config(written(f"{text}solver: {{max_iterations: 010}}\ndescription: 'yes'\n"))
    assert run.problem.time_step == 1e-3
    assert math.isinf(run.problem.huber_threshold)
    assert run.solver == GaussNewton(max_iterations=10)
    assert run.problem.path_cutoff == 5.0
    assert run.description == "yes"


def test_paths_are_relative_to_the_file(written, tmp_path):
    text = "recordings: {estimate: [a/b.h5, default:x.h5], held_out: [/elsewhere/c.h5]}\n"
    run = load_config(written(f"{text}model: {{robot: ../arm.urdf}}\noutput: {{runs_folder: results}}\n"))
    assert run.model.robot == str((tmp_path.parent / "arm.urdf").resolve())
    assert run.recordings.estimate == (str(tmp_path.resolve() / "a" / "b.h5"), "default:x.h5")
    assert run.recordings.held_out == ("/elsewhere/c.h5",)
    assert run.output.runs_folder == str(tmp_path.resolve() / "results")
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
        ("solver.max_iterations=3", ("solver", "max_iterations", 3)),
        ("model.object={kind: foam_y, links: 2}", ("model", "object", "links", 2)),
        ("model.object.links=6", ("model", "object", "links", 6)),
        ("model.damping=0.1", ("model", "damping", 0.1)),
        ("model.joint_springs.left_s1={stiffness: 20}", ("model", "joint_springs", "left_s1", "stiffness", 20.0)),
        ("parameters.T1.bend={initial: 5, free: false}", ("parameters", "T1.bend", "free", False)),
        ("diagnosis.candidates=[density, gain@T3]", ("diagnosis", "candidates", ("density", "gain@T3"))),
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
    assert run.setting_location("parameters", "T1.bend", "initial").startswith("--set parameters.T1.bend.initial")
    assert "line" in run.setting_location("parameters", "T2.bend", "free")
    made = load_config(None, ["parameters.T9.free=true"])
    assert made.setting_location("parameters", "T9") == "--set parameters.T9.free: parameters.T9"
    beside = load_config(None, ["diagnosis.budget=60"]).setting_location("diagnosis", "significance_level")
    assert not beside.startswith("--set"), "an override of another key is not to blame"
    whole = load_config(None, ["parameters.T1.bend={initial: 5}"])
    assert whole.setting_location("parameters", "T1.bend", "initial") == "--set parameters.T1.bend: initial"


METHOD = "compare.methods.multiple_shooting"
CODE_ONLY = "first_trial_step_rule"
METHODS = "compare:\n  methods:\n    gauss_newton: {}\n    multiple_shooting:\n      VALUE\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("model:\n  object: {links: 4}\n", ["line 2: model.object"]),
        ("model:\n  object: {kind: cube}\n", ["there is no kind 'cube'"]),
        ("model:\n  object: 3\n", ["model.object = 3 is not a section"]),
        ("model: {object: {kind: segments, named_segments: {a: {length: 1, radius: 0.1}}}}", ["'mass' is missing"]),
        ("model:\n  grasp: {left: {holder_frame: x}}\n", ["'held_frame' is missing"]),
        ("model:\n  grasp: [left]\n", ["model.grasp"]),
        ("model:\n  gravity: [0, 0]\n", ["a list of 3", "[0.0, 0.0, -9.81] (the default)"]),
        ("model:\n  arms: {joints: left_s0}\n", ["a list of text", 'one entry: ["left_s0"]']),
        ("problem:\n  duration: true\n", ["a number"]),
        ("problem:\n  time_step: '0.01'\n", ["a number"]),
        ("problem:\n  arm_proportional_gains: []\n", ["problem.arm_proportional_gains"]),
        ("description: 2024-01-01\n", ["description"]),
        ("sensors:\n  points: {std: 0}\n", ["above 0"]),
        # unknown keys: the nearest one, and the sections that have it
        ("problem: {iteration: 3}", ["did you mean 'duration'?"]),
        ("problem: {max_iterations: 3}", ["key of `solver` and of `compare.methods.NAME`"]),
        (
            "solver: {name: steepest_descent, step_tolerance: 1}",
            ["'step_tolerance' is a key of `solver` with name: gauss_newton, multiple_shooting"],
        ),
        ("solver: {time_step: 1}", ["there is no key 'time_step' in solver", "'time_step' is a key of `problem`"]),
        ("solver: {held_out: []}", ["'held_out' is a key of `recordings`"]),
        ("solver: {parameters: {}}", ["'parameters' is a key of the file itself"]),
        ("solver: {name: gauss_newton, nonmonotone_memory: 3}", ["there is no key 'nonmonotone_memory'"]),
        ("xyzzy: 3", ["leave 'xyzzy' out", RENAMED]),
        ("solver: {name: lifted}", ["there is no solver 'lifted'", RENAMED]),
        ("diagnosis: {refits: 3}", ["there is no key 'refits'", RENAMED]),
        # what only code sets
        ("problem: {known_initial_states: {}}", ["there is no key"]),
        ("problem: {prior_stds: {a: 1}}", ["there is no key"]),
        ("key_locations: {}", ["there is no key"]),
        ("parameters.T1.bend.free: false", ["there is no key", "write --set parameters.T1.bend.free=VALUE"]),
        # compared methods are typed like the solver
        (METHODS.replace("VALUE", "max_iterations: abc"), [f"{METHOD}.max_iterations", "number from 1", "line 5"]),
        (METHODS.replace("VALUE", "max_iteration: 3"), [f"'max_iteration' in {METHOD}", "mean 'max_iterations'?"]),
        (METHODS.replace("VALUE", f"{CODE_ONLY}: last"), [f"no key '{CODE_ONLY}'", "node_interval", "line 5"]),
        (METHODS.replace("VALUE", "name: multiple_shooting"), ["there is no key 'name'"]),
        ("compare: {methods: {newton: {}}}\n", ["no solver 'newton'", "'gauss_newton'?", "1: compare.methods.newton"]),
    ],
)
def test_refusals(refused_with, written, text, words):
    with refused_with(ConfigError, (*words, "run.yaml", "line")):
        load_config(written(text))


def test_the_solver_and_compared_methods(written):
    run = load_config(written("solver: {name: steepest_descent, max_iterations: 7, nonmonotone_memory: 3}\n"))
    assert run.solver == SteepestDescent(max_iterations=7, nonmonotone_memory=3)
    run = load_config(written(METHODS.replace("VALUE", "max_iterations: 7")))
    assert list(run.compare.methods) == ["gauss_newton", "multiple_shooting"]
    chosen = run.compare.methods["multiple_shooting"]
    assert (chosen.max_iterations, chosen.name) == (7, "multiple_shooting")


SET = """\
sensors:
  points: {std: 0.002, use: true}
  joints.effort: {std: 0.1}
parameters:
  T1.bend: {free: true, initial: 5.0}
solver: {name: gauss_newton, max_iterations: 7}
model: {object: {kind: foam_y, links: 3}}
"""


def test_set_merges_sections(written):
    file = written(SET)
    run = load_config(file, ["sensors={points: {std: 0.001}, camera: {use: false}}"])
    assert (run.sensors["points"].std, run.sensors["points"].use) == (0.001, True)
    assert (run.sensors["joints.effort"].std, run.sensors["camera"].use) == (0.1, False)
    both = ["parameters.T1.bend.initial=4", "parameters={T1.bend: {bounds: [1, 9]}, T2.*: {free: true}}"]
    run = load_config(file, both)
    bend = run.parameters["T1.bend"]
    assert (bend.free, bend.initial, bend.bounds) == (True, 4.0, (1.0, 9.0))
    assert run.parameters["T2.*"].free
    assert load_config(file, ["solver={step_tolerance: 1e-3}"]).solver.max_iterations == 7
    assert load_config(file, ["model={gravity: [0, 0, -1]}"]).model.object.links == 3


def test_set_replaces_lists_other_kinds_and_what_is_emptied_first(written):
    file = written(SET)
    other = load_config(file, ["solver={name: single_shooting}"]).solver
    assert (other.name, other.max_iterations) == ("single_shooting", type(other)().max_iterations)
    assert load_config(file, ["model.object={kind: segments, named_segments: {}}"]).model.object.kind == "segments"
    assert load_config(file, ["model.object={kind: foam_y}"]).model.object.links == 3
    assert load_config(file, ["sensors={}"]).sensors == {}
    assert list(load_config(file, ["sensors=null", "sensors={camera: {use: false}}"]).sensors) == ["camera"]
    assert load_config(file, ["recordings.estimate=[a.h5]", "recordings.estimate=[b.h5]"]).recordings.estimate[1:] == ()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("sensors.points.sdt=3", ["there is no key 'sdt'", "did you mean 'std'?"]),
        ("problem.weighting=whitend", ['is "whitend", which is not allowed', "did you mean 'whitened'?"]),
        ("sensors.camera.sdt=3", ["sensors.camera.sdt = 3 is not a section", "did you mean 'std'?"]),
        ("parameters.T2.bend=5", ["is not a section", "add a key, as in parameters.T2.bend.initial"]),
        ("sensors={points: {sdt: 3}}", ["no key 'sdt' in", "'std'?", "where: --set sensors: sensors.points.sdt"]),
        ("parameters.T2.bend.free=maybe", ["true or false"]),
        ("compare.methods.gauss_newton.max_iterations=abc", ["a whole number from 1"]),
        ("solver.time_step=0.01", ["'time_step' is a key of `problem`"]),
        ("problem.time_step=fast", ["a number"]),
        ("parameters.shoulder.stiffness.initail=3", ["did you mean 'initial'?"]),
        ("problem.time_step.deeper=1", ["'problem.time_step' has a value, and no key 'deeper' below it"]),
        ("model.effects={kind: law}", ["a list of sections, such as {kind: KIND, location: ", "entry: [{"]),
        ("problem.time_step=[1", ["not valid YAML"]),
        ("problem={duration: 0,5}", ["there is no key '5'", "write a decimal point"]),
        ("parameters=[a]", ["a section, such as {NAME: {initial: VALUE}}"]),
        ("solver={name:single_shooting}", ["put a space after the colon, as in {name: single_shooting}"]),
    ],
)
def test_what_is_set_wrong_is_told_with_the_nearest_key(refused_with, written, setting, words):
    with refused_with(ConfigError, (*words, f"--set {setting.split('=')[0]}")):
        load_config(written(SET), [setting])


# Numbers that may have any value: places, angles, offsets.
ANY_NUMBER = {
    "import.file_clock_offsets.NAME", "plan.start_joint_positions.NAME", "import.torque_constants.NAME",
    "import.gear_ratios.NAME", "sensors.NAME.constants.NAME", "sensors.NAME.constants.NAME.NAME",
    "model.arms.locked_joints.NAME", "model.joint_springs.NAME.rest_position", "model.effects.values.NAME",
    "parameters.NAME.initial", "track.virtual_frames.latency", "track.options.filters.floor_height",
    "track.options.filters.max_depth_behind_robot_base",
    "track.options.clock_offset_search.initial_stamp_minus_joint_time",
}  # fmt: skip


def numbers(hint, wrap=lambda value: value, path=(), option=None):
    """Every number that a file may hold: its key, what the file around it looks like, its option's type, its bounds."""
    sections = section_variants_from_annotation(hint)
    for word, kind in (sections.classes if sections is not None else {}).items():
        known = options.class_options_by_key(kind)
        needed = {key: needed_value(own.type_hint) for key, own in known.items() if own.default_value is MISSING}
        needed |= {sections.selector_key: word} if sections.selector_key else {}
        for name, entry in known.items():
            yield from numbers(entry.type_hint, within(wrap, name, needed), (*path, name), entry.type_hint)
    if sections is not None:
        return
    values = options.mapping_value_type(hint)
    named = section_variants_from_annotation(values)
    if named is not None and named.selector_key == "name":
        for name in named.classes:
            yield from numbers(named.variants_for_named_entry(name, "").classes[""], within(wrap, name), (*path, name))
    elif values is not None:
        yield from numbers(values, within(wrap, "NAME"), (*path, "NAME"), option)
    for member in options.non_none_union_members(hint):
        entries, (bare, markers) = options.variadic_tuple_entry_type(member), options.split_annotated(member)
        if entries is not None:
            yield from numbers(entries, lambda value: wrap([value]), path, option)
        if bare in (int, float):
            every = (*options.split_annotated(hint)[1], *markers)
            yield ".".join(path), wrap, option, [own for own in every if isinstance(own, Gt | Ge | Lt | Le)]


def within(wrap, name, beside=None):
    return lambda value: wrap({**(beside or {}), name: value})


def needed_value(hint):
    bare, _ = options.split_annotated(hint)
    if get_origin(bare) is Literal:
        return get_args(bare)[0]
    return 1.0 if bare is float else [*"abcde"] if options.variadic_tuple_entry_type(hint) is not None else "a"


NUMBERS = list(numbers(RunSettings))


def outside():
    """A wrong value for every bound."""
    for key, wrap, option, bounds in NUMBERS:
        for bound in bounds:
            kind = type(bound).__name__
            wrong = getattr(bound, kind.lower()) + {"Gt": 0, "Lt": 0, "Ge": -1, "Le": 1}[kind]
            yield pytest.param(key, wrap(wrong), option, id=f"{key}={wrong}")


def test_every_number_has_bounds_or_may_be_anything():
    assert {key for key, _, _, bounds in NUMBERS if not bounds} == ANY_NUMBER
    assert len({key for key, *_ in NUMBERS}) > 100


@pytest.mark.parametrize(("key", "data", "option"), list(outside()))
def test_a_number_outside_its_bounds_is_refused(written, key, data, option):
    stream = io.StringIO()
    YAML(typ="safe").dump(data, stream)
    with pytest.raises(ConfigError) as caught:
        load_config(written(stream.getvalue()))
    assert caught.value.allowed == options.describe_type(option)
    assert "line" in caught.value.where
    assert [part for part in key.split(".") if part != "NAME"][-1] in caught.value.where


ALIASES = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{two}: &{two} [{', '.join(['*' + one] * 9)}]\n" for one, two in zip("abcdefghij", "bcdefghijk", strict=True)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ALIASES, "aliases"),
        ("a: &a {b: 1}\nc: [" + "{<<: *a}, " * 600 + "]", "aliases"),
        ("description: &a [*a]\n", "not allowed"),
        ("description: " + "[" * 3000 + "]" * 3000, "levels"),
        ("{a: " * 2000 + "1" + "}" * 2000, "levels"),
        ("model: !!python/object:os.system {a: 1}", "tag"),
        ("problem: {time_step: !odd 0.01}", "tag"),
        ("problem: {time_step: " + "9" * 5000 + "}", "digits"),
        ("problem: {time_step: 0x" + "f" * 6000 + "}", "too many digits"),
        ('description: "a\\0b"', "null character"),
        ("? [a, b]\n: 3", "no key"),
        ("a: 1\n---\nb: 2", "not valid YAML"),
        ('description: "two "springs"\n', "after a closing quote"),
        ("problem:\n  <<: {time_step: 0.02}\n  use_compiler: 3\n", r"line 3: problem\.use_compiler"),
    ],
)
def test_odd_yaml_is_refused_at_once(written, text, said):
    with pytest.raises(ConfigError, match=said):
        load_config(written(text))


@pytest.mark.parametrize("folder", ["arm-check-20261130-083851", "arm-20261130-083851-2", "arm"])
def test_the_settings_of_a_run_folder_have_the_name_of_its_model(folder, tmp_path):
    (tmp_path / folder).mkdir()
    file = tmp_path / folder / "config.yaml"
    file.write_text("{}\n")
    assert load_config(file).name == "config"
    (tmp_path / folder / "result.json").write_text("{}\n")
    assert load_config(file).name == "arm"
