"""Plotly figures over time and colors of the report (the extra `report`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.arrays import Array
from yid_ocp.report.terminal import display_scale_and_unit

if TYPE_CHECKING:
    import plotly.graph_objects


# on a dark page each becomes what templates/dark.json says; figures use no other colors
TEXT_COLOR, GRID_COLOR, BACKGROUND_COLOR = "#22303c", "#d9dee3", "#ffffff"
LINE_COLORS = ("#0b6e99", "#c2571a", "#5b8c2a", "#8a4f9e")
_LINE_DASHES = ("solid", "dash", "dot", "dashdot")
BEFORE_COLOR, AFTER_COLOR, MEASURED_COLOR = LINE_COLORS[1], LINE_COLORS[0], "#8d99a4"
DIVERGING_COLORSCALE = (
    (0.0, "#2166ac"),
    (0.25, "#92c5de"),
    (0.5, BACKGROUND_COLOR),
    (0.75, "#f4a582"),
    (1.0, "#b2182b"),
)
SEQUENTIAL_COLORSCALE = ((0.0, BACKGROUND_COLOR), (0.5, "#b9d9e6"), (0.9, "#0b6e99"), (1.0, "#06405a"))
_MAX_CURVE_POINTS = 1200  # points of a curve; beyond this the page grows and the eye sees no more
_MAX_SINGLE_PRECISION_TIME = 1e4  # times from which single precision loses milliseconds [s]
_ROW_HEIGHT, _LOW_ROW_HEIGHT, _ROW_GAP = 130, 76, 30  # in a figure of rows [px]
_TOP_MARGIN, _BOTTOM_MARGIN = 64, 44  # [px]
_SHADE = {"fillcolor": GRID_COLOR, "opacity": 0.7, "line": {"width": 0}, "layer": "below"}
_AXIS_STYLE = {"gridcolor": GRID_COLOR, "zeroline": False, "linecolor": GRID_COLOR}


def line_color(i: int) -> str:
    """Color of the i-th line of a figure; the colors repeat."""
    return LINE_COLORS[i % len(LINE_COLORS)]


def figure_html(figure: plotly.graph_objects.Figure) -> str:
    """HTML element of a figure; the page's script draws it in light or dark colors."""
    figure.update_layout(template=None)  # all is said here; the default one is some kilobytes each
    told = str(figure.to_json()).replace("<", "\\u003c")
    return (
        f'<div class="plot" style="height:{figure.layout.height}px">'
        f'<script type="application/json">{told}</script></div>'
    )


def styled_report_figure(
    height: int, x: str, y: str, log_y: bool = False, base: plotly.graph_objects.Figure | None = None
) -> plotly.graph_objects.Figure:
    """A plotly figure (`base` or an empty one) with height [px], axis titles, and the report's colors and fonts."""
    import plotly.graph_objects as go

    figure = go.Figure() if base is None else base
    figure.update_layout(_report_layout(height))
    figure.update_xaxes(title_text=x or None, **_AXIS_STYLE)
    figure.update_yaxes(title_text=y or None, **_AXIS_STYLE)
    if log_y:
        figure.update_yaxes(type="log", exponentformat="power")
    return figure


def _report_layout(height: int) -> dict[str, Any]:
    """Layout that all figures of a page share, without their axes."""
    return {
        "height": height,
        "margin": {"l": 70, "r": 20, "t": 30, "b": 45},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": TEXT_COLOR},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
        "hovermode": "closest",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MEASURED_COLOR, "activecolor": LINE_COLORS[0]},
    }


def cost_history_figure(costs: Sequence[float], notes: Sequence[str]) -> plotly.graph_objects.Figure:
    """Figure of the cost at every accepted point, one curve per intermediate horizon."""
    figure = styled_report_figure(320, "accepted point", "cost", log_y=True)
    ends = [i for i in range(1, len(costs) + 1) if i == len(costs) or notes[i] != notes[i - 1]]
    for stage, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
        figure.add_scatter(
            x=list(range(begin, end)), y=list(costs[begin:end]), mode="lines+markers",
            name=notes[begin] or "whole recordings", line={"color": line_color(stage)},
        )  # fmt: skip
    return figure


