from __future__ import annotations

import math
from pathlib import Path
from pkgutil import iter_modules

import numpy as np
import pytest
from recording_examples import joints_of, table

from yid_ocp.data import readers
from yid_ocp.data.readers import READERS, read_any
from yid_ocp.data.recording import JointGroup, Recording, validate_recording
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import DataError

SHARED = Path(__file__).parents[2].parent / "shared" / "recordings"


# ------------------------------------------------------------------------------------------------------- any format


def test_read_any_chooses_by_suffix(tmp_path: Path) -> None:
    recording = read_any(table(tmp_path, "t,q_a\n0,1\n", "RUN.CSV"), units={"position": "deg"})
    assert joints_of(recording).position[0, 0] == pytest.approx(math.pi / 180)
    write_recording(recording, tmp_path / "run.h5")
    assert joints_of(read_any(tmp_path / "run.h5", allow_nan_effort=True)).names == ("a",)


def test_read_any_refuses_what_it_does_not_know(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no reader for '\.csvv'") as caught:
        read_any(tmp_path / "run.csvv")
    assert caught.value.hint == "did you mean '.csv'?"
    assert ".mcap" in caught.value.allowed
    with pytest.raises(DataError, match="no option 'unit'") as caught:
        read_any(table(tmp_path, "t,q_a\n0,1\n"), unit={})
    assert caught.value.hint == "did you mean 'units'?"


def test_every_file_of_the_folder_registers_a_format() -> None:
    files = {entry.name for entry in iter_modules(readers.__path__)} - {"base"}
    registered = {READERS[name].__module__.rpartition(".")[2] for name in READERS}
    assert files == registered - {"recording_hdf5"}


def test_a_new_reader_is_one_registration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(READERS, "_entries", dict(READERS._entries))

    @READERS.register(".one")
    def read_one(path: Path, *, value: float = 1.0) -> Recording:
        return validate_recording(Recording(JointGroup(("a",), np.zeros(1), np.full((1, 1), value)), name=path.stem))

    assert joints_of(read_any(tmp_path / "run.one", value=2.0)).position[0, 0] == 2.0


@pytest.mark.skipif(
    not (SHARED / "deft").is_dir(), reason="the real recordings are not here (shared/recordings beside the project)"
)
def test_a_real_table_that_is_no_recording_is_refused() -> None:
    with pytest.raises(DataError, match="meaning of column 'point'"):
        read_any(SHARED / "deft" / "bdlo1_undeformed.csv")
