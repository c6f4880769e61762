"""Export of recordings as CSV tables."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import numpy as np

from yid_ocp.data import JointGroup, Recording
from yid_ocp.errors import OutputError
from yid_ocp.files import atomic_write

_AXES = ("x", "y", "z")


def export_csv(recording: Recording, folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Write one table per group, `<group>.csv`, with the columns that `read_csv` knows and all digits.

    Standard deviations, the kind of effort, sensor, frame, pose and clock are not in the tables; a point not seen is an
    empty cell.

    Parameters
    ----------
    recording : Recording
        What to write, in SI units.
    folder : path-like
        Target folder, created if absent.

    Returns
    -------
    tuple of Path
        The files written, joints first.

    Raises
    ------
    OutputError
        If the folder or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made ({error.strerror})", where=str(folder)) from error
    written = []
    for group in recording.groups:
        if isinstance(group, JointGroup):
            stem, columns = "joints", [f"{channel}_{name}" for channel in group.channels for name in group.names]
            table = np.column_stack([group.t, *group.channels.values()])
        else:
            stem, columns = group.name, [f"{name}_{axis}" for name in group.names for axis in _AXES]
            table = np.column_stack([group.t, group.position.reshape(len(group.t), -1)])
        written.append(folder / f"{stem}.csv")
        with atomic_write(written[-1]) as temporary, temporary.open("x", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["t", *columns])
            writer.writerows([["" if math.isnan(value) else repr(value) for value in row] for row in table.tolist()])
    return tuple(written)