@dataclass(frozen=True)
class TimePlotData:
    """Data of one plot over time: measured points and predicted lines.

    Attributes
    ----------
    lines : mapping of name to (t, value)
    t, measured : ndarray, shape (M,), optional
    band_half_height : float or None
        Half the height of what is shaded about zero.
    """

    axis_title: str
    lines: Mapping[str, tuple[Array, Array]]
    t: Array = field(default_factory=lambda: np.zeros(0))
    measured: Array = field(default_factory=lambda: np.zeros(0))
    band_half_height: float | None = None
    marked_intervals: Sequence[tuple[float, float]] = ()
    is_low_row: bool = False


def prediction_and_residual_plots(
    title: str,
    unit: str,
    t: Array,
    measured: Array,
    std: Array,
    lines: Mapping[str, Array],
    course: tuple[Array, Array] | None = None,
) -> tuple[TimePlotData, TimePlotData]:
    """Two plots: measured and predicted values, and their residual with a band of two noise standard deviations.

    Parameters
    ----------
    t, measured, std : ndarray, shape (M,)
    lines : mapping of name to ndarray, shape (M,)
    course : (t (K,), value (K,)), optional
        The first of the lines at more times, for what is measured seldom.
    """
    seen = np.isfinite(measured) & np.isfinite(std)
    factor, shown = display_scale_and_unit(unit)
    drawn = {name: (t, values) for name, values in lines.items()}
    if course is not None:
        drawn[next(iter(lines))] = course
    # with NaN in long gaps between measurements
    known, steps = t[seen], np.diff(t[seen])
    breaks = np.flatnonzero(steps > 5 * np.median(steps)) + 1 if len(steps) else np.zeros(0, int)
    left = {
        name: (np.insert(known, breaks, known[breaks]), np.insert(factor * (y - measured)[seen], breaks, np.nan))
        for name, y in lines.items()
    }
    noise = float(np.median(std[seen])) if seen.any() else 0.0
    above = TimePlotData(f"{title} [{unit}]", drawn, t, measured)
    return above, TimePlotData(
        f"residual [{shown}]", left, band_half_height=2 * factor * noise or None, is_low_row=True
    )


def time_plots_figure(
    curves: Sequence[TimePlotData], dots: str = LINE_COLORS[1], lines: Mapping[str, str] | None = None
) -> plotly.graph_objects.Figure:
    """Figure with measured points and lines, one row per plot.

    `dots` is the color of what is measured, `lines` are those of the lines by name; one after the other when absent.
    """
    import plotly.graph_objects as go

    names = dict.fromkeys(name for curve in curves for name in curve.lines)
    colors = lines or {name: line_color(i) for i, name in enumerate(names)}
    heights = [_LOW_ROW_HEIGHT if curve.is_low_row else _ROW_HEIGHT for curve in curves]
    inner = sum(heights) + _ROW_GAP * (len(curves) - 1)
    # all at once: a figure that grows by one trace after the other is checked anew each time
    axes: dict[str, Any] = {}
    traces: list[dict[str, Any]] = []
    shapes: list[dict[str, Any]] = []
    titles: list[dict[str, Any]] = []
    told: set[str] = set()
    top, last = 1.0, str(len(curves)) if len(curves) > 1 else ""
    for row, (curve, height) in enumerate(zip(curves, heights, strict=True), start=1):
        number = str(row) if row > 1 else ""
        shared = {} if number == last else {"matches": f"x{last}", "showticklabels": False}
        axes[f"xaxis{number}"] = {"anchor": f"y{number}", "domain": [0, 1], **shared, **_AXIS_STYLE}
        domain = [max(top - height / inner, 0.0), top]
        axes[f"yaxis{number}"] = {"anchor": f"x{number}", "domain": domain, "nticks": 4, **_AXIS_STYLE}
        at = {"type": "scatter", "xaxis": f"x{number}", "yaxis": f"y{number}"}
        if len(curve.t):
            marker = {"color": dots, "size": 3 if len(curve.t) > 60 else 6}
            shown = {"name": "measured", "showlegend": "measured" not in told, "legendgroup": "measured"}
            traces.append({**_thinned(curve.t, curve.measured), "mode": "markers", "marker": marker, **shown, **at})
            told.add("measured")
        for name, (t, value) in curve.lines.items():
            # what is measured seldom may have neighbours on neither side
            mode = "lines+markers" if curve.is_low_row and len(t) <= 60 else "lines"
            style = {"mode": mode, "line": {"color": colors[name], "width": 1.5}, "marker": {"size": 4}}
            shown = {"name": name, "showlegend": name not in told, "legendgroup": name}
            traces.append({**_thinned(t, value), **style, **shown, **at})
            told.add(name)
        if curve.band_half_height is not None:
            shapes.append(_shade(number, (0, 1), (-curve.band_half_height, curve.band_half_height)))
        for begin, end in curve.marked_intervals:
            mark = _shade(number, (begin, end), (0, 1), along_time=True)
            shapes.append(mark | {"fillcolor": AFTER_COLOR, "opacity": 0.2})
        # beside a low row a turned title has no room, and collides with that of the next one
        titles.append(_axis_title(curve, top))
        top -= (height + _ROW_GAP) / inner
    axes[f"xaxis{last}"]["title"] = {"text": "time [s]"}
    figure = go.Figure(traces, {**axes, "shapes": shapes, "annotations": titles})
    margin = {"l": 54, "r": 12, "t": _TOP_MARGIN, "b": _BOTTOM_MARGIN}
    layout = _report_layout(inner + _TOP_MARGIN + _BOTTOM_MARGIN)
    legend = {**layout["legend"], "y": 1 + 22 / inner}
    figure.update_layout({**layout, "margin": margin, "legend": legend})
    return figure


