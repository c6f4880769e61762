"""The worked example of docs/extending.md runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from ruamel.yaml import YAML


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


def test_what_it_names_exists(text) -> None:
    from yid_ocp.effects import EFFECTS
    from yid_ocp.effects.base import EffectBase
    from yid_ocp.model.system import RecordedEffect

    rows = re.findall(r"^\| `(\w+)\((.*?)\)` \|.*\| (.*?) \|$", text, re.MULTILINE)
    assert {name for name, _, _ in rows} >= {"modify", "terms", "measure", "correct", "delay"}
    for name, arguments, examples in rows:
        code = getattr(EffectBase, name).__code__
        assert list(code.co_varnames[1 : code.co_argcount]) == arguments.split(", ")
        assert hasattr(RecordedEffect, name)
        for kind in re.findall(r"`(\w+)`", examples):
            assert kind in EFFECTS
            assert getattr(EFFECTS[kind], name) is not getattr(EffectBase, name)
