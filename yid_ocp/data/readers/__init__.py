"""Recordings of any known format; a new format is one file in this folder with one registration."""

from __future__ import annotations

import inspect
import os
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from yid_ocp.data.hdf5 import read_recording
from yid_ocp.data.readers.base import READERS as READERS
from yid_ocp.data.recording import Recording
from yid_ocp.errors import DataError, nearest

for _suffix in (".h5", ".hdf5"):
    READERS.register(_suffix)(read_recording)
# every file of this folder registers its formats when it is imported
for _format in iter_modules(__path__):
    import_module(f"{__name__}.{_format.name}")


def read_any(path: str | os.PathLike[str], **options: Any) -> Recording:
    """Read a recording of any known format, chosen by its suffix.

    Parameters
    ----------
    path : path-like
        An HDF5 recording, a CSV file, a rosbag, an MCAP file or a ROS 2 bag folder.
    **options
        Named options of the reader in `READERS`.

    Returns
    -------
    Recording
        The checked recording.

    Raises
    ------
    DataError
        If the format or an option is not known, or the reader refuses the file.
    """
    path = Path(path)
    suffix = "folder" if path.is_dir() else path.suffix.lower()
    if suffix not in READERS:
        raise DataError(
            f"there is no reader for '{suffix}' files",
            where=str(path),
            allowed=", ".join(READERS),
            hint=nearest(suffix, READERS),
        )
    reader = READERS[suffix]
    known = [name for name in inspect.signature(reader).parameters if name != "path"]
    for name in options:
        if name not in known:
            raise DataError(
                f"the reader of '{suffix}' files has no option '{name}'",
                where=str(path),
                allowed=", ".join(known),
                hint=nearest(name, known),
            )
    return reader(path, **options)
