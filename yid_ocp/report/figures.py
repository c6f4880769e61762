"""Figures for the report, by plotly (the extra `report`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import plotly.graph_objects

Array = NDArray[np.float64]

INK, PALE = "#22303c", "#d9dee3"
COLORS = ("#0b6e99", "#c2571a", "#5b8c2a", "#8a4f9e")
LONGEST = 2000  # points of a curve; beyond this the page grows and the eye sees no more


def html(figure: plotly.graph_objects.Figure) -> str:
    """A figure as an HTML element that uses the page's one copy of plotly's script."""
    text: str = figure.to_html(
        full_html=False, include_plotlyjs=False, config={"responsive": True, "displaylogo": False}
    )
    return text


def cost_history(costs: Sequence[float], notes: Sequence[str]) -> plotly.graph_objects.Figure:
    """Cost at every accepted point, one curve for each horizon that was solved on the way."""
    import plotly.graph_objects as go

    figure = go.Figure()
    begin = 0
    stages = 0
    for i in range(1, len(costs) + 1):
        if i == len(costs) or notes[i] != notes[begin]:
            figure.add_scatter(
                x=list(range(begin, i)),
                y=list(costs[begin:i]),
                mode="lines+markers",
                name=notes[begin] or "whole recordings",
                line={"color": COLORS[stages % len(COLORS)]},
            )
            begin, stages = i, stages + 1
    return _styled(figure, 320, "accepted point", "cost", log_y=True)


def measured_and_predicted(
    curves: Mapping[str, tuple[Array, Array, Array, Array]], unit: str
) -> plotly.graph_objects.Figure:
    """Measured dots beside predicted lines, one row for each coordinate or joint.

    Parameters
    ----------
    curves : mapping of name to (t (M,), measured (M,), t (K,), predicted (K,))
    unit : str
    """
    from plotly.subplots import make_subplots

    figure = make_subplots(rows=len(curves), cols=1, shared_xaxes=True, vertical_spacing=min(0.05, 0.3 / len(curves)))
    for row, (name, (t, measured, t_model, predicted)) in enumerate(curves.items(), start=1):
        keep = _thinned(len(t))
        dots = {"color": COLORS[1], "size": 3 if len(t) > 60 else 7}
        figure.add_scatter(
            x=t[keep].tolist(), y=_listed(measured[keep]), mode="markers", marker=dots, name="measured",
            showlegend=row == 1, legendgroup="measured", row=row, col=1,
        )  # fmt: skip
        keep = _thinned(len(t_model))
        figure.add_scatter(
            x=t_model[keep].tolist(), y=_listed(predicted[keep]), mode="lines", line={"color": COLORS[0], "width": 1.5},
            name="predicted", showlegend=row == 1, legendgroup="predicted", row=row, col=1,
        )  # fmt: skip
        figure.update_yaxes(title_text=f"{name} [{unit}]", row=row, col=1)
    figure = _styled(figure, 90 + 150 * len(curves), "", "")
    figure.update_xaxes(title_text="time [s]", row=len(curves), col=1)
    return figure


def residual_histogram(residuals: Mapping[str, Array]) -> plotly.graph_objects.Figure:
    """Whitened residuals of every group beside the standard normal density they should follow."""
    import plotly.graph_objects as go

    edge = max([4.0, *(float(np.quantile(np.abs(r), 0.995)) for r in residuals.values() if len(r))])
    figure = go.Figure()
    for i, (name, values) in enumerate(residuals.items()):
        bins = np.linspace(-edge, edge, int(np.clip(2 * np.sqrt(len(values)), 8, 60)) + 1)
        density, _ = np.histogram(np.clip(values, -edge, edge), bins=bins, density=True)
        line = {"color": COLORS[i % len(COLORS)], "shape": "hvh"}
        middle = 0.5 * (bins[1:] + bins[:-1])
        label = f"{name} ({len(values)} values)"
        figure.add_scatter(x=middle.tolist(), y=density.tolist(), mode="lines", line=line, name=label)
    even = np.linspace(-edge, edge, 121)
    normal = np.exp(-0.5 * even**2) / np.sqrt(2 * np.pi)
    figure.add_scatter(
        x=even.tolist(), y=normal.tolist(), mode="lines", line={"color": INK, "dash": "dot"}, name="standard normal"
    )
    return _styled(figure, 340, "residual in standard deviations", "density")


def estimates(values: Mapping[str, tuple[float, float | None, float, bool]], unit: str) -> plotly.graph_objects.Figure:
    """Values with two standard deviations, and the start, one row for each parameter: (value, std, initial, found)."""
    import plotly.graph_objects as go

    names = list(values)
    figure = go.Figure()
    figure.add_scatter(
        x=[values[name][2] for name in names],
        y=names,
        mode="markers",
        name="start",
        marker={"color": PALE, "size": 10, "symbol": "diamond", "line": {"color": INK, "width": 1}},
    )
    for found, word, color in ((True, "estimate", COLORS[0]), (False, "estimate that cannot be trusted", COLORS[1])):
        chosen = [name for name in names if values[name][3] == found]
        figure.add_scatter(
            x=[values[name][0] for name in chosen],
            y=chosen,
            mode="markers",
            name=word,
            marker={"color": color, "size": 10},
            error_x={"type": "data", "array": [2 * (values[name][1] or 0.0) for name in chosen], "color": color},
            showlegend=bool(chosen),
        )
    largest = max([abs(number) for value, _, initial, _ in values.values() for number in (value, initial)] or [1.0])
    figure = _styled(figure, 110 + 34 * len(names), unit, "")
    lowest = min(0.0, *(value for value, *_ in values.values()))
    figure.update_xaxes(range=[lowest - 0.05 * largest, 1.6 * largest])
    figure.update_yaxes(autorange="reversed", categoryorder="array", categoryarray=names)
    return figure


def profiles(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]], level: float
) -> plotly.graph_objects.Figure:
    """Chi2 above the best along each parameter, over its value relative to that of the fit: (ratio, delta chi2)."""
    import plotly.graph_objects as go

    figure = go.Figure()
    for i, (name, (ratio, delta)) in enumerate(curves.items()):
        line = {"color": COLORS[i % len(COLORS)], "dash": "solid" if i < len(COLORS) else "dash"}
        figure.add_scatter(x=list(ratio), y=list(delta), mode="lines+markers", name=name, line=line)
    figure.add_hline(y=level, line={"color": INK, "dash": "dot"}, annotation_text="95 %")
    figure = _styled(figure, 380, "value over best value", "chi2 above the best")
    figure.update_xaxes(type="log", range=[-1.0, 1.0])
    figure.update_yaxes(range=[-0.2, 2.5 * level])
    return figure


def _thinned(count: int) -> NDArray[np.int64]:
    if count <= LONGEST:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, LONGEST).astype(np.int64))


def _listed(values: Array) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _styled(
    figure: plotly.graph_objects.Figure, height: int, x: str, y: str, log_y: bool = False
) -> plotly.graph_objects.Figure:
    layout: dict[str, Any] = {
        "height": height,
        "margin": {"l": 70, "r": 20, "t": 30, "b": 45},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
        "hovermode": "closest",
    }
    figure.update_layout(**layout)
    figure.update_xaxes(title_text=x or None, gridcolor=PALE, zeroline=False, linecolor=PALE)
    figure.update_yaxes(gridcolor=PALE, zeroline=False, linecolor=PALE)
    if y:
        figure.update_yaxes(title_text=y)
    if log_y:
        figure.update_yaxes(type="log", exponentformat="power")
    return figure
