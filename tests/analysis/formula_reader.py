"""Written formulas as Python."""

from __future__ import annotations

import math
import re

import numpy as np

FUNCTIONS = {
    "sin": math.sin, "cos": math.cos, "tan": math.tan, "exp": math.exp, "log": math.log, "tanh": math.tanh,
    "sqrt": math.sqrt, "atan2": math.atan2, "sign": lambda x: float(np.sign(x)), "abs": abs, "min": min, "max": max,
    "where": lambda said, value, other: value if said else other,
}  # fmt: skip


def read(text: str) -> str:
    """The text as Python."""
    assert not re.search(r"[*/]-", text), f"a sign behind a product reads badly: {text}"
    text = text.replace("^", "**")
    return re.sub(r"\bif\(", "where(", text)


def braced(text: str, at: int) -> int:
    """Place behind the brace that closes the one at `at`."""
    depth = 0
    for i in range(at, len(text)):
        depth += {"{": 1, "}": -1}.get(text[i], 0)
        if depth == 0:
            return i + 1
    raise AssertionError(f"a brace is not closed in {text}")


def read_latex(text: str) -> str:
    """LaTeX as Python."""
    # a condition in brackets is one or zero
    text = text.replace("[", "(").replace("]", ")")
    text = re.sub(r"v_\{(\d)\}", r"v[\1]", text)
    text = re.sub(r"c_\{(\d+)\}", r"c\1", text)
    text = re.sub(r" \\cdot 10\^\{(-?\d+)\}", r"e\1", text)
    while r"\frac" in text:
        at = text.rindex(r"\frac")
        middle = braced(text, at + 5)
        end = braced(text, middle)
        text = f"{text[:at]}(({text[at + 6 : middle - 1]})/({text[middle + 1 : end - 1]})){text[end:]}"
    while r"\sqrt" in text:
        at = text.rindex(r"\sqrt")
        end = braced(text, at + 5)
        text = f"{text[:at]}sqrt({text[at + 6 : end - 1]}){text[end:]}"
    text = re.sub(r"\\operatorname\{(\w+)\}", r"\1", text)
    text = re.sub(r"\\(sin|cos|tan|exp|log|tanh)\b", r"\1", text)
    text = re.sub(r"\|([^|]*)\|", r"abs(\1)", text)
    # where two factors stand beside each other, a sign between them is a difference
    text = re.sub(r"\\,\s*-", "-", text)
    for latex, python in ((r"\,", "*"), (r"\le ", "<= "), (r"\land", "and"), (r"\lnot", "not"), ("^", "**")):
        text = text.replace(latex, python)
    return text.replace("{", "(").replace("}", ")")
