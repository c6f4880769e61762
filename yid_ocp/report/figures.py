"""Figures for the report, by plotly (the extra `report`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.report.tables import readable

if TYPE_CHECKING:
    import plotly.graph_objects

Array = NDArray[np.float64]

INK, PALE, PAPER = "#22303c", "#d9dee3", "#ffffff"
COLORS = ("#0b6e99", "#c2571a", "#5b8c2a", "#8a4f9e")
DASHES = ("solid", "dash", "dot", "dashdot")
BEFORE, AFTER, MEASURED = COLORS[1], COLORS[0], "#8d99a4"
DIVERGING = ((0.0, "#2166ac"), (0.25, "#92c5de"), (0.5, PAPER), (0.75, "#f4a582"), (1.0, "#b2182b"))
RISING = ((0.0, PAPER), (0.5, "#b9d9e6"), (0.9, "#0b6e99"), (1.0, "#06405a"))
DARK: Mapping[str, str] = {
    INK: "#e3e9ee",
    PALE: "#3b4650",
    PAPER: "#151b20",
    COLORS[0]: "#4fb3dc",
    COLORS[1]: "#f2955a",
    COLORS[2]: "#9acb62",
    COLORS[3]: "#cba0dc",
    MEASURED: "#98a5b0",
    "#2166ac": "#6fb2f2",
    "#92c5de": "#37627f",
    "#f4a582": "#86493a",
    "#b2182b": "#f3737d",
    "#b9d9e6": "#1f4a5e",
    "#06405a": "#a9e0f6",
}
"""What every color becomes on a dark page; figures use no other colors."""
WORST = -50.0  # lower end of an axis of closures [%]
LONGEST = 1200  # points of a curve; beyond this the page grows and the eye sees no more
EPOCH = 1e4  # times from which single precision loses milliseconds [s]
ROW, SMALL, GAP, TOP, BOTTOM = 130, 76, 30, 64, 44  # heights in a figure of rows [px]


def html(figure: plotly.graph_objects.Figure) -> str:
    """A figure as an HTML element that the page's own script draws, in the colors of light or dark."""
    figure.update_layout(template=None)  # all is said here; the default one is some kilobytes each
    told = str(figure.to_json()).replace("<", "\\u003c")
    return (
        f'<div class="plot" style="height:{figure.layout.height}px">'
        f'<script type="application/json">{told}</script></div>'
    )


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


@dataclass(frozen=True)
class Curve:
    """Measured dots and the lines that should go through them.

    Attributes
    ----------
    title : str
        Of its axis, with the unit.
    t, measured : ndarray, shape (M,)
    lines : mapping of name to (t (K,), value (K,))
    band : float or None
        Half the height of what is shaded about zero.
    spans : sequence of (float, float)
        Stretches of time that are marked.
    small : bool
        Whether its row is a low one.
    """

    title: str
    t: Array
    measured: Array
    lines: Mapping[str, tuple[Array, Array]]
    band: float | None = None
    spans: Sequence[tuple[float, float]] = ()
    small: bool = False


def compared(
    title: str,
    unit: str,
    t: Array,
    measured: Array,
    std: Array,
    lines: Mapping[str, Array],
    course: tuple[Array, Array] | None = None,
) -> tuple[Curve, Curve]:
    """Two rows: what was measured and predicted, and below it what is left, with two standard deviations of the noise.

    Parameters
    ----------
    title, unit : str
    t, measured, std : ndarray, shape (M,)
    lines : mapping of name to ndarray, shape (M,)
        Predictions at the times of the measurements.
    course : (t (K,), value (K,)), optional
        The first of them at more times, for what is measured seldom.
    """
    seen = np.isfinite(measured) & np.isfinite(std)
    factor, shown = readable(unit)
    drawn = {name: (t, values) for name, values in lines.items()}
    if course is not None:
        drawn[next(iter(lines))] = course
    left = {name: in_pieces(t[seen], factor * (values - measured)[seen]) for name, values in lines.items()}
    noise = float(np.median(std[seen])) if seen.any() else 0.0
    above = Curve(f"{title} [{unit}]", t, measured, drawn)
    return above, Curve(f"residual [{shown}]", t[:0], t[:0], left, 2 * factor * noise or None, small=True)


