"""Plotly figures with one row per name: estimates, changes, rankings, heat maps over time, matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.report.figures import (
    AFTER_COLOR,
    BACKGROUND_COLOR,
    BEFORE_COLOR,
    DIVERGING_COLORSCALE,
    GRID_COLOR,
    LINE_COLORS,
    SEQUENTIAL_COLORSCALE,
    TEXT_COLOR,
    asymmetric_error_bars,
    line_color,
    styled_report_figure,
)

if TYPE_CHECKING:
    import plotly.graph_objects


_MIN_CLOSURE_PERCENT = -50.0  # lower end of an axis of closures [%]
_SYMBOLS = ("circle", "diamond", "square", "cross")


def _rows_figure(height: int, names: Sequence[str], title: str) -> plotly.graph_objects.Figure:
    """An empty figure with one named row for each name, the first on top."""
    figure = styled_report_figure(height, title, "")
    figure.update_yaxes(autorange="reversed", categoryorder="array", categoryarray=list(names), automargin=True)
    return figure


def estimates_figure(
    values: Mapping[str, tuple[float, float | None, float, bool]], unit: str
) -> plotly.graph_objects.Figure:
    """Figure of estimates ± 2 std and initial values, one row per parameter: (value, std, initial, found)."""
    names = list(values)
    figure = _rows_figure(110 + 34 * len(names), names, unit)
    marker = {"color": GRID_COLOR, "size": 10, "symbol": "diamond", "line": {"color": TEXT_COLOR, "width": 1}}
    figure.add_scatter(x=[values[name][2] for name in names], y=names, mode="markers", name="start", marker=marker)
    labels = {True: "estimate", False: "estimate that cannot be trusted"}
    for (found, label), color in zip(labels.items(), LINE_COLORS, strict=False):
        chosen = [name for name in names if values[name][3] == found]
        figure.add_scatter(
            x=[values[name][0] for name in chosen], y=chosen, mode="markers", name=label, showlegend=bool(chosen),
            marker={"color": color, "size": 10},
            error_x={"type": "data", "array": [2 * (values[name][1] or 0.0) for name in chosen], "color": color},
        )  # fmt: skip
    largest = max([abs(number) for value, _, initial, _ in values.values() for number in (value, initial)] or [1.0])
    lowest = min(0.0, *(value for value, *_ in values.values()))
    figure.update_xaxes(range=[lowest - 0.05 * largest, 1.6 * largest])
    figure.update_yaxes(tickfont={"size": 11})
    return figure


def parameter_values_by_source_figure(
    rows: Mapping[str, Mapping[str, tuple[float, float | None]]], unit: str
) -> plotly.graph_objects.Figure:
    """Figure of values ± 2 std from several sources, one row per parameter and one color per source."""
    sources = list(dict.fromkeys(source for row in rows.values() for source in row))
    names = list(rows)
    figure = styled_report_figure(110 + max(36, 14 * len(sources)) * len(names), unit, "")
    spread = 0.6 / max(len(sources), 1)
    for i, source in enumerate(sources):
        own = [(k, *rows[name][source]) for k, name in enumerate(names) if source in rows[name]]
        color, symbol = line_color(i), _SYMBOLS[i // len(LINE_COLORS) % len(_SYMBOLS)]
        figure.add_scatter(
            x=[value for _, value, _ in own], y=[k + spread * (i - (len(sources) - 1) / 2) for k, *_ in own],
            mode="markers", name=source, marker={"color": color, "size": 8, "symbol": symbol},
            error_x={"type": "data", "array": [2 * (std or 0.0) for *_, std in own], "color": color, "thickness": 1.2},
        )  # fmt: skip
    numbers = [0.0, *(value for row in rows.values() for value, _ in row.values())]
    low, high = min(numbers), max(numbers)
    # bars of what cannot be told would squeeze all others
    figure.update_xaxes(range=[low - 0.1 * (high - low or 1.0), high + 0.25 * (high - low or 1.0)])
    figure.update_yaxes(
        tickvals=list(range(len(names))), ticktext=names, range=[len(names) - 0.5, -0.5], automargin=True
    )
    return figure


def _heat_figure(
    height: int, names: tuple[Sequence[str], Sequence[str]], parts: Array, titles: tuple[str, str], tickangle: int
) -> plotly.graph_objects.Figure:
    """Figure of numbers between 0 and 1 for each pair of a row's and a column's name."""
    rows, columns = (list(own) for own in names)
    figure = styled_report_figure(height, titles[1], titles[0])
    figure.add_heatmap(
        x=columns, y=rows, z=parts.tolist(), zmin=0.0, zmax=1.0, showscale=False, xgap=1, ygap=1,
        colorscale=SEQUENTIAL_COLORSCALE, texttemplate="%{text}",
    )  # fmt: skip
    every = {"type": "category", "tickmode": "array", "title_standoff": 6, "showgrid": False, "automargin": True}
    figure.update_xaxes(tickangle=tickangle, tickvals=columns, **every)
    figure.update_yaxes(autorange="reversed", tickvals=rows, **every)
    return figure


def confusion_matrix_figure(rows: Sequence[str], columns: Sequence[str], counts: Array) -> plotly.graph_objects.Figure:
    """Confusion-matrix figure of counts of what was said of what is true, colored by the fraction of their row."""
    parts = counts / np.maximum(counts.sum(1, keepdims=True), 1.0)
    figure = _heat_figure(200 + 24 * len(rows), (rows, columns), parts, ("true", "said first"), -50)
    text = [[f"{n:.0f}" if n else "" for n in line] for line in counts]
    return figure.update_traces(text=text, hovertemplate="%{y}: said %{x}<extra></extra>")


def explained_fraction_matrix_figure(names: Sequence[str], values: Array) -> plotly.graph_objects.Figure:
    """Heat-map figure of explained fractions `values` (n, n), row explained by column, shown in per cent."""
    figure = _heat_figure(190 + 27 * len(names), (names, names), values, ("trace of", "explained by [%]"), -40)
    text = [[f"{100 * v:.0f}" if v >= 0.095 else "" for v in line] for line in values]
    return figure.update_traces(text=text, hovertemplate="%{y} explained by %{x}: %{z:.2f}<extra></extra>")


@dataclass(frozen=True)
class ValueBeforeAfter:
    """A value before and after a change, with standard deviations and an optional reference value."""

    before: float
    after: float | None = None
    before_std: float = 0.0
    after_std: float = 0.0
    reference: float | None = None


def values_before_after_figure(
    rows: Mapping[str, ValueBeforeAfter], axis: str, words: tuple[str, str, str]
) -> plotly.graph_objects.Figure:
    """Figure of values before and after, one row each; error bars are two standard deviations.

    `axis` says what the numbers are, with their unit; `words` name before, after and the marks.
    """
    figure = _rows_figure(110 + 32 * len(rows), list(rows), axis)
    moved = [(name, row.before, row.after) for name, row in rows.items() if row.after is not None]
    figure.add_scatter(
        x=[x for _, before, after in moved for x in (before, after, None)],
        y=[y for name, *_ in moved for y in (name, name, None)],
        mode="lines", line={"color": GRID_COLOR, "width": 6}, hoverinfo="skip", showlegend=False,
    )  # fmt: skip
    hollow = {"color": BACKGROUND_COLOR, "size": 11, "line": {"color": BEFORE_COLOR, "width": 2.5}}
    full = {"color": AFTER_COLOR, "size": 11}
    tick = {"symbol": "line-ns", "size": 16, "line": {"color": TEXT_COLOR, "width": 2.5}}
    numbers: list[float] = []
    for entries, word, marker, color in (
        ([(n, r.before, r.before_std) for n, r in rows.items()], words[0], hollow, BEFORE_COLOR),
        ([(n, r.after, r.after_std) for n, r in rows.items()], words[1], full, AFTER_COLOR),
        ([(n, r.reference, 0.0) for n, r in rows.items()], words[2], tick, TEXT_COLOR),
    ):
        known = [(name, value, std) for name, value, std in entries if value is not None]
        spread = [2 * std if np.isfinite(std) else 0.0 for *_, std in known]
        bars = {"type": "data", "array": spread, "color": color, "thickness": 1.2} if any(spread) else None
        x, y = [value for _, value, _ in known], [name for name, *_ in known]
        numbers += x
        if known:
            figure.add_scatter(x=x, y=y, mode="markers", name=word, marker=marker, error_x=bars)
    if min(numbers) > 0 and max(numbers) > 30 * min(numbers):
        figure.update_xaxes(type="log", exponentformat="power", dtick="D2" if max(numbers) < 1e3 * min(numbers) else 1)
    else:
        # bars of what cannot be told would squeeze all others
        figure.update_xaxes(range=[min(0.0, 1.1 * min(numbers)), 1.15 * max([*numbers, 1e-12])])
    return figure


@dataclass(frozen=True)
class TimeHeatMapRow:
    """One row of a heat map over time; rows of one group stand together."""

    name: str
    group: str
    values: Array  # shape (J,), NaN where there is nothing to show
    hover_texts: Sequence[str]  # J


def time_heat_map_figure(edges: Array, rows: Sequence[TimeHeatMapRow], axis: str) -> plotly.graph_objects.Figure:
    """Heat-map figure over time, one row per quantity; grey: not informed by the data.

    Parameters
    ----------
    edges : ndarray, shape (J + 1,) [s]
    axis : str
        What the colors are.
    """
    values = np.array([row.values for row in rows])
    seen = np.abs(values[np.isfinite(values)])
    # even to the eye from one standard deviation to thousands
    limit = max(3.0, float(np.quantile(seen, 0.98))) if seen.size else 3.0
    marks = [m for m in ((0, 1, 3, 10) if limit < 20 else (0, 10, 100, 1000, 10000)) if m <= limit]
    marks = sorted({-m for m in marks} | set(marks))
    bar = {"thickness": 14, "x": 1.2, "tickvals": _even(marks).tolist(), "ticktext": [str(m) for m in marks]}
    figure = styled_report_figure(120 + max(17 * len(rows), 100), "time [s]", "")
    figure.add_heatmap(
        x=edges.tolist(), y=list(range(len(rows))),
        z=[[v if np.isfinite(v) else None for v in row.tolist()] for row in _even(values)],
        text=[list(row.hover_texts) for row in rows], hoverinfo="text", zmin=-_even(limit), zmax=_even(limit),
        colorscale=DIVERGING_COLORSCALE, colorbar=bar,
    )  # fmt: skip
    figure.update_layout(plot_bgcolor=GRID_COLOR, margin={"r": 150, "t": 40})
    figure.add_annotation(
        x=0, xref="paper", xanchor="left", y=1, yref="paper", yanchor="bottom", text=f"color: {axis}", showarrow=False
    )
    figure.update_xaxes(showgrid=False, range=[float(edges[0]), float(edges[-1])])
    figure.update_yaxes(
        showgrid=False, range=[len(rows) - 0.5, -0.5], tickvals=list(range(len(rows))),
        ticktext=[row.name for row in rows], automargin=True, tickfont={"size": 11},
    )  # fmt: skip
    groups = [row.group for row in rows]
    for group in dict.fromkeys(groups):
        own = [i for i, entry in enumerate(groups) if entry == group]
        at = {"x": 1.01, "xref": "paper", "y": (own[0] + own[-1]) / 2, "xanchor": "left"}
        figure.add_annotation(text=group, showarrow=False, font={"size": 11}, **at)
        if own[0]:
            figure.add_hline(y=own[0] - 0.5, line={"color": TEXT_COLOR, "width": 1})
    return figure


def _even(value: Any) -> Any:
    return np.arcsinh(np.asarray(value, float) / 2)


@dataclass(frozen=True)
class RankedCandidate:
    """A candidate effect in a ranking."""

    name: str
    closure_interval_percent: tuple[float, float, float] | None  # what it was found to close, and its interval [%]
    predicted_decrease: float


def candidate_ranking_figure(
    entries: Sequence[RankedCandidate], closed: str, promised: str
) -> plotly.graph_objects.Figure:
    """Figure that ranks candidates by refitted closure (where refitted) and by first-order predicted decrease.

    `closed` and `promised` are the titles of the two axes.
    """
    from plotly.subplots import make_subplots

    done = {entry.name: entry.closure_interval_percent for entry in entries if entry.closure_interval_percent}
    last = 2 if done else 1
    figure = make_subplots(rows=1, cols=last, shared_yaxes=True, horizontal_spacing=0.08)
    figure = styled_report_figure(100 + 28 * len(entries), "", "", base=figure)
    figure.add_bar(
        x=[entry.predicted_decrease for entry in entries], y=[entry.name for entry in entries], orientation="h",
        width=0.55, marker={"color": LINE_COLORS[1]}, showlegend=False, row=1, col=last,
    )  # fmt: skip
    figure.update_xaxes(title_text=promised, rangemode="tozero", row=1, col=last)
    if done:
        values, lows, highs = zip(*done.values(), strict=True)
        figure.add_scatter(
            x=values, y=list(done), mode="markers", showlegend=False, row=1, col=1,
            marker={"color": LINE_COLORS[0], "size": 11}, error_x=asymmetric_error_bars(values, lows, highs),
        )  # fmt: skip
        # what makes a prediction worse can do so without end
        left = min([0.0, *(max(low, _MIN_CLOSURE_PERCENT) for low in lows)]) - 6
        figure.update_xaxes(title_text=closed, range=[left, 108], row=1, col=1)
        figure.add_vline(x=0, line={"color": TEXT_COLOR, "width": 1}, row=1, col=1)
        for name, (value, *_) in done.items():
            if value < left:
                text = f"◀ {value:.0f}"
                figure.add_annotation(x=left, y=name, text=text, showarrow=False, xanchor="left", row=1, col=1)
    names = [entry.name for entry in entries][::-1]
    figure.update_yaxes(type="category", categoryorder="array", categoryarray=names, automargin=True)
    figure.update_yaxes(range=[-0.6, len(names) - 0.4])
    return figure
