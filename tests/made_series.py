"""Outputs and samples, as far as rules that look at residuals need them."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from yid_ocp.data.recording import Recording
from yid_ocp.inference.null_test import OutputResidualIndices

WHITE = (1.0,)


def series(rows, t=None, recording="run", channel="points.tip", colour=WHITE, period=0.01) -> OutputResidualIndices:
    """One output of one recording; times at even intervals unless given."""
    rows = np.asarray(rows)
    t = period * np.arange(len(rows)) if t is None else np.asarray(t, float)
    return OutputResidualIndices(recording, channel, "points", t, rows, np.asarray(colour, float))


def without(recording: Recording, begin: float, end: float) -> Recording:
    """A recording whose joints lost the samples of some time [s]."""
    rows = (recording.joints.t < begin) | (recording.joints.t > end)
    left = {name: values[rows] for name, values in recording.joints.values_by_channel.items()}
    return replace(recording, joints=replace(recording.joints, t=recording.joints.t[rows], **left))


def samples(channels: Sequence[str], std, unit="m", width=1, **more):
    """What one sensor measured, as far as rules look at it."""
    columns = tuple(channel for channel in channels for _ in range(width))
    own = {"channel_name_per_output": columns, "smoothing_filter": None, **more}
    return SimpleNamespace(sensor=seeing(channels, unit, width), std=np.asarray(std, float), **own)


def seeing(channels: Sequence[str], unit="m", width=1, efforts=()):
    """A sensor, as far as rules look at it."""
    return SimpleNamespace(
        channel_names=tuple(channels), unit=unit, outputs_per_channel=width, group_name="points",
        effort_joints=tuple(efforts),
    )  # fmt: skip