def in_pieces(t: Array, values: Array) -> tuple[Array, Array]:
    """A line that is broken where nothing was measured for long."""
    steps = np.diff(t)
    breaks = np.flatnonzero(steps > 5 * np.median(steps)) + 1 if len(steps) else np.zeros(0, int)
    return np.insert(t, breaks, t[breaks]), np.insert(values, breaks, np.nan)


def over_time(
    curves: Sequence[Curve], dots: str = COLORS[1], lines: Mapping[str, str] | None = None
) -> plotly.graph_objects.Figure:
    """Measured dots beside lines, one row for each curve, its title above it.

    Parameters
    ----------
    curves : sequence of Curve
    dots : str
        Color of what is measured.
    lines : mapping of name to str, optional
        Color of the lines; one after the other when absent.
    """
    from plotly.subplots import make_subplots

    names = list(dict.fromkeys(name for curve in curves for name in curve.lines))
    colors = dict(lines or {name: COLORS[i % len(COLORS)] for i, name in enumerate(names)})
    heights = [SMALL if curve.small else ROW for curve in curves]
    inner = sum(heights) + GAP * (len(curves) - 1)
    figure = make_subplots(
        rows=len(curves), cols=1, shared_xaxes=True, vertical_spacing=GAP / inner, row_heights=heights
    )
    told: set[str] = set()
    for row, curve in enumerate(curves, start=1):
        keep = _thinned(len(curve.t))
        if len(curve.t):
            marker = {"color": dots, "size": 3 if len(curve.t) > 60 else 6}
            figure.add_scatter(
                x=_times(curve.t[keep]), y=_short(curve.measured[keep]), mode="markers", marker=marker,
                name="measured", showlegend="measured" not in told, legendgroup="measured", row=row, col=1,
            )  # fmt: skip
            told.add("measured")
        for name, (t, value) in curve.lines.items():
            keep = _thinned(len(t))
            # what is measured seldom may have neighbours on neither side
            mode = "lines+markers" if curve.small and len(t) <= 60 else "lines"
            figure.add_scatter(
                x=_times(t[keep]), y=_short(value[keep]), mode=mode, name=name, showlegend=name not in told,
                legendgroup=name, line={"color": colors[name], "width": 1.5}, marker={"size": 4}, row=row, col=1,
            )  # fmt: skip
            told.add(name)
        if curve.band is not None:
            shade = {"fillcolor": PALE, "opacity": 0.7, "line_width": 0, "layer": "below"}
            figure.add_hrect(y0=-curve.band, y1=curve.band, row=row, col=1, **shade)
        for begin, end in curve.spans:
            figure.add_vrect(
                x0=begin, x1=end, row=row, col=1, fillcolor=AFTER, opacity=0.2, line_width=0, layer="below"
            )
    figure = _styled(figure, inner + TOP + BOTTOM, "", "")
    figure.update_yaxes(nticks=4)
    for row, curve in enumerate(curves, start=1):
        # beside a low row a turned title has no room, and collides with that of the next one
        top = figure.layout[f"yaxis{row if row > 1 else ''}"].domain[1]
        figure.add_annotation(
            text=curve.title, x=0, xref="paper", xanchor="left", y=top, yref="paper", yanchor="bottom",
            showarrow=False, font={"size": 12},
        )  # fmt: skip
    figure.update_layout(
        margin={"l": 54, "r": 12, "t": TOP, "b": BOTTOM}, legend={"y": 1 + 22 / inner, "yanchor": "bottom"}
    )
    figure.update_xaxes(title_text="time [s]", row=len(curves), col=1)
    return figure


