"""Plug-ins from files and packages."""

from __future__ import annotations

import re
import shlex
from importlib import metadata
from types import SimpleNamespace

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.effects import EFFECTS
from yid_ocp.errors import ConfigError
from yid_ocp.files import file_sha256
from yid_ocp.workflow import run_inputs
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.run_folder import software_and_plugin_versions

EFFECT = """
from yid_ocp.effects.base import EFFECTS, EffectBase, ParameterDefinition, generalized_force_at_joint, arm_joint_names
from yid_ocp.model.system import StepTerms


@EFFECTS.register("{kind}")
class Constant(EffectBase):
    equation = "F = push"
    required_excitation = "how it stands against gravity"

    @classmethod
    def possible_locations(cls, system):
        return arm_joint_names(system)

    @classmethod
    def parameter_definitions(cls, location, system):
        return (ParameterDefinition("push", "N m", 0.0, -5.0, 5.0, (-1.0, 1.0), "constant torque"),)

    def step_terms(self, state):
        return StepTerms(generalized_force=generalized_force_at_joint(state.system, self.location, self["push"]))
"""


@pytest.fixture
def kinds(monkeypatch):
    """Kinds that a test registers are forgotten after it."""
    before = set(EFFECTS)
    monkeypatch.setattr(run_inputs, "_loaded", {})
    yield before
    EFFECTS.unregister(set(EFFECTS) - before)


def configured(file, *names):
    file.write_text(f"plugins: {list(names)}\n{file.read_text()}")
    return load_config(file)


def test_a_file_is_run_once_and_its_kind_is_there(kinds, pendulum) -> None:
    (pendulum.parent / "own.py").write_text(EFFECT.format(kind="constant") + "print('run')\n")
    run = configured(pendulum, "own.py")
    assert "constant" not in EFFECTS  # reading a configuration runs nothing
    build_system(run)
    assert set(EFFECTS) - kinds == {"constant"}
    build_system(run)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1\n", ["plug-in own.py registers nothing", "@EFFECTS.register"]),
        ("\nraise RuntimeError('no magnet')\n", ["raised RuntimeError: no magnet", "line 2"]),
        ("import sys\nsys.exit(3)\n", ["raised SystemExit: 3", "line 2"]),
        ("def f(:\n", ["raised SyntaxError", "line 1"]),
        ("import nothing_like_this\n", ["raised ModuleNotFoundError", "line 1"]),
        (EFFECT.format(kind="density"), ["'density' is taken", "another name"]),
        (EFFECT.format(kind="half") + "1 / 0\n", ["raised ZeroDivisionError", "line 21"]),
    ],
)
def test_what_does_not_work_is_refused_and_leaves_nothing(kinds, pendulum, text, said) -> None:
    (pendulum.parent / "own.py").write_text(text)
    with pytest.raises(ConfigError) as error:
        build_system(configured(pendulum, "own.py"))
    for part in (*said, "pendulum.yaml, line 1: plugins.0"):
        assert part in str(error.value)
    assert set(EFFECTS) == kinds


def test_a_file_that_is_missing_or_changed(kinds, pendulum) -> None:
    own = pendulum.parent / "own.py"
    own.write_text(EFFECT.format(kind="constant"))
    run = configured(pendulum, "own.py")
    build_system(run)
    own.write_text(EFFECT.format(kind="other"))
    with pytest.raises(ConfigError, match="changed after it was loaded"):
        build_system(run)
    own.rename(pendulum.parent / "owm.py")
    with pytest.raises(ConfigError, match=r"no such plug-in(.|\n)*did you mean 'owm.py'"):
        build_system(run)


def test_distributions_are_found_by_their_entry_point(kinds, pendulum, monkeypatch) -> None:
    (pendulum.parent / "constant_effect.py").write_text(EFFECT.format(kind="constant"))
    monkeypatch.syspath_prepend(str(pendulum.parent))
    entry = metadata.EntryPoint("constant", "constant_effect", run_inputs._ENTRY_POINT_GROUP)
    found = replace_dist(entry, SimpleNamespace(name="my-effects", version="1.2"))
    monkeypatch.setattr(run_inputs, "_installed", lambda: [found])
    assert software_and_plugin_versions()["entry point constant"] == "my-effects 1.2"
    build_system(load_config(pendulum))
    assert "constant" in EFFECTS
    run_inputs._loaded.clear()  # as if a script had imported it before
    build_system(load_config(pendulum))
    broken = replace_dist(metadata.EntryPoint("gone", "no_such_module", run_inputs._ENTRY_POINT_GROUP), found.dist)
    monkeypatch.setattr(run_inputs, "_installed", lambda: [broken])
    with pytest.raises(ConfigError, match=r"entry point gone raised ModuleNotFoundError(.|\n)*my-effects 1.2"):
        build_system(load_config(pendulum))


def replace_dist(entry, dist):
    """What `importlib.metadata` does when it finds an entry point of a distribution."""
    return entry._for(dist)


def test_a_diagnosis_names_it_and_its_command_repeats_the_result(kinds, rubbing, tmp_path, carried_out) -> None:
    (tmp_path / "own.py").write_text(EFFECT.format(kind="constant"))
    text = re.sub(r"candidates: \[.*?\]", "candidates: [constant]", rubbing.read_text())
    (tmp_path / "pushed.yaml").write_text(f"plugins: [own.py]\n{text}")
    command, results = ["diagnose", tmp_path / "pushed.yaml", "--set", "output.write_report=false"], []
    for name in ("first", "second"):
        results.append(carried_out(*command, out=name).result)
        command = shlex.split(results[-1]["command"])[1:]
    assert results[0]["inputs"][str(tmp_path / "own.py")] == file_sha256(tmp_path / "own.py")
    assert [entry["kind"] for entry in results[0]["which"]] == ["constant", "constant"]
    assert results[1]["which"] == results[0]["which"]
    assert results[1]["verdict"] == results[0]["verdict"]
