"""Reader of markers in C3D files of motion capture (Vicon, Qualisys, OptiTrack), as points."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain, count, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.data.readers import base
from yid_ocp.data.recording import PointGroup, Recording, raise_data_error_unless
from yid_ocp.data.recording_hdf5 import check_readable_in_child_process
from yid_ocp.errors import DataError, import_optional
from yid_ocp.files import file_sha256

_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Lists in the parameter group POINT whose labels are results of a body model instead of positions."""
_LENGTH_UNITS = ("m", "cm", "mm")


@base.READERS.register(".c3d")
def _read_c3d(
    path: str | os.PathLike[str],
    *,
    point_names: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    point_sensor_name: str = "motion capture",
    point_frame: str = "world",
    description: str = "",
) -> Recording:
    """Read the markers of a C3D file as one point group `points`.

    C3D has no time stamps: the times are frame index / rate from zero, a `nominal` clock. The file states rate and
    unit; `units` overrides the unit. A marker that was not seen in a frame (residual -1, NaN, or exactly the origin) is
    NaN. A subject prefix of a name (`Subject:tip`) is removed if the rest is unique. `notes` lists omitted content.
    Raises `DataError` without `ezc3d`, for an unreadable file, without markers, or `validated_recording` refuses it.
    """
    path = Path(path)
    digest = file_sha256(path)
    seen, unit, others = _markers(path)
    own = {"points": unit} if unit else {}
    group = replace(seen, sensor_name=point_sensor_name, frame=point_frame)
    notes = tuple(f"{entry.name} was left out ({entry.note})" for entry in others)
    raw = Recording(None, (group,), description, path.name, path.stem, digest, notes=notes)
    options = base.JointPointAndUnitOptions(point_names=point_names, units={**own, **(units or {})})
    return base.convert_to_si_and_validate(raw, str(path), options)


@base.FILE_PREVIEWERS.register(".c3d")
def _preview_c3d(path: str | os.PathLike[str]) -> base.FilePreview:
    path = Path(path)
    group, unit, others = _markers(path)
    rate = 1.0 / float(group.t[1] - group.t[0]) if len(group.t) > 1 else math.nan
    sources = []
    for i, name in enumerate(group.names):
        seen = np.isfinite(group.position[:, i]).all(axis=1)
        note = "" if seen.all() else f"seen in {seen.mean():.0%} of the frames"
        sources.append(base.TopicOrColumnSummary(name, "marker", int(seen.sum()), rate, f"point {name}", note))
    notes = [f"the file states the unit {unit}" if unit else "no unit is stated; for mm, add --units mm"]
    return base.FilePreview((*sources, *others), {"point_names": {n: n for n in group.names}}, tuple(notes))


def _markers(path: Path) -> tuple[PointGroup, str, tuple[base.TopicOrColumnSummary, ...]]:
    """Return the markers of a file in its own unit (NaN if unseen), this unit, and other content."""
    ezc3d = import_optional("ezc3d", "c3d", "reading C3D files needs the package ezc3d")
    check_readable_in_child_process(path, _complaint, "C3D")
    try:
        file = ezc3d.c3d(str(path))
        parameters = file["parameters"]
        labels = _listed(parameters["POINT"], "LABELS")
        position: Array = np.array(file["data"]["points"][:3].transpose(2, 1, 0), float)
        residuals = np.array(file["data"]["meta_points"]["residuals"][0].T, float)
        rate = float(np.ravel(parameters["POINT"]["RATE"]["value"])[0])
        unit = str(next(iter(parameters["POINT"].get("UNITS", {}).get("value", [])), "")).strip().lower()
        analog = [label for label in _listed(parameters.get("ANALOG", {}), "LABELS") if label]
        computed = {label for key in _COMPUTED for label in _listed(parameters["POINT"], key) if label}
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise _unreadable(path) from error
    what = f"the C3D file has {len(position)} frames at {rate:g} Hz, and {len(labels)} labelled markers"
    allowed, hint = "all three above 0", "label the markers, and export their trajectories again"
    raise_data_error_unless(rate > 0 and len(position) and labels, what, str(path), allowed, hint)
    what, known = f"the unit of the markers is '{unit}', which is unknown", ", ".join(_LENGTH_UNITS)
    raise_data_error_unless(unit in ("", *_LENGTH_UNITS), what, str(path), known, "export the file again in mm")
    position = position[:, : len(labels)]
    unseen = (residuals[:, : len(labels)] < 0) | (position == 0).all(axis=2) | ~np.isfinite(position).all(axis=2)
    position[unseen] = np.nan
    why = {}
    for i, label in enumerate(labels):
        unlabelled = not label or label.startswith("*")
        reason = "result of a body model" if label in computed else "without label" if unlabelled else ""
        if reason or unseen[:, i].all():
            why[i] = reason or "never seen"
    kept = [i for i in range(len(labels)) if i not in why]
    what = "the C3D file has no usable marker: " + ", ".join(f"{n} {r}" for r, n in Counter(why.values()).items())
    raise_data_error_unless(kept, what, str(path), "labelled 3-D points", "label the markers, and export again")
    others = []
    for i, reason in why.items():
        name, count = labels[i] or f"marker {i + 1}", int(np.sum(~unseen[:, i]))
        others.append(base.TopicOrColumnSummary(name, "marker", count, rate, "", reason))
    others += [base.TopicOrColumnSummary(name, "analog", 0, math.nan, "", "an analog channel") for name in analog]
    names, t = _short([labels[i] for i in kept]), np.arange(len(position)) / rate
    return PointGroup("points", names, t, position[:, kept], clock="nominal"), unit, tuple(others)


def _complaint(path: Path) -> str:
    """Description of the error that ezc3d raises for a file; empty if it reads the file. ezc3d may also crash."""
    import ezc3d

    try:
        ezc3d.c3d(str(path))
    except Exception:  # whatever stands in the way
        return _unreadable(path).what
    return ""


def _unreadable(path: Path) -> DataError:
    why = "it is damaged, cut off or of another format" if path.stat().st_size else "it is empty (0 bytes)"
    allowed, hint = "a C3D file that Vicon, Qualisys or OptiTrack exported", "copy the file again, or export it again"
    return DataError(f"the C3D file cannot be read, because {why}", where=str(path), allowed=allowed, hint=hint)


def _listed(group: Mapping[str, Any], key: str) -> list[str]:
    """A list of a parameter group with its continuations (`LABELS2` and so on) beyond 255 entries."""
    names = takewhile(group.__contains__, chain([key], (f"{key}{number}" for number in count(2))))
    return [str(label).strip() for name in names for label in group[name]["value"]]


def _short(labels: list[str]) -> tuple[str, ...]:
    """Labels without the prefix `Subject:` where the rest is unique."""
    last = [label.rpartition(":")[2] for label in labels]
    counts = Counter(last)
    return tuple(short if short and counts[short] == 1 else label for label, short in zip(labels, last, strict=True))
