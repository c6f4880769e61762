"""Export of measured, predicted and residual signals of a run as MCAP."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.hdf5_io import open_checked_hdf5
from yid_ocp.errors import DataError
from yid_ocp.export.mcap import TopicSignal, export_mcap
from yid_ocp.workflow.baseline_runs import read_run_result
from yid_ocp.workflow.trajectories import DIAGNOSIS_TRAJECTORIES_FORMAT, SOLVE_TRAJECTORIES_FORMAT

Array = NDArray[np.float64]
_PREDICTION_TOPICS: Mapping[str, Mapping[str, str]] = {
    SOLVE_TRAJECTORIES_FORMAT: {"predicted": "predicted"},
    DIAGNOSIS_TRAJECTORIES_FORMAT: {"before": "nominal", "after": "with_effects"},
}
"""Arrays of a sensor's group, and the first part of the topics that tell them."""
_RESERVED_GROUPS = ("where", "events", "unknowns", "recordings")


def export_run_signals(folder: str | Path, out: str | Path) -> tuple[list[Path], list[str]]:
    """Write `OUT/RECORDING.mcap` for every recording of a run.

    Topics: `/measured/...`, `/predicted/...` (of a diagnosis `/nominal/...` and `/with_effects/...`) and
    `/residual/...`, predicted minus measured, with `joints/QUANTITY` or `points/GROUP/POINT` behind; the whole
    configuration as `/predicted/joint_states`, what moves it as `/predicted/driven_efforts` (of servos as
    `/predicted/commands`) and `/predicted/prescribed_efforts`. Of a diagnosis also `/unknown/joint_states` (forces),
    `/unknown/push/SEGMENT`, `/unknown/offset/GRASP`, `/unknown/bias/POINT` and `/events/CHANNEL`.

    Parameters
    ----------
    folder : str or Path
        Run folder of `solve` or `diagnose`.
    out : str or Path
        Folder to write to.

    Raises
    ------
    ConfigError, DataError, OutputError
    """
    folder, out = Path(folder), Path(out)
    read_run_result(folder)
    files, notes = [], []
    with open_checked_hdf5(folder / "trajectories.h5") as file:
        form = str(file.attrs.get("format", ""))
        if form not in _PREDICTION_TOPICS:
            what = f"the trajectories are of format '{form}'"
            raise DataError(
                what, where=str(folder / "trajectories.h5"), allowed=", ".join(_PREDICTION_TOPICS), hint="run it again"
            )
        for name, signals in _recordings(file, form).items():
            files.append(out / f"{name}.mcap")
            shift = export_mcap(signals, files[-1])
            if shift:
                notes.append(f"{files[-1].name}: {shift:g} s were added to all times, as stamps cannot be negative")
    return files, notes


def _recordings(file: h5py.File, form: str) -> dict[str, list[TopicSignal]]:
    """Signals by recording, those that have any."""
    parent = file.get("recordings", {}) if form == SOLVE_TRAJECTORIES_FORMAT else file
    found: dict[str, list[TopicSignal]] = {}
    for name in parent:
        if form == SOLVE_TRAJECTORIES_FORMAT or name not in _RESERVED_GROUPS:
            found.setdefault(name, []).extend(_of_recording(parent[name], _PREDICTION_TOPICS[form]))
    for name, group in file.get("where", {}).items():
        found.setdefault(name, []).extend(_unknown(group))
    for name, channels in file.get("events", {}).items():
        for channel, group in channels.items():
            values = {"effort": np.array(group["value"])[:, None]}
            signal = TopicSignal(f"/events/{_topic(channel)}", "joints", np.array(group["t"]), values, (channel,))
            found.setdefault(name, []).append(signal)
    return {name: signals for name, signals in found.items() if any(len(signal.t) for signal in signals)}


