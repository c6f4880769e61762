"""The worked example of docs/extending.md runs as it stands."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest
from ruamel.yaml import YAML

from yid_ocp.files import file_sha256


@pytest.fixture(scope="module")
def text(repository) -> str:
    return (repository / "docs" / "extending.md").read_text(encoding="utf-8")


def test_the_example_runs(text, repository, tmp_path) -> None:
    blocks = re.findall(r"```python ?(\S*)\n(.*?)```", text, re.DOTALL)
    assert blocks[0][0] == "churning.py"
    for name, block in blocks:
        if name:
            (tmp_path / name).write_text(block, encoding="utf-8")
    script = "\n".join(block for name, block in blocks if not name)
    # a process of its own: kinds stay registered
    (tmp_path / "example.py").write_text(
        f"import sys\nsys.path[:0] = [{str(repository)!r}]\n{script}", encoding="utf-8"
    )
    run = subprocess.run([sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_the_configuration_is_valid(text) -> None:
    from yid_ocp.config.settings import EffectSettings

    [block] = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    [entry] = YAML(typ="safe", pure=True).load(block)["model"]["effects"]
    said = EffectSettings(**entry)
    assert (said.kind, said.location, said.values) == ("joint_churning", "left_e1", {"c": 0.3})


def test_the_plugins_run_from_a_configuration(text, repository, pendulum_data, tmp_path) -> None:
    files = dict(re.findall(r"```python (\S+)\n(.*?)```", text, re.DOTALL))
    [block] = re.findall(r"```yaml plugins\n(.*?)```", text, re.DOTALL)
    said = YAML(typ="safe", pure=True).load(block)
    for name in said["plugins"]:
        (tmp_path / name).write_text(files[name], encoding="utf-8")
    assert [(e["kind"], e["location"]) for e in said["model"]["effects"]] == [("pole", "w_rod")]
    effects = "[{kind: pole, location: tip, values: {strength: 0.02}}, {kind: thrust, location: tip}]"
    config = tmp_path / "drawn.yaml"
    given = pendulum_data.text.replace("model:\n", f"plugins: {said['plugins']}\nmodel:\n  points: [tip]\n", 1)
    config.write_text(given.replace("  springs:", f"  effects: {effects}\n  springs:"), encoding="utf-8")
    # a process of its own, whose kinds are no other test's
    script = f"import sys; sys.path[:0] = [{str(repository)!r}]; from yid_ocp.cli import main; sys.exit(main())"
    command = [
        sys.executable,
        "-c",
        script,
        "solve",
        "drawn.yaml",
        "--out",
        "run",
        "--set",
        "output.write_report=false",
    ]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    result = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))
    assert result["parameters"]["shoulder.stiffness"]["verdict"] == "identifiable"
    assert result["inputs"][str(tmp_path / "magnet.py")] == file_sha256(tmp_path / "magnet.py")
    assert set(result["inputs"]) >= {str(tmp_path / name) for name in said["plugins"]}


def test_what_it_names_exists(text) -> None:
    from yid_ocp.effects import EFFECTS
    from yid_ocp.effects.base import EffectBase
    from yid_ocp.model.system import RecordingErrorEffect

    rows = re.findall(r"^\| `(\w+)\((.*?)\)` \|.*\| (.*?) \|$", text, re.MULTILINE)
    assert {name for name, _, _ in rows} >= {
        "apply_to_system",
        "step_terms",
        "distorted_reading",
        "corrected_reading",
        "added_delay",
    }
    for name, arguments, examples in rows:
        code = getattr(EffectBase, name).__code__
        assert list(code.co_varnames[1 : code.co_argcount]) == arguments.split(", ")
        assert hasattr(RecordingErrorEffect, name)
        for kind in re.findall(r"`(\w+)`", examples):
            assert kind in EFFECTS
            assert getattr(EFFECTS[kind], name) is not getattr(EffectBase, name)
