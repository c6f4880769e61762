"""The LaTeX sheet: sound as LaTeX, complete, and with numbers where they belong."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest
from held_rod import held_rod

from yid_ocp.analysis.step_symbols import StepSymbols
from yid_ocp.effects import make_effect
from yid_ocp.export.equations import write_equation_sheet
from yid_ocp.integrator.discrete import discrete_equations
from yid_ocp.model import System
from yid_ocp.model.servos_and_springs import RobotJointSpring
from yid_ocp.model.urdf import read_urdf


@pytest.fixture(scope="module")
def symbols(urdf_folder):
    """A driven shoulder, an elbow with a spring and an effect with inner coordinates on a rod that is held."""
    system = held_rod(urdf_folder, links=1, ratio=0.4, driven=["shoulder"], springs={"elbow": RobotJointSpring(3.25)})
    return StepSymbols.from_equations(discrete_equations(system))


def sheet(symbols, tmp_path, free=("T1.bend",), time_step=0.01):
    path = tmp_path / "equations.tex"
    write_equation_sheet(path, symbols, symbols.equations.system.parameters.vector(), free, time_step)
    return path.read_text()


def check(text):
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
    for line in body.splitlines():
        for part in re.findall(r"(?<!\\)\$(.*?)(?<!\\)\$", line):
            assert part.count("(") == part.count(")"), part
            assert len(re.findall(r"\\left\b", part)) == len(re.findall(r"\\right\b", part)), part
    # outside mathematics, nothing that only mathematics may have
    outside = re.sub(r"(?<!\\)\$.*?(?<!\\)\$", "", re.sub(r"(?s)\\begin\{align\*\}.*?\\end\{align\*\}", "", body))
    assert not re.search(r"(?<!\\)[_^]", outside), re.search(r".*(?<!\\)[_^].*", outside)


def test_the_sheet_is_sound_and_names_every_row(symbols, tmp_path):
    text = sheet(symbols, tmp_path)
    check(text)
    for block in symbols.row_blocks:
        for label in block.labels:
            assert rf"\mathrm{{{label.replace('_', chr(92) + '_')}}}" in text, label
    for title in ("Letters that stay", "Joints", "Bodies", "Rows"):
        assert rf"\section*{{{title}}}" in text
    assert r"h = 0.01$ s" in text


def test_numbers_stand_for_all_but_what_is_free(symbols, tmp_path):
    text = sheet(symbols, tmp_path)
    letters = set(re.findall(r"\\theta_\{\\mathrm\{([^}]*)\}\}", text))
    assert letters == {"T1.bend"}
    assert r"T1.bend & $4$ & $\mathrm{N\,m/rad}$ \\" in text
    # half the elbow's spring is a number
    elbow = next(line for line in text.splitlines() if line.startswith(r"$\displaystyle R_{k,\,\mathrm{elbow}}"))
    assert "1.625" in elbow
    text = sheet(symbols, tmp_path, free=())
    assert not re.search(r"\\theta_", text)
    assert "Letters that stay" not in text
    assert re.search(r"\\varphi_\{k\+1,\\,\\mathrm\{hand.x\}\} = ", text)


def test_rules_say_what_the_step_does(symbols, tmp_path):
    assert r"\tfrac{h}{2} F - \tfrac12" in sheet(symbols, tmp_path)
    system = symbols.equations.system
    left = StepSymbols.from_equations(discrete_equations(system, "left", "node"))
    text = sheet(left, tmp_path)
    assert r"- L_v(q_m, v_m) + h F - D\varphi(q_k)^{T} \lambda_k" in text
    assert "p_{k+1} &= \\tfrac{h}{2} L_q(q_m, v_m) + L_v(q_m, v_m) \\\\\n" in text
    assert "multiplied by it" not in text
    added = [make_effect("grasp_compliance", "hand", system, {}), make_effect("mount_compliance", "base", system, {})]
    soft = StepSymbols.from_equations(discrete_equations(system.with_effects(added)))
    assert soft.equations.constraint_relaxation_gain is not None
    assert soft.equations.system.joint_compliances
    text = sheet(soft, tmp_path, free=())
    check(text)
    assert r"+ T \left(" in text
    assert "multiplied by it" in text


def test_without_grasps_there_is_no_word_of_them(urdf_folder, tmp_path):
    system = System.build(read_urdf(urdf_folder / "mixed_joints.urdf"))
    text = sheet(StepSymbols.from_equations(discrete_equations(system)), tmp_path, free=())
    check(text)
    assert "varphi" not in text
    assert "lambda" not in text
    assert "pull of the grasps" not in text


def test_short_rows_are_written_out(tmp_path, urdf_folder):
    """One pendulum about one axis: the whole equation fits, its numbers are those of the file."""
    urdf = """<robot name="one"><link name="wall"/><joint name="hinge" type="continuous"><parent link="wall"/>
      <child link="rod"/><axis xyz="0 1 0"/></joint><link name="rod"><inertial><origin xyz="0 0 -0.5"/>
      <mass value="2"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link></robot>"""
    (tmp_path / "one.urdf").write_text(urdf)
    system = System.build(read_urdf(tmp_path / "one.urdf"), damping=0.125)
    text = sheet(StepSymbols.from_equations(discrete_equations(system)), tmp_path, free=())
    check(text)
    row = next(line for line in text.splitlines() if line.startswith(r"$\displaystyle R_{k"))
    assert "B_{" not in row
    assert "0.125" in row
    assert "9.81" in row
    assert r"\sin(" in row
    assert "2 & $(0,\\, 0,\\, -0.5)$" in text.replace("$2$", "2")


def test_the_sheet_compiles_where_there_is_tex(symbols, tmp_path):
    tex = next((found for name in ("pdflatex", "lualatex", "tectonic") if (found := shutil.which(name))), None)
    if tex is None:
        pytest.skip("there is no TeX")
    sheet(symbols, tmp_path)
    options = [] if tex.endswith("tectonic") else ["-interaction=nonstopmode", "-halt-on-error"]
    done = subprocess.run([tex, *options, "equations.tex"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "equations.pdf").stat().st_size > 1000


def test_formulas_are_mathematics_to_another_reader(symbols, tmp_path):
    """matplotlib's own parser takes every formula that has no matrix."""
    from matplotlib.mathtext import MathTextParser

    parser = MathTextParser("path")
    text = sheet(symbols, tmp_path)
    seen = 0
    for part in re.findall(r"(?<!\\)\$(.*?)(?<!\\)\$", text):
        if "matrix" in part:
            continue
        plain = part.replace(r"\displaystyle", "").replace(r"\,", " ").replace(r"\tfrac", r"\frac")
        parser.parse(f"${plain}$")
        seen += 1
    assert seen > 40