def _of_recording(group: h5py.Group, predictions: Mapping[str, str]) -> Iterator[TopicSignal]:
    if "q" in group:
        joints, t = _texts(group.attrs["joints"]), np.array(group["t"])
        yield TopicSignal("/predicted/joint_states", "joints", t, {"position": np.array(group["q"])}, joints)
        if "command" in group:
            values = {"position": np.array(group["command"])}
            yield TopicSignal("/predicted/commands", "joints", t[:-1], values, _texts(group.attrs["driven"]))
        for key, names in (("torque", "driven"), ("effort", "prescribed")):
            if key in group and len(group.attrs[names]):
                values = {"effort": np.array(group[key])}
                yield TopicSignal(f"/predicted/{names}_efforts", "joints", t[:-1], values, _texts(group.attrs[names]))
    for sensor in group.values():
        if not isinstance(sensor, h5py.Group):
            continue
        measured = np.array(sensor["measured"])
        yield from _of_sensor(sensor, "measured", measured)
        for key, words in predictions.items():
            predicted = np.array(sensor[key])
            residual = "residual" if len(predictions) == 1 else f"residual/{words}"
            yield from _of_sensor(sensor, words, predicted)
            yield from _of_sensor(sensor, residual, predicted - measured)


def _of_sensor(sensor: h5py.Group, begin: str, values: Array) -> Iterator[TopicSignal]:
    """Joints of a group as one topic, points as one each; differences of places are vectors."""
    channels, t = _texts(sensor.attrs["channels"]), np.array(sensor["t"])
    if values.shape[1] == len(channels):
        quantity = channels[0].split(".")[1]
        names = [channel.rsplit(".", 1)[1] for channel in channels]
        yield TopicSignal(f"/{begin}/joints/{quantity}", "joints", t, {quantity: values}, names)
        return
    for i, channel in enumerate(channels):
        kind: Any = "vector" if begin.startswith("residual") else "point"
        yield TopicSignal(f"/{begin}/points/{_topic(channel)}", kind, t, {"xyz": values[:, 3 * i : 3 * i + 3]})


def _unknown(group: h5py.Group) -> Iterator[TopicSignal]:
    """Unknown forces, pushes, offsets and biases, where each interval begins and where the last one ends."""
    edges = np.array(group["edges"]) + float(group.attrs.get("start", 0.0))
    mean = np.array(group["mean"])
    if not len(mean):
        return
    held = np.vstack([mean, mean[-1:]])
    names, kinds = _texts(group.attrs["unknowns"]), _texts(group.attrs["kinds"])
    kept = np.array(group["prior"]) > 0
    forces = [i for i, kind in enumerate(kinds) if kind == "force" and kept[i]]
    if forces:
        told = [names[i] for i in forces]
        yield TopicSignal("/unknown/joint_states", "joints", edges, {"effort": held[:, forces]}, told)
    shapes: Mapping[str, tuple[str, Any]] = {
        "push": ("push", "wrench"), "offset": ("offset", "vector"), "bias": ("bias", "vector")
    }  # fmt: skip
    for kind, (words, form) in shapes.items():
        for owner, columns in _triples(names, kinds, kind).items():
            if kept[[i for i in columns if i is not None]].any():
                xyz = np.stack([np.zeros(len(edges)) if i is None else held[:, i] for i in columns], axis=1)
                yield TopicSignal(f"/unknown/{words}/{_topic(owner)}", form, edges, {"xyz": xyz})


def _triples(names: Sequence[str], kinds: Sequence[str], kind: str) -> dict[str, list[int | None]]:
    """Columns of x, y and z by owner: `left.x`, `T1.push_y`; None where one has no unknown."""
    found: dict[str, list[int | None]] = {}
    for i, name in enumerate(names):
        owner, axis = name[:-2].removesuffix(".push"), name[-1]
        if kinds[i] == kind and axis in "xyz":
            found.setdefault(owner, [None, None, None])["xyz".index(axis)] = i
    return found


def _topic(name: str) -> str:
    """A name as parts of a topic, whose letters are few."""
    return "".join(c if c.isalnum() or c in "_/" else "_" for c in name.replace(".", "/"))


def _texts(values: Any) -> list[str]:
    return [value.decode() if isinstance(value, bytes) else str(value) for value in values]
