"""The page on looking into equations: its commands exist and what it quotes is what comes out."""

from __future__ import annotations

import re
import shlex

import pytest

from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.config.reader import load_config
from yid_ocp.export.equations import _MAX_JACOBIAN_OPERATIONS
from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.workflow.build import build_system


@pytest.fixture(scope="module")
def page(repository) -> str:
    return (repository / "docs" / "inspection.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def symbols(repository) -> StepSymbols:
    return StepSymbols.from_equations(
        discrete_equations(build_system(load_config(repository / "configs/dual_arm_vision.yaml")))
    )


def test_its_commands_exist_and_its_entries_are_there(page, symbols, repository) -> None:
    from yid_ocp.cli import build_argument_parser

    [block] = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    for line in block.strip().splitlines():
        name, *arguments = shlex.split(line)
        assert name == "yid-ocp"
        said = build_argument_parser().parse_args(arguments)
        assert (repository / said.config).is_file()
        for entry in said.entries:
            assert symbols.equation_entry(entry).title.split(" / ")[0].removeprefix("d ") == entry.split(",")[0]


def test_the_entry_that_it_quotes_is_the_one_that_comes_out(page, symbols) -> None:
    lines = symbols.equation_entry("del[T2_3_z], T2.twist").text_lines
    assert "\n".join(f"    {line}" for line in lines) in page


def test_its_script_runs(page, repository, monkeypatch, capsys) -> None:
    [script] = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(repository)
    exec(compile(script, "inspection.md", "exec"), {})
    assert "d del[T1_0_x] / d T1.bend = -h/2*0.5*(q0[T1_0_x] + q1[T1_0_x])" in capsys.readouterr().out


def test_the_names_that_it_lists_are_names(page, symbols) -> None:
    listed = re.findall(r"`((?:del|constraint|p1|q0|p0|u|q1|lam)\[[\w.]+\])`", page)
    assert len(listed) > 6
    for name in listed:
        assert name in (*symbols.row_names, *symbols.column_names), name
    assert f"{_MAX_JACOBIAN_OPERATIONS:_}".replace("_", " ") in page