def lines_over_time(curve: Curve) -> plotly.graph_objects.Figure:
    """The lines of one curve, each in a color of its own."""
    import plotly.graph_objects as go

    figure = go.Figure()
    for i, (name, (t, value)) in enumerate(curve.lines.items()):
        keep, style = _thinned(len(t)), {"color": COLORS[i % len(COLORS)], "width": 1.5}
        style |= {"dash": DASHES[i // len(COLORS) % len(DASHES)]}
        figure.add_scatter(x=_times(t[keep]), y=_short(value[keep]), mode="lines", name=name, line=style)
    if curve.band is not None:
        shade = {"fillcolor": PALE, "opacity": 0.7, "line_width": 0, "layer": "below"}
        figure.add_hrect(y0=-curve.band, y1=curve.band, **shade)
    # the legend below takes as many rows as the screen is narrow
    below = {"orientation": "h", "y": -0.22, "yanchor": "top", "x": 0, "font": {"size": 11}}
    figure = _styled(figure, 320 + 8 * len(curve.lines), "time [s]", "")
    figure.update_layout(legend=below, margin={"t": 30})
    figure.add_annotation(
        text=curve.title, x=0, xref="paper", xanchor="left", y=1, yref="paper", yanchor="bottom", showarrow=False,
        font={"size": 12},
    )  # fmt: skip
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


Beside = Mapping[str, Mapping[str, tuple[float, float | None]]]
"""Of every parameter, by who says it: value and standard deviation."""


def side_by_side(rows: Beside, unit: str) -> plotly.graph_objects.Figure:
    """Values of several sources with two standard deviations, one row for each parameter, a color for each source."""
    import plotly.graph_objects as go

    sources = list(dict.fromkeys(source for row in rows.values() for source in row))
    names, figure = list(rows), go.Figure()
    spread = 0.6 / max(len(sources), 1)
    for i, source in enumerate(sources):
        own = [(k, *rows[name][source]) for k, name in enumerate(names) if source in rows[name]]
        color = COLORS[i % len(COLORS)]
        symbol = ("circle", "diamond", "square", "cross")[i // len(COLORS) % 4]
        figure.add_scatter(
            x=[value for _, value, _ in own], y=[k + spread * (i - (len(sources) - 1) / 2) for k, *_ in own],
            mode="markers", name=source, marker={"color": color, "size": 8, "symbol": symbol},
            error_x={"type": "data", "array": [2 * (std or 0.0) for *_, std in own], "color": color, "thickness": 1.2},
        )  # fmt: skip
    numbers = [value for row in rows.values() for value, _ in row.values()]
    figure = _styled(figure, 110 + max(36, 14 * len(sources)) * len(names), unit, "")
    low, high = min([0.0, *numbers]), max([0.0, *numbers])
    # bars of what cannot be told would squeeze all others
    figure.update_xaxes(range=[low - 0.1 * (high - low or 1.0), high + 0.25 * (high - low or 1.0)])
    figure.update_yaxes(
        tickvals=list(range(len(names))), ticktext=names, range=[len(names) - 0.5, -0.5], automargin=True
    )
    return figure


def falling(costs: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> plotly.graph_objects.Figure:
    """Cost over the lowest of each method, less one, over its time: (seconds, cost)."""
    import plotly.graph_objects as go

    figure = go.Figure()
    for i, (name, (seconds, cost)) in enumerate(costs.items()):
        known = [(s, c) for s, c in zip(seconds, cost, strict=True) if np.isfinite(c)]
        if known:
            least = min(c for _, c in known)
            figure.add_scatter(
                x=[s for s, _ in known], y=[max(c / max(least, 1e-300) - 1.0, 1e-9) for _, c in known],
                mode="lines+markers", name=name, line={"color": COLORS[i % len(COLORS)]},
            )  # fmt: skip
    return _styled(figure, 340, "wall time [s]", "cost over its lowest, less one", log_y=True)


def rates(
    curves: Mapping[str, Mapping[float, Mapping[str, float]]],
    x: str,
    y: str,
    log_x: bool = False,
    diagonal: bool = False,
) -> plotly.graph_objects.Figure:
    """Rates between 0 and 1 with their intervals: by name, at every place, `rate`, `low` and `high`."""
    import plotly.graph_objects as go

    figure = go.Figure()
    if diagonal:
        line = {"color": MEASURED, "dash": "dot"}
        figure.add_scatter(x=[0, 1], y=[0, 1], mode="lines", line=line, showlegend=False, hoverinfo="skip")
    for i, (name, known) in enumerate(curves.items()):
        own = list(known.values())
        bars = {
            "type": "data",
            "symmetric": False,
            "array": [max(entry["high"] - entry["rate"], 0.0) for entry in own],
            "arrayminus": [max(entry["rate"] - entry["low"], 0.0) for entry in own],
        }
        figure.add_scatter(
            x=list(known), y=[entry["rate"] for entry in own], mode="lines+markers", name=name, error_y=bars,
            line={"color": COLORS[i % len(COLORS)]},
        )  # fmt: skip
    figure = _styled(figure, 340, x, y)
    figure.update_yaxes(range=[-0.03, 1.03])
    if log_x:
        figure.update_xaxes(type="log")
    return figure


def counted(
    rows: Sequence[str], columns: Sequence[str], counts: Array, row: str, column: str
) -> plotly.graph_objects.Figure:
    """Counts of pairs, colored by their part of the row."""
    import plotly.graph_objects as go

    parts = counts / np.maximum(counts.sum(1, keepdims=True), 1.0)
    figure = go.Figure()
    figure.add_heatmap(
        x=list(columns), y=list(rows), z=parts.tolist(), zmin=0.0, zmax=1.0, showscale=False, xgap=1, ygap=1,
        colorscale=RISING, text=[[f"{n:.0f}" if n else "" for n in line] for line in counts], texttemplate="%{text}",
        hovertemplate="%{y}: said %{x}<extra></extra>",
    )  # fmt: skip
    figure = _styled(figure, 200 + 24 * len(rows), column, row)
    every = {"type": "category", "tickmode": "array", "title_standoff": 6, "showgrid": False, "automargin": True}
    figure.update_xaxes(tickangle=-50, tickvals=list(columns), **every)
    figure.update_yaxes(autorange="reversed", tickvals=list(rows), **every)
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


@dataclass(frozen=True)
class Change:
    """A number before and after something was done, with standard deviations, and a mark for comparison.

    Attributes
    ----------
    before : float
    after : float or None
    before_std, after_std : float
    mark : float or None
    """

    before: float
    after: float | None = None
    before_std: float = 0.0
    after_std: float = 0.0
    mark: float | None = None


def changes(rows: Mapping[str, Change], axis: str, words: tuple[str, str, str]) -> plotly.graph_objects.Figure:
    """Numbers before and after, joined by a line, one row each; bars are two standard deviations.

    Parameters
    ----------
    rows : mapping of name to Change
    axis : str
        What the numbers are, with their unit.
    words : (str, str, str)
        For before, after and the marks.
    """
    import plotly.graph_objects as go

    figure = go.Figure()
    names = list(rows)
    moved = [(name, row) for name, row in rows.items() if row.after is not None]
    figure.add_scatter(
        x=[x for _, row in moved for x in (row.before, row.after, None)],
        y=[y for name, _ in moved for y in (name, name, None)],
        mode="lines", line={"color": PALE, "width": 6}, hoverinfo="skip", showlegend=False,
    )  # fmt: skip
    hollow = {"color": PAPER, "size": 11, "line": {"color": BEFORE, "width": 2.5}}
    full = {"color": AFTER, "size": 11}
    for entries, word, marker, color in (
        ([(n, r.before, r.before_std) for n, r in rows.items()], words[0], hollow, BEFORE),
        ([(n, r.after, r.after_std) for n, r in moved], words[1], full, AFTER),
    ):
        spread = [2 * std if np.isfinite(std) else 0.0 for _, _, std in entries]
        bars = {"type": "data", "array": spread, "color": color, "thickness": 1.2} if any(spread) else None
        if entries:
            figure.add_scatter(
                x=[value for _, value, _ in entries], y=[name for name, _, _ in entries], mode="markers", name=word,
                marker=marker, error_x=bars,
            )  # fmt: skip
    marked = [(name, row.mark) for name, row in rows.items() if row.mark is not None]
    if marked:
        tick = {"symbol": "line-ns", "size": 16, "line": {"color": INK, "width": 2.5}}
        x, y = [mark for _, mark in marked], [name for name, _ in marked]
        figure.add_scatter(x=x, y=y, mode="markers", name=words[2], marker=tick)
    figure = _styled(figure, 110 + 32 * len(names), axis, "")
    numbers = [x for row in rows.values() for x in (row.before, row.after, row.mark) if x is not None]
    if min(numbers) > 0 and max(numbers) > 30 * min(numbers):
        figure.update_xaxes(type="log", exponentformat="power", dtick="D2" if max(numbers) < 1e3 * min(numbers) else 1)
    else:
        # bars of what cannot be told would squeeze all others
        figure.update_xaxes(range=[min(0.0, 1.1 * min(numbers)), 1.15 * max([*numbers, 1e-12])])
    figure.update_yaxes(autorange="reversed", categoryorder="array", categoryarray=names, automargin=True)
    return figure


@dataclass(frozen=True)
class Row:
    """One row of a map over time.

    Attributes
    ----------
    name, group : str
        Rows of one group stand together.
    values : ndarray, shape (J,)
        NaN where there is nothing to show.
    texts : sequence of str, length J
        Shown under the pointer.
    """

    name: str
    group: str
    values: Array
    texts: Sequence[str]


def time_map(edges: Array, rows: Sequence[Row], axis: str) -> plotly.graph_objects.Figure:
    """Colors over time, one row for each quantity, grey where there is nothing to show.

    Parameters
    ----------
    edges : ndarray, shape (J + 1,)
        [s]
    rows : sequence of Row
    axis : str
        What the colors are.
    """
    import plotly.graph_objects as go

    values = np.array([row.values for row in rows])
    seen = np.abs(values[np.isfinite(values)])
    # even to the eye from one standard deviation to thousands
    limit = max(3.0, float(np.quantile(seen, 0.98))) if seen.size else 3.0
    marks = [m for m in ((0, 1, 3, 10) if limit < 20 else (0, 10, 100, 1000, 10000)) if m <= limit]
    marks = sorted({-m for m in marks} | set(marks))
    bar = {"thickness": 14, "x": 1.2, "tickvals": [float(_even(m)) for m in marks], "ticktext": [str(m) for m in marks]}
    figure = go.Figure()
    figure.add_heatmap(
        x=edges.tolist(), y=list(range(len(rows))), z=[_listed(_even(row)) for row in values],
        text=[list(row.texts) for row in rows], hoverinfo="text", zmin=-_even(limit), zmax=_even(limit),
        colorscale=DIVERGING, colorbar=bar,
    )  # fmt: skip
    figure = _styled(figure, 120 + max(17 * len(rows), 100), "time [s]", "")
    figure.update_layout(plot_bgcolor=PALE, margin={"r": 150, "t": 40})
    figure.add_annotation(
        x=0, xref="paper", xanchor="left", y=1, yref="paper", yanchor="bottom", text=f"color: {axis}", showarrow=False
    )
    figure.update_xaxes(showgrid=False, range=[float(edges[0]), float(edges[-1])])
    names = [row.name for row in rows]
    figure.update_yaxes(
        showgrid=False, range=[len(rows) - 0.5, -0.5], tickvals=list(range(len(rows))), ticktext=names,
        automargin=True, tickfont={"size": 11},
    )  # fmt: skip
    groups = [row.group for row in rows]
    for group in dict.fromkeys(groups):
        own = [i for i, entry in enumerate(groups) if entry == group]
        figure.add_annotation(
            x=1.01, xref="paper", y=(own[0] + own[-1]) / 2, text=group, showarrow=False, xanchor="left",
            font={"size": 11},
        )  # fmt: skip
        if own[0]:
            figure.add_hline(y=own[0] - 0.5, line={"color": INK, "width": 1})
    return figure


def _even(value: Any) -> Any:
    return np.arcsinh(np.asarray(value, float) / 2)


@dataclass(frozen=True)
class Ranked:
    """A candidate in a ranking.

    Attributes
    ----------
    name : str
    closed : (float, float, float) or None
        What it was found to close, and its interval [%].
    promised : float
    """

    name: str
    closed: tuple[float, float, float] | None
    promised: float


def ranking(entries: Sequence[Ranked], closed: str, promised: str) -> plotly.graph_objects.Figure:
    """Candidates from best to worst: what each was found to close, where one was tried, and what it promises.

    Parameters
    ----------
    entries : sequence of Ranked
    closed, promised : str
        Titles of the two axes.
    """
    from plotly.subplots import make_subplots

    done = [(entry.name, *entry.closed) for entry in entries if entry.closed is not None]
    last = 2 if done else 1
    figure = make_subplots(rows=1, cols=last, shared_yaxes=True, horizontal_spacing=0.08)
    figure.add_bar(
        x=[entry.promised for entry in entries], y=[entry.name for entry in entries], orientation="h", width=0.55,
        marker={"color": COLORS[1]}, showlegend=False, row=1, col=last,
    )  # fmt: skip
    figure = _styled(figure, 100 + 28 * len(entries), "", "")
    figure.update_xaxes(title_text=promised, rangemode="tozero", row=1, col=last)
    if done:
        bars = {
            "type": "data",
            "symmetric": False,
            "array": [high - value for _, value, _, high in done],
            "arrayminus": [value - low for _, value, low, _ in done],
        }
        figure.add_scatter(
            x=[value for _, value, _, _ in done], y=[name for name, *_ in done], mode="markers", showlegend=False,
            marker={"color": COLORS[0], "size": 11}, error_x=bars, row=1, col=1,
        )  # fmt: skip
        # what makes a prediction worse can do so without end
        left = min([0.0, *(max(low, WORST) for _, _, low, _ in done)]) - 6
        figure.update_xaxes(title_text=closed, range=[left, 108], row=1, col=1)
        figure.add_vline(x=0, line={"color": INK, "width": 1}, row=1, col=1)
        for name, value, _, _ in done:
            if value < left:
                text = f"◀ {value:.0f}"
                figure.add_annotation(x=left, y=name, text=text, showarrow=False, xanchor="left", row=1, col=1)
    names = [entry.name for entry in entries][::-1]
    figure.update_yaxes(type="category", categoryorder="array", categoryarray=names, automargin=True)
    figure.update_yaxes(range=[-0.6, len(names) - 0.4])
    return figure


def matrix(names: Sequence[str], values: Array, row: str, column: str) -> plotly.graph_objects.Figure:
    """Parts of a whole, in per cent, for every pair of names.

    Parameters
    ----------
    names : sequence of str
    values : ndarray, shape (n, n)
        Between 0 and 1.
    row, column : str
        What stands at the side and below.
    """
    import plotly.graph_objects as go

    figure = go.Figure()
    figure.add_heatmap(
        x=list(names), y=list(names), z=values.tolist(), zmin=0.0, zmax=1.0, showscale=False, xgap=1, ygap=1,
        colorscale=RISING,
        text=[[f"{100 * v:.0f}" if v >= 0.095 else "" for v in line] for line in values], texttemplate="%{text}",
        hovertemplate="%{y} explained by %{x}: %{z:.2f}<extra></extra>",
    )  # fmt: skip
    figure = _styled(figure, 190 + 27 * len(names), column, row)
    every = {"type": "category", "tickmode": "array", "tickvals": list(names), "title_standoff": 6}
    figure.update_xaxes(showgrid=False, tickangle=-40, automargin=True, **every)
    figure.update_yaxes(showgrid=False, autorange="reversed", automargin=True, **every)
    return figure


def _thinned(count: int) -> NDArray[np.int64]:
    if count <= LONGEST:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, LONGEST).astype(np.int64))


def _listed(values: Array) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _short(values: Array) -> NDArray[np.float32]:
    """Single precision, which the eye cannot tell from double and which takes half the room in a page."""
    return np.asarray(values, np.float32)


def _times(t: Array) -> NDArray[np.floating]:
    return np.asarray(t, float) if len(t) and np.nanmax(np.abs(t)) > EPOCH else _short(t)


def _styled(
    figure: plotly.graph_objects.Figure, height: int, x: str, y: str, log_y: bool = False
) -> plotly.graph_objects.Figure:
    layout: dict[str, Any] = {
        "height": height,
        "margin": {"l": 70, "r": 20, "t": 30, "b": 45},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
        "hovermode": "closest",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MEASURED, "activecolor": COLORS[0]},
    }
    figure.update_layout(**layout)
    figure.update_xaxes(title_text=x or None, gridcolor=PALE, zeroline=False, linecolor=PALE)
    figure.update_yaxes(gridcolor=PALE, zeroline=False, linecolor=PALE)
    if y:
        figure.update_yaxes(title_text=y)
    if log_y:
        figure.update_yaxes(type="log", exponentformat="power")
    return figure
