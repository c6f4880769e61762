"""LaTeX document of a step's equations with parameter values filled in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.formula_text import FormulaText, count_operations, format_expressions
from yid_ocp.analysis.step_diagnostics import with_numeric_parameters
from yid_ocp.analysis.step_symbols import StepSymbols, SymbolBlock, escape_latex
from yid_ocp.files import write_text
from yid_ocp.model.mechanism import merge_bodies
from yid_ocp.model.system import System

Array = NDArray[np.float64]

_MAX_ROW_OPERATIONS = 120  # operations up to which a row is written out; beyond, the bodies' part stays a letter
_LATEX_PREAMBLE = r"""\documentclass[a4paper,10pt]{article}
\usepackage[margin=18mm]{geometry}
\usepackage{amsmath,longtable}
\setlength{\parindent}{0pt}
\setlength{\parskip}{4pt}
\raggedright
\allowdisplaybreaks
\begin{document}
"""
_FORCE_AND_CONSTRAINT_TERMS = {
    "symmetric": (r" + \tfrac{h}{2} F", r" + \tfrac{h}{2} F"),
    "left": (" + h F", ""),
    "node": (r" - D\varphi(q_k)^{T} \lambda_k", ""),
    "midpoint": (
        r" - \tfrac12 \left( D\varphi(q_k) + D\varphi(q_m) \right)^{T} \lambda_k",
        r" - \tfrac12 \left( D\varphi(q_m) - D\varphi(q_{k+1}) \right)^{T} \lambda_k",
    ),
}
"""LaTeX of force and constraint terms in the balance and in p1, by `force_split` and `constraint_force`."""


def write_equation_sheet(path: Path, symbols: StepSymbols, theta: Array, free: Sequence[str], time_step: float) -> None:
    """Write the LaTeX document of a step's equations; `OutputError` if the file cannot be written.

    Parameters
    ----------
    path : Path
        `.tex` file.
    symbols : StepSymbols
    theta : ndarray, shape (ntheta,)
        Values filled in for all parameters but the free ones.
    free : sequence of str
        Parameters that stay symbols; a table lists their values.
    time_step : float
        h [s]
    """
    system = symbols.equations.system
    values = dict(zip(system.parameters.names, map(float, theta), strict=True))
    lines = [rf"\section*{{One step of {escape_latex(system.mechanism.name)}}}", *_rules(symbols, time_step)]
    lines += _free_table(system, values, free)
    lines += _tree_tables(system, values)
    lines += [r"\section*{Rows}"]
    for block in symbols.row_blocks:
        if block.labels:
            lines += _rows(symbols, block, values, free)
    write_text(path, _LATEX_PREAMBLE + "\n".join(lines) + "\n\\end{document}\n")


def _rules(symbols: StepSymbols, time_step: float) -> list[str]:
    e = symbols.equations
    held = e.lam.numel() > 0
    force = _FORCE_AND_CONSTRAINT_TERMS[e.force_split]
    pull = _FORCE_AND_CONSTRAINT_TERMS[e.constraint_force] if held else ("", "")
    slack = "" if e.constraint_relaxation_gain is None else r" + T \left( \varphi(q_{k+1}) - \varphi(q_k) \right) / h"
    rows = [
        rf"0 &= p_k + \tfrac{{h}}{{2}} L_q(q_m, v_m) - L_v(q_m, v_m){force[0]}{pull[0]}",
        rf"p_{{k+1}} &= \tfrac{{h}}{{2}} L_q(q_m, v_m) + L_v(q_m, v_m){force[1]}{pull[1]}",
        *([rf"0 &= \varphi(q_{{k+1}}){slack} - C \lambda_k / h"] if held else []),
    ]
    return [
        rf"Time step $h = {time_step:g}$ s, $q_m = (q_k + q_{{k+1}})/2$, $v_m = (q_{{k+1}} - q_k)/h$,",
        r"$L$ the Lagrangian of bodies, springs and energies, $F$ all other forces at the midpoint.",
        r"\begin{align*}",
        " \\\\\n".join(rows),
        r"\end{align*}",
        r"The first line holds at free coordinates; at a prescribed one its right side is $-h$ times the effort.",
        *(["Rows of coordinates that a compliance holds are multiplied by it."] if e.system.joint_compliances else []),
    ]


def _free_table(system: System, values: dict[str, float], free: Sequence[str]) -> list[str]:
    if not free:
        return []
    rows = [(escape_latex(name), f"${_value(values[name])}$", _unit(system.parameters[name].unit)) for name in free]
    return [r"\section*{Letters that stay}", *_table("lrl", ("parameter", "value", "unit"), rows)]


def _tree_tables(system: System, values: dict[str, float]) -> list[str]:
    """Joints with their placements, and bodies with their masses, all in numbers."""
    built = with_numeric_parameters(system, system.parameters.vector(values))
    mechanism = built.mechanism
    roles = dict.fromkeys(system.driven, "driven") | dict.fromkeys(system.prescribed, "prescribed")
    joints, bodies = [], []
    for joint in mechanism.joints:
        name = escape_latex(joint.name)
        parent = escape_latex(mechanism.joints[joint.parent_index].name) if joint.parent_index >= 0 else "world"
        rotation = np.array(ca.DM(joint.placement.rotation))
        turned = "" if np.allclose(rotation, np.eye(3)) else f"${_matrix(rotation)}$"
        place = f"${_vector(np.array(ca.DM(joint.placement.translation)).ravel())}$"
        axis, role = f"${_vector(joint.axis)}$", roles.get(joint.name, "free")
        joints.append((name, joint.kind, parent, role, axis, place, turned))
        # what gravity pulls at may differ from the mass; only inertia is listed
        body = merge_bodies(b.__class__(b.mass, b.center_of_mass, b.inertia_about_com) for b in joint.bodies)
        if body is not None:
            com = np.array(ca.DM(body.center_of_mass)).ravel()
            tensor = np.array(ca.DM(body.inertia_about_com))
            bodies.append((name, f"${_value(float(body.mass))}$", f"${_vector(com)}$", f"${_matrix(tensor)}$"))
    gravity = np.array(ca.DM(built.gravity)).ravel()
    return [
        r"\section*{Joints}",
        *_table("lllllll", ("joint", "kind", "parent", "role", "axis", "place [m]", "rotation"), joints),
        r"\section*{Bodies}",
        rf"Gravity ${_vector(gravity)}$ m/s$^2$. Centres and inertias (about the centre) in the joint's frame.",
        *_table("lrll", ("joint", "mass [kg]", "centre [m]", r"inertia [kg m$^2$]"), bodies),
    ]


def _rows(symbols: StepSymbols, block: SymbolBlock, values: dict[str, float], free: Sequence[str]) -> list[str]:
    """Every row of a block: whole where it is short, else with the bodies' part, or all of it, as a letter."""
    e, system = symbols.equations, symbols.equations.system
    fixed = [p for p in system.parameters if p.name not in free]
    old = ca.vertcat(*(p.symbol for p in fixed)) if fixed else ca.SX(0, 1)
    new = ca.SX(ca.DM([values[p.name] for p in fixed])) if fixed else ca.SX(0, 1)
    rest = {"del": e.p0 + e.balance_remainder, "p1": e.p1_remainder}.get(block.name)
    title = rf"\subsection*{{{escape_latex(block.name)}: {block.meaning}}}"
    lines = [title]
    if rest is not None:
        sign = "-" if block.name == "del" else "+"
        pull = "" if not e.lam.numel() else ", $G$ the pull of the grasps"
        lines.append(
            rf"$B$ stands for $\tfrac{{h}}{{2}} \, \partial (T - V) / \partial q_m {sign} \partial T / \partial v_m$ "
            rf"of the bodies above{pull}."
        )
    for i, label in enumerate(block.labels):
        letter = block.latex_template.replace("#", rf"\mathrm{{{escape_latex(label)}}}")
        whole = ca.substitute(block.expressions[i], old, new)
        count = count_operations([whole], symbols.column_symbols)
        if count <= _MAX_ROW_OPERATIONS:
            made = format_expressions([whole], symbols.column_symbols, symbols.column_display_names, latex=True)
            lines.append(_equation(letter, made.expression_texts[0], made))
        elif rest is not None:
            made = format_expressions(
                [ca.substitute(rest[i], old, new)], symbols.column_symbols, symbols.column_display_names, latex=True
            )
            bodies = rf"B_{{\mathrm{{{escape_latex(label)}}}}}"
            pulled = "" if not e.lam.numel() else rf" - G_{{\mathrm{{{escape_latex(label)}}}}}"
            lost = "" if e.closed_form_force is None else r" + \text{drag}"
            added = (
                made.expression_texts[0]
                if made.expression_texts[0].startswith("-")
                else f"+ {made.expression_texts[0]}"
            )
            lines.append(_equation(letter, f"{bodies}{pulled}{lost} {added}", made))
        else:
            lines.append(rf"${letter}$: {count} operations, in \texttt{{rows.casadi}} and \texttt{{equations.c}}")
    return lines


def _equation(letter: str, value: str, made: FormulaText) -> str:
    """A row as a paragraph that TeX may break at any sign, with its shared parts behind it."""
    where = ", ".join(f"${name} = {text}$" for name, text in made.shared_subexpressions)
    return rf"$\displaystyle {letter} = {value}$" + (f" \\quad where {where}" if where else "") + "\n"


def _table(columns: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = [" & ".join(row) + r" \\" for row in rows]
    return [
        rf"{{\footnotesize\begin{{longtable}}{{{columns}}}",
        " & ".join(head) + r" \\ \hline",
        *body,
        r"\end{longtable}}",
    ]


def _value(value: float) -> str:
    mantissa, _, exponent = f"{value:.6g}".partition("e")
    return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if exponent else mantissa


def _vector(values: Iterable[float]) -> str:
    return "(" + r",\, ".join(_value(float(value)) for value in values) + ")"


def _matrix(values: Array) -> str:
    rows = r" \\ ".join(" & ".join(_value(float(x)) for x in row) for row in values)
    return rf"\left(\begin{{smallmatrix}} {rows} \end{{smallmatrix}}\right)"


def _unit(unit: str) -> str:
    return rf"$\mathrm{{{unit.replace(' ', chr(92) + ',')}}}$"