def _shade(number: str, x: tuple[float, float], y: tuple[float, float], *, along_time: bool = False) -> dict[str, Any]:
    """A shaded rectangle of a row, over its whole width, or over its whole height where it is a time interval."""
    domain = (f"x{number}", f"y{number} domain") if along_time else (f"x{number} domain", f"y{number}")
    corners = {"x0": x[0], "x1": x[1], "y0": y[0], "y1": y[1]}
    return {"type": "rect", "xref": domain[0], "yref": domain[1], **corners, **_SHADE}


def _axis_title(curve: TimePlotData, y: float) -> dict[str, Any]:
    at = {"x": 0, "xref": "paper", "xanchor": "left", "y": y, "yref": "paper", "yanchor": "bottom"}
    return {"text": curve.axis_title, "showarrow": False, "font": {"size": 12}, **at}


def lines_over_time_figure(curve: TimePlotData) -> plotly.graph_objects.Figure:
    """Figure of the lines of one plot, each in its own color."""
    figure = styled_report_figure(320 + 8 * len(curve.lines), "time [s]", "")
    for i, (name, (t, value)) in enumerate(curve.lines.items()):
        dash = _LINE_DASHES[i // len(LINE_COLORS) % len(_LINE_DASHES)]
        style = {"color": line_color(i), "width": 1.5, "dash": dash}
        figure.add_scatter(**_thinned(t, value), mode="lines", name=name, line=style)
    if curve.band_half_height is not None:
        figure.add_shape(_shade("", (0, 1), (-curve.band_half_height, curve.band_half_height)))
    # the legend below takes as many rows as the screen is narrow
    below = {"orientation": "h", "y": -0.22, "yanchor": "top", "x": 0, "font": {"size": 11}}
    figure.update_layout(legend=below, margin={"t": 30})
    figure.add_annotation(_axis_title(curve, 1))
    return figure


def whitened_residual_histogram_figure(residuals: Mapping[str, Array]) -> plotly.graph_objects.Figure:
    """Histogram figure of whitened residuals per sensor group, with the standard normal density."""
    figure = styled_report_figure(340, "residual in standard deviations", "density")
    edge = max([4.0, *(float(np.quantile(np.abs(r), 0.995)) for r in residuals.values() if len(r))])
    for i, (name, values) in enumerate(residuals.items()):
        bins = np.linspace(-edge, edge, int(np.clip(2 * np.sqrt(len(values)), 8, 60)) + 1)
        density, _ = np.histogram(np.clip(values, -edge, edge), bins=bins, density=True)
        figure.add_scatter(
            x=(0.5 * (bins[1:] + bins[:-1])).tolist(), y=density.tolist(), mode="lines",
            line={"color": line_color(i), "shape": "hvh"}, name=f"{name} ({len(values)} values)",
        )  # fmt: skip
    even = np.linspace(-edge, edge, 121)
    normal = np.exp(-0.5 * even**2) / np.sqrt(2 * np.pi)
    line = {"color": TEXT_COLOR, "dash": "dot"}
    figure.add_scatter(x=even.tolist(), y=normal.tolist(), mode="lines", line=line, name="standard normal")
    return figure


def excess_cost_over_time_figure(
    costs: Mapping[str, tuple[Sequence[float], Sequence[float]]],
) -> plotly.graph_objects.Figure:
    """Figure of each method's relative excess cost over wall time, from (seconds, cost)."""
    figure = styled_report_figure(340, "wall time [s]", "cost over its lowest, less one", log_y=True)
    for i, (name, (seconds, cost)) in enumerate(costs.items()):
        known = [(s, c) for s, c in zip(seconds, cost, strict=True) if np.isfinite(c)]
        if known:
            figure.add_scatter(
                x=[s for s, _ in known], y=relative_excess_costs([c for _, c in known]),
                mode="lines+markers", name=name, line={"color": line_color(i)},
            )  # fmt: skip
    return figure


def relative_excess_costs(costs: Sequence[float]) -> list[float]:
    """Relative excess of costs over the lowest of them, cost / min(costs) - 1; at least 1e-9."""
    least = max(min(costs), 1e-300)
    return [max(cost / least - 1.0, 1e-9) for cost in costs]


def asymmetric_error_bars(values: Sequence[float], low: Sequence[float], high: Sequence[float]) -> dict[str, Any]:
    """Error bars of values from `low` to `high`."""
    above, below = np.maximum(np.subtract(high, values), 0.0), np.maximum(np.subtract(values, low), 0.0)
    return {"type": "data", "symmetric": False, "array": above.tolist(), "arrayminus": below.tolist()}


def rate_intervals_figure(
    curves: Mapping[str, Mapping[float, Mapping[str, float]]], x: str, y: str, is_calibration: bool
) -> plotly.graph_objects.Figure:
    """Figure of rates between 0 and 1 with intervals; each entry has `rate`, `low` and `high`.

    A calibration has its diagonal, all others a logarithmic axis.
    """
    figure = styled_report_figure(340, x, y)
    if is_calibration:
        line = {"color": MEASURED_COLOR, "dash": "dot"}
        figure.add_scatter(x=[0, 1], y=[0, 1], mode="lines", line=line, showlegend=False, hoverinfo="skip")
    else:
        figure.update_xaxes(type="log")
    for i, (name, known) in enumerate(curves.items()):
        rates, low, high = ([entry[key] for entry in known.values()] for key in ("rate", "low", "high"))
        figure.add_scatter(
            x=list(known), y=rates, mode="lines+markers", name=name, error_y=asymmetric_error_bars(rates, low, high),
            line={"color": line_color(i)},
        )  # fmt: skip
    figure.update_yaxes(range=[-0.03, 1.03])
    return figure


def profile_likelihood_figure(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]], level: float
) -> plotly.graph_objects.Figure:
    """Profile-likelihood figure: increase of chi2 over the parameter's value relative to the estimate."""
    figure = styled_report_figure(380, "value over best value", "chi2 above the best")
    for i, (name, (ratio, delta)) in enumerate(curves.items()):
        line = {"color": line_color(i), "dash": "solid" if i < len(LINE_COLORS) else "dash"}
        figure.add_scatter(x=list(ratio), y=list(delta), mode="lines+markers", name=name, line=line)
    figure.add_hline(y=level, line={"color": TEXT_COLOR, "dash": "dot"}, annotation_text="95 %")
    figure.update_xaxes(type="log", range=[-1.0, 1.0])
    figure.update_yaxes(range=[-0.2, 2.5 * level])
    return figure


def scatter_figure(clouds: Mapping[str, tuple[Array, Array]], x: str, y: str) -> plotly.graph_objects.Figure:
    """Figure of points (x, y) by name."""
    figure = styled_report_figure(340, x, y)
    for i, (name, (across, up)) in enumerate(clouds.items()):
        points = {"x": np.asarray(across, np.float32), "y": np.asarray(up, np.float32)}
        figure.add_scatter(**points, mode="markers", name=name, marker={"size": 3, "color": line_color(i)})
    return figure


def _thinned(t: Array, values: Array) -> dict[str, NDArray[np.floating]]:
    """At most `_MAX_CURVE_POINTS` of a curve, in single precision, which takes half the room in a page."""
    count = len(t)
    keep = np.unique(np.linspace(0, count - 1, min(count, _MAX_CURVE_POINTS)).astype(np.int64))
    is_late = count and np.nanmax(np.abs(t[keep])) > _MAX_SINGLE_PRECISION_TIME
    return {"x": np.asarray(t[keep], float if is_late else np.float32), "y": np.asarray(values[keep], np.float32)}
