"""Plotly figures of the report: plots over time, curves, and plots with one row for each name.

A figure is a dictionary with the traces `data` and the `layout`, as Plotly's script reads it. Plotly's Python objects
are not used, because making them takes longer than the rest of a page.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.arrays import Array
from yid_ocp.files import to_json_types
from yid_ocp.report.terminal import scale_and_unit_with_metres_as_mm

# on a dark page, templates/dark.json maps each color; figures use no other colors
_TEXT_COLOR, _GRID_COLOR, _BACKGROUND_COLOR = "#22303c", "#d9dee3", "#ffffff"
LINE_PALETTE = ("#0b6e99", "#c2571a", "#5b8c2a", "#8a4f9e")
_LINE_DASHES, _SYMBOLS = ("solid", "dash", "dot", "dashdot"), ("circle", "diamond", "square", "cross")
BEFORE_COLOR, AFTER_COLOR, MEASURED_COLOR = LINE_PALETTE[1], LINE_PALETTE[0], "#8d99a4"
_DIVERGING_COLORS = ("#2166ac", "#92c5de", _BACKGROUND_COLOR, "#f4a582", "#b2182b")
_SEQUENTIAL_COLORSCALE = ((0.0, _BACKGROUND_COLOR), (0.5, "#b9d9e6"), (0.9, "#0b6e99"), (1.0, "#06405a"))
_MAX_CURVE_POINTS = 1200  # largest number of points of a curve; more are not visible and enlarge the page
_MAX_SINGLE_PRECISION_TIME = 1e4  # at larger times single precision is too coarse for milliseconds [s]
_ROW_HEIGHT, _LOW_ROW_HEIGHT, _ROW_GAP = 130, 76, 30  # of a figure with rows [px]
_TOP_MARGIN, _BOTTOM_MARGIN = 70, 44  # [px]
_SHADE = {"fillcolor": _GRID_COLOR, "opacity": 0.7, "line": {"width": 0}, "layer": "below"}
_AXIS_STYLE = {"gridcolor": _GRID_COLOR, "zeroline": False, "linecolor": _GRID_COLOR, "automargin": True}
_AXIS_STYLE |= {"exponentformat": "power"}
_LAYOUT: dict[str, Any] = {
    "margin": {"l": 70, "r": 20, "t": 56, "b": 45},  # the legend stands below the toolbar
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"family": "system-ui, sans-serif", "size": 13, "color": _TEXT_COLOR},
    "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
    "hovermode": "closest",
    "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MEASURED_COLOR, "activecolor": LINE_PALETTE[0]},
}
_MIN_CLOSURE_PERCENT = -50.0  # lower end of an axis of closures [%]
_Curve = tuple[Sequence[float], Sequence[float]]
_Figure = dict[str, Any]


def _line_color(i: int) -> str:
    return LINE_PALETTE[i % len(LINE_PALETTE)]


def figure_html(figure: _Figure) -> str:
    """Convert a figure to an HTML element, which the page's script draws in light or dark colors."""
    told = json.dumps(_plotly_json(figure), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    told = told.replace("^2", "²").replace("^3", "³")
    script = f'<script type="application/json">{told}</script>'
    return f'<div class="plot" style="height:{figure["layout"]["height"]}px">{script}</div>'


def _plotly_json(value: Any) -> Any:
    """Return a figure as data for JSON, with arrays as Plotly's script reads them: base64 text and number type."""
    if isinstance(value, Mapping):
        return {key: _plotly_json(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str[1:], "bdata": base64.b64encode(value.tobytes()).decode("ascii")}
    return [*map(_plotly_json, value)] if isinstance(value, (list, tuple, range)) else to_json_types(value)


def _styled_figure(height: int, x: str, y: str) -> _Figure:
    """Return an empty figure with a height [px], titles `x` and `y` of its axes, and the report's colors and fonts."""
    titles = {"x": {"text": x, "standoff": 6}, "y": {"text": y, "standoff": 6}}
    axes = {f"{name}axis": {"title": title, **_AXIS_STYLE} for name, title in titles.items()}
    return {"data": [], "layout": {**_LAYOUT, "height": height, **axes, "shapes": [], "annotations": []}}


def _add_trace(figure: _Figure, kind: str = "scatter", /, **trace: Any) -> _Figure:
    figure["data"].append({"type": kind, **trace})
    return figure


def _set_axis(figure: _Figure, name: str, /, **settings: Any) -> _Figure:
    """Change settings of the axis `name` (such as `xaxis`) in place, and return the figure."""
    figure["layout"][name].update(settings)
    return figure


def _add_line(figure: _Figure, axis: str, value: float, **line: Any) -> None:
    """Add a line across the whole plot at a value of `axis`, x or y."""
    other = "x" if axis == "y" else "y"
    at = {f"{axis}0": value, f"{axis}1": value, f"{axis}ref": axis, f"{other}0": 0, f"{other}1": 1}
    figure["layout"]["shapes"].append({"type": "line", **at, f"{other}ref": f"{other} domain", "line": line})


def _add_curves(figure: _Figure, curves: Iterable[tuple[str, _Curve]]) -> _Figure:
    """Add a line with markers for each name and curve (x, y), in its own color; dashed if the colors repeat."""
    for i, (name, (x, y)) in enumerate(curves):
        line = {"color": _line_color(i), "dash": "solid" if i < len(LINE_PALETTE) else "dash"}
        if len(x):
            _add_trace(figure, x=list(x), y=list(y), mode="lines+markers", name=name, line=line)
    return figure


def solution_cost_history_figure(costs: Sequence[float], notes: Sequence[str]) -> _Figure:
    """Plot the cost of every accepted iterate, with one curve for each horizon that the solver fitted."""
    figure = _styled_figure(340, "accepted point", "cost")
    _set_axis(figure, "yaxis", type="log")
    ends = [i for i in range(1, len(costs) + 1) if i == len(costs) or notes[i] != notes[i - 1]]
    spans = zip([0, *ends], ends, strict=False)
    return _add_curves(figure, ((notes[i] or "whole recordings", (range(i, j), costs[i:j])) for i, j in spans))


@dataclass(frozen=True)
class TimePlotData:
    """The data of one plot over time: measured values (M,) at t (M,) [s], lines (t, value) by name, marked periods."""

    axis_title: str
    lines: Mapping[str, tuple[Array, Array]]
    t: Array = field(default_factory=lambda: np.zeros(0))
    measured: Array = field(default_factory=lambda: np.zeros(0))
    band_half_height: float | None = None  # half the height of a shaded band about zero; None: no band
    marked_intervals: Sequence[tuple[float, float]] = ()
    is_low_row: bool = False  # whether the plot has a smaller height, as for residuals
    dots_name: str = "measured"  # legend of the measured values


def channel_prediction_and_residual_plot_data(
    title: str,
    unit: str,
    t: Array,
    measured: Array,
    std: Array,
    lines: Mapping[str, Array],
    dense_line: tuple[Array, Array] | None = None,
) -> tuple[TimePlotData, TimePlotData]:
    """Return plot data of measured and predicted values, and of their residual with a band of two noise stds.

    Arrays have shape (M,). `lines` holds predictions by name; `dense_line` (t, value) (K,) draws the first densely.
    """
    seen = np.isfinite(measured) & np.isfinite(std)
    factor, shown = scale_and_unit_with_metres_as_mm(unit)
    drawn = {name: (t, values) for name, values in lines.items()}
    if dense_line is not None:
        drawn[next(iter(lines))] = dense_line
    # NaN in long gaps between measurements
    known, steps = t[seen], np.diff(t[seen])
    breaks = np.flatnonzero(steps > 5 * np.median(steps)) + 1 if len(steps) else np.zeros(0, int)
    times = np.insert(known, breaks, known[breaks])
    left = {n: (times, np.insert(factor * (y - measured)[seen], breaks, np.nan)) for n, y in lines.items()}
    noise = float(np.median(std[seen])) if seen.any() else 0.0
    above, band = TimePlotData(f"{title} [{unit}]", drawn, t, measured), 2 * factor * noise or None
    return above, TimePlotData(f"residual [{shown}]", left, band_half_height=band, is_low_row=True)


def time_plots_figure(
    curves: Sequence[TimePlotData], dots: str = LINE_PALETTE[1], lines: Mapping[str, str] | None = None
) -> _Figure:
    """Plot measured values and lines over time, with one row for each entry of `curves`.

    `dots` is the color of measured values. `lines` maps line names to colors (default: the palette, in order).
    """
    names = dict.fromkeys(name for curve in curves for name in curve.lines)
    colors = lines or {name: _line_color(i) for i, name in enumerate(names)}
    heights = [_LOW_ROW_HEIGHT if curve.is_low_row else _ROW_HEIGHT for curve in curves]
    inner = sum(heights) + _ROW_GAP * (len(curves) - 1)
    axes: dict[str, Any] = {}
    traces, shapes, titles = list[dict[str, Any]](), list[dict[str, Any]](), list[dict[str, Any]]()
    told: set[str] = set()
    top, last = 1.0, str(len(curves)) if len(curves) > 1 else ""
    for row, (curve, height) in enumerate(zip(curves, heights, strict=True), start=1):
        number = str(row) if row > 1 else ""
        shared = {} if number == last else {"matches": f"x{last}", "showticklabels": False}
        axes[f"xaxis{number}"] = {"anchor": f"y{number}", "domain": [0, 1], **shared, **_AXIS_STYLE}
        domain = [max(top - height / inner, 0.0), top]
        axes[f"yaxis{number}"] = {"anchor": f"x{number}", "domain": domain, "nticks": 4, **_AXIS_STYLE}
        at = {"type": "scatter", "xaxis": f"x{number}", "yaxis": f"y{number}"}
        dot = {"color": dots, "size": 3 if len(curve.t) > 60 else 6}
        drawn = [(curve.dots_name, curve.t, curve.measured, {"mode": "markers", "marker": dot})] if len(curve.t) else []
        for name, (t, value) in curve.lines.items():
            # sparse measurements may have no neighbours
            mode = "lines+markers" if curve.is_low_row and len(t) <= 60 else "lines"
            style = {"mode": mode, "line": {"color": colors[name], "width": 1.5}, "marker": {"size": 4}}
            drawn.append((name, t, value, style))
        for name, t, value, style in drawn:
            shown = {"name": name, "showlegend": name not in told, "legendgroup": name}
            traces.append({**_thinned(t, value), **style, **shown, **at})
            told.add(name)
        if curve.band_half_height is not None:
            shapes.append(_shade(number, (0, 1), (-curve.band_half_height, curve.band_half_height)))
        for begin, end in curve.marked_intervals:
            mark = _shade(number, (begin, end), (0, 1), along_time=True)
            shapes.append(mark | {"fillcolor": AFTER_COLOR, "opacity": 0.2})
        # next to a low row, a rotated title would collide with the next title
        titles.append({**_axis_title(curve.axis_title, top), "font": {"size": 12}})
        top -= (height + _ROW_GAP) / inner
    axes[f"xaxis{last}"]["title"] = {"text": "time [s]", "standoff": 6}
    margin = {"l": 54, "r": 12, "t": _TOP_MARGIN, "b": _BOTTOM_MARGIN}
    height = inner + _TOP_MARGIN + _BOTTOM_MARGIN
    legend, around = {**_LAYOUT["legend"], "y": 1 + 22 / inner}, {"shapes": shapes, "annotations": titles}
    layout = {**_LAYOUT, **axes, **around, "height": height, "margin": margin, "legend": legend}
    return {"data": traces, "layout": layout}


def _shade(number: str, x: tuple[float, float], y: tuple[float, float], *, along_time: bool = False) -> dict[str, Any]:
    """Return a shaded rectangle in a row, of full height over a time interval (`along_time`) or else of full width."""
    domain = (f"x{number}", f"y{number} domain") if along_time else (f"x{number} domain", f"y{number}")
    corners = {"x0": x[0], "x1": x[1], "y0": y[0], "y1": y[1]}
    return {"type": "rect", "xref": domain[0], "yref": domain[1], **corners, **_SHADE}


def _axis_title(text: str, y: float) -> dict[str, Any]:
    at = {"x": 0, "xref": "paper", "xanchor": "left", "y": y, "yref": "paper", "yanchor": "bottom"}
    return {"text": text, "showarrow": False, **at}


def lines_over_time_figure(curve: TimePlotData) -> _Figure:
    """Plot the lines of `curve` over time, each in its own color. Measured values are not drawn."""
    figure = _styled_figure(320 + 8 * len(curve.lines), "time [s]", "")
    for i, (name, (t, value)) in enumerate(curve.lines.items()):
        dash = _LINE_DASHES[i // len(LINE_PALETTE) % len(_LINE_DASHES)]
        style = {"color": _line_color(i), "width": 1.5, "dash": dash}
        _add_trace(figure, **_thinned(t, value), mode="lines", name=name, line=style)
    if curve.band_half_height is not None:
        figure["layout"]["shapes"].append(_shade("", (0, 1), (-curve.band_half_height, curve.band_half_height)))
    # the legend below takes as many rows as the screen is narrow
    below = {"orientation": "h", "y": -0.22, "yanchor": "top", "x": 0, "font": {"size": 11}}
    figure["layout"] |= {"legend": below, "annotations": [{**_axis_title(curve.axis_title, 1), "font": {"size": 12}}]}
    return figure


def whitened_residual_histogram_figure(residuals: Mapping[str, Array]) -> _Figure:
    """Plot a histogram of the whitened residuals of each sensor group, with the standard normal density."""
    figure = _styled_figure(340, "residual in standard deviations", "density")
    edge = max([4.0, *(float(np.quantile(np.abs(r), 0.995)) for r in residuals.values() if len(r))])
    for i, (name, values) in enumerate(residuals.items()):
        bins = np.linspace(-edge, edge, int(np.clip(2 * np.sqrt(len(values)), 8, 60)) + 1)
        density, _ = np.histogram(np.clip(values, -edge, edge), bins=bins, density=True)
        steps = {"x": (0.5 * (bins[1:] + bins[:-1])).tolist(), "y": density.tolist()}
        line = {"color": _line_color(i), "shape": "hvh"}
        _add_trace(figure, **steps, mode="lines", line=line, name=f"{name} ({len(values)} values)")
    even = np.linspace(-edge, edge, 121)
    normal = {"x": even.tolist(), "y": (np.exp(-0.5 * even**2) / np.sqrt(2 * np.pi)).tolist()}
    line = {"color": _TEXT_COLOR, "dash": "dot"}
    return _add_trace(figure, **normal, mode="lines", line=line, name="standard normal")


def method_costs_over_wall_time_figure(costs: Mapping[str, _Curve]) -> _Figure:
    """Plot (cost / lowest cost of the same method) - 1 against wall time. `costs`: (seconds, costs) by method."""
    figure = _styled_figure(340, "wall time [s]", "cost / lowest cost - 1")
    _set_axis(figure, "yaxis", type="log")
    least = {name: max(min(cost, default=0.0), 1e-300) for name, (_, cost) in costs.items()}
    excess = {name: (t, [max(c / least[name] - 1, 1e-9) for c in cost]) for name, (t, cost) in costs.items()}
    return _add_curves(figure, excess.items())


def asymmetric_error_bars(values: Sequence[float], low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    """Return Plotly's settings for error bars about `values` from the lower ends `low` to the upper ends `high`."""
    above, below = np.maximum(np.subtract(high, values), 0.0), np.maximum(np.subtract(values, low), 0.0)
    return {"type": "data", "symmetric": False, "array": above.tolist(), "arrayminus": below.tolist()}


def profile_likelihood_figure(curves: Mapping[str, _Curve], level: float) -> _Figure:
    """Plot profile likelihoods: rise of chi2 over parameter / estimate, by name. `level` is the rise at 95 %."""
    figure = _add_curves(_styled_figure(380, "value / estimate", "chi2 - smallest chi2"), curves.items())
    _add_line(figure, "y", level, color=_TEXT_COLOR, dash="dot")
    at = {"x": 1, "xref": "x domain", "xanchor": "right", "y": level, "yref": "y", "yanchor": "bottom"}
    figure["layout"]["annotations"].append({"text": "95 %", "showarrow": False, **at})
    points = [point for own in curves.values() for point in zip(*own, strict=True)]
    reach = min(max((abs(np.log10(x)) for x, rise in points if x > 0 and 0 < rise <= 2.5 * level), default=1.0), 1.0)
    _set_axis(figure, "xaxis", type="log", range=[-reach, reach])
    return _set_axis(figure, "yaxis", range=[-0.2, 2.5 * level])


def scatter_figure(clouds: Mapping[str, tuple[Array, Array]], x: str, y: str) -> _Figure:
    """Plot clouds of points (x, y) by name. `x` and `y` are the titles of the axes."""
    figure = _styled_figure(340, x, y)
    for i, (name, (across, up)) in enumerate(clouds.items()):
        points = {"x": np.asarray(across, np.float32), "y": np.asarray(up, np.float32)}
        _add_trace(figure, **points, mode="markers", name=name, marker={"size": 3, "color": _line_color(i)})
    return figure


def estimated_curve_figure(
    curve: tuple[Array, Array, Array], others: Mapping[str, Array], visited: tuple[float, float], x: str, y: str
) -> _Figure:
    """Plot a curve (x, y, std) with a band of two stds, other curves dashed, and the ends of the visited x range."""
    figure, (at, middle, std) = _styled_figure(340, x, y), curve
    edges = np.concatenate([middle + 2 * std, (middle - 2 * std)[::-1]])
    band = {"fill": "toself", "line": {"width": 0}, "hoverinfo": "skip", "showlegend": False, "opacity": 0.25}
    _add_trace(figure, x=[*at, *at[::-1]], y=list(edges), mode="lines", fillcolor=AFTER_COLOR, **band)
    _add_trace(figure, x=list(at), y=list(middle), mode="lines", name="law", line={"color": AFTER_COLOR})
    for i, (name, values) in enumerate(others.items()):
        line = {"color": _line_color(i + 1), "dash": "dash"}
        _add_trace(figure, x=list(at), y=list(values), mode="lines", name=name, line=line)
    for edge in visited:
        _add_line(figure, "x", edge, color=_TEXT_COLOR, dash="dot")
    return figure


def _thinned(t: Array, values: Array) -> dict[str, NDArray[np.floating]]:
    """Return at most `_MAX_CURVE_POINTS` points of a curve, in single precision to halve their size in a page."""
    count = len(t)
    keep = np.unique(np.linspace(0, count - 1, min(count, _MAX_CURVE_POINTS)).astype(np.int64))
    is_late = count and np.nanmax(np.abs(t[keep])) > _MAX_SINGLE_PRECISION_TIME
    return {"x": np.asarray(t[keep], float if is_late else np.float32), "y": np.asarray(values[keep], np.float32)}


def parameter_values_by_source_figure(
    rows: Mapping[str, Mapping[str, tuple[float, float | None]]], axis: str, colors: Mapping[str, str] | None = None
) -> _Figure:
    """Plot (value, std) as value ± 2 std, from `rows` by name and source: a row for each name, a color per source."""
    sources = list(dict.fromkeys([*(colors or ()), *(source for row in rows.values() for source in row)]))
    names = list(rows)
    figure = _styled_figure(136 + max(36, 14 * len(sources)) * len(names), axis, "")
    figure["layout"]["showlegend"] = True
    spread = 0.6 / max(len(sources), 1)
    for i, source in enumerate(sources):
        own = [(k, *rows[name][source]) for k, name in enumerate(names) if source in rows[name]]
        color, symbol = (colors or {}).get(source, _line_color(i)), _SYMBOLS[i // len(LINE_PALETTE) % len(_SYMBOLS)]
        lengths = [2 * std if std is not None and np.isfinite(std) else 0.0 for *_, std in own]
        bars = {"type": "data", "array": lengths, "color": color, "thickness": 1.2} if any(lengths) else None
        places = [k + spread * (i - (len(sources) - 1) / 2) for k, *_ in own]
        points = {"x": [value for _, value, _ in own], "y": places, "error_x": bars, "name": source}
        if own:
            _add_trace(figure, **points, mode="markers", marker={"color": color, "size": 8, "symbol": symbol})
    numbers = [value for row in rows.values() for value, _ in row.values()]
    low, high = min([0.0, *numbers]), max([0.0, *numbers])
    if numbers and min(numbers) > 0 and high > 30 * min(numbers):
        _set_axis(figure, "xaxis", type="log", dtick="D2" if high < 1e3 * min(numbers) else 1)
    else:
        # bars of undetermined parameters would compress all others
        _set_axis(figure, "xaxis", range=[low - 0.1 * (high - low or 1.0), high + 0.25 * (high - low or 1.0)])
    return _set_axis(figure, "yaxis", tickvals=list(range(len(names))), ticktext=names, range=[len(names) - 0.5, -0.5])


def confusability_matrix_figure(names: Sequence[str], values: Array) -> _Figure:
    """Plot a heat map of `values` (n, n), the fraction of the row's signature that the column's effect can explain."""
    figure = _styled_figure(130 + 27 * len(names), "explained by [%]", "signature of")
    _add_trace(
        figure, "heatmap", x=list(names), y=list(names), z=values.tolist(), zmin=0.0, zmax=1.0, showscale=False,
        xgap=1, ygap=1,
        colorscale=_SEQUENTIAL_COLORSCALE, texttemplate="%{text}",
        hovertemplate="%{y} explained by %{x}: %{z:.2f}<extra></extra>",
        text=[[f"{100 * v:.0f}" if v >= 0.095 else "" for v in line] for line in values],
    )  # fmt: skip
    every = {"type": "category", "tickmode": "array", "showgrid": False, "tickvals": list(names)}
    _set_axis(figure, "xaxis", tickangle=0, ticktext=[str(i + 1) for i in range(len(names))], **every)
    rows = [f"{name}  {i + 1}" for i, name in enumerate(names)]
    return _set_axis(figure, "yaxis", autorange="reversed", ticktext=rows, **every)


@dataclass(frozen=True)
class TimeHeatMapRow:
    """A row of a heat map over J time intervals. Rows of one group are adjacent."""

    name: str
    group: str
    values: Array  # (J,), NaN if there is nothing to show
    hover_texts: Sequence[str]  # J texts, shown when the pointer is on an interval


def time_heat_map_figure(edges: Array, rows: Sequence[TimeHeatMapRow], axis: str) -> _Figure:
    """Plot a heat map over J intervals with `edges` (J + 1,) [s] and color scale `axis`. Grey: no information."""
    values = np.array([row.values for row in rows])
    seen = np.abs(values[np.isfinite(values)])
    # even to the eye from one standard deviation to thousands
    limit = max(3.0, float(np.quantile(seen, 0.98))) if seen.size else 3.0
    marks = [m for m in ((0, 1, 3, 10) if limit < 20 else (0, 10, 100, 1000, 10000)) if m <= limit]
    marks = sorted({-m for m in marks} | set(marks))
    bar = {"thickness": 14, "x": 1.2, "tickvals": _even(marks).tolist(), "ticktext": [str(m) for m in marks]}
    figure = _styled_figure(120 + max(17 * len(rows), 100), "time [s]", "")
    _add_trace(
        figure, "heatmap", x=edges.tolist(), y=list(range(len(rows))),
        z=[[v if np.isfinite(v) else None for v in row.tolist()] for row in _even(values)],
        text=[list(row.hover_texts) for row in rows], hoverinfo="text", zmin=-_even(limit), zmax=_even(limit),
        colorscale=[*zip((0.0, 0.25, 0.5, 0.75, 1.0), _DIVERGING_COLORS, strict=True)], colorbar=bar,
    )  # fmt: skip
    figure["layout"] |= {"plot_bgcolor": _GRID_COLOR, "margin": {**_LAYOUT["margin"], "r": 150, "t": 40}}
    labels = [_axis_title(f"color: {axis}", 1)]
    _set_axis(figure, "xaxis", showgrid=False, range=[float(edges[0]), float(edges[-1])])
    ticks = {"tickvals": list(range(len(rows))), "ticktext": [row.name for row in rows], "tickfont": {"size": 11}}
    _set_axis(figure, "yaxis", showgrid=False, range=[len(rows) - 0.5, -0.5], **ticks)
    groups = [row.group for row in rows]
    for group in dict.fromkeys(groups):
        own = [i for i, entry in enumerate(groups) if entry == group]
        at = {"x": 1.01, "xref": "paper", "y": (own[0] + own[-1]) / 2, "xanchor": "left"}
        labels.append({"text": group, "showarrow": False, "font": {"size": 11}, **at})
        if own[0]:
            _add_line(figure, "y", own[0] - 0.5, color=_TEXT_COLOR, width=1)
    figure["layout"]["annotations"] = labels
    return figure


def _even(value: Any) -> Any:
    return np.arcsinh(np.asarray(value, float) / 2)


def gap_closure_and_screening_figure(
    entries: Mapping[str, tuple[tuple[float, float, float] | None, float]], closed: str, predicted: str
) -> _Figure:
    """Plot how much of the gap each candidate closes after a refit [%], and the decrease that screening predicts.

    `entries` maps a label to ((closure, lower end, upper end), or None without a refit, and predicted decrease).
    `closed` and `predicted` are the titles of the two axes.
    """
    done = {name: closure for name, (closure, _) in entries.items() if closure}
    last, names = "2" if done else "", list(entries)[::-1]
    figure = _styled_figure(126 + 28 * len(entries), predicted, "")
    rows = {"type": "category", "categoryarray": names, "categoryorder": "array"}
    _set_axis(figure, "yaxis", **rows, range=[-0.6, len(entries) - 0.4])
    bars = {"x": [decrease for _, decrease in entries.values()], "y": list(entries), "orientation": "h", "width": 0.55}
    bars |= {"xaxis": f"x{last}", "yaxis": f"y{last}", "marker": {"color": LINE_PALETTE[1]}}
    _add_trace(figure, "bar", **bars, showlegend=False)
    _set_axis(figure, "xaxis", rangemode="tozero")
    if done:
        layout = figure["layout"]
        layout["xaxis2"] = {**layout["xaxis"], "domain": [0.54, 1], "anchor": "y2"}
        layout["yaxis2"] = {**layout["yaxis"], "anchor": "x2", "matches": "y", "showticklabels": False}
        values, lows, highs = zip(*done.values(), strict=True)
        points = {"x": values, "y": list(done), "error_x": asymmetric_error_bars(values, lows, highs)}
        marker = {"color": LINE_PALETTE[0], "size": 11}
        _add_trace(figure, **points, mode="markers", marker=marker, showlegend=False, xaxis="x", yaxis="y")
        # a worse prediction has no lower limit of closure
        left = min([0.0, *(max(low, _MIN_CLOSURE_PERCENT) for low in lows)]) - 6
        title = {"text": closed, "standoff": 6}
        layout["xaxis"] = {"title": title, **_AXIS_STYLE, "range": [left, 108], "domain": [0, 0.46]}
        _add_line(figure, "x", 0, color=_TEXT_COLOR, width=1)
        texts = {name: f"◀ {value:.0f}" for name, (value, *_) in done.items() if value < left}
        at = {"x": left, "xanchor": "left", "xref": "x", "yref": "y", "showarrow": False}
        layout["annotations"] += [{"y": name, "text": text, **at} for name, text in texts.items()]
    return figure
