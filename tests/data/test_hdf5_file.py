"""HDF5 files: whole or not there, and read only where reading them does no harm."""

from __future__ import annotations

import os
import signal

import h5py
import numpy as np
import pytest

from yid_ocp.data import recording_hdf5
from yid_ocp.data.recording_hdf5 import create_hdf5_atomically, open_checked_hdf5
from yid_ocp.errors import DataError, OutputError

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="files are tried in forks")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "file.h5"
    with create_hdf5_atomically(path) as new:
        new.attrs["format"] = "test"
        new.create_dataset("a/values", data=np.arange(3.0))
    return path


def test_what_was_written_is_read(file):
    with open_checked_hdf5(file) as data:
        assert data.attrs["format"] == "test"
        np.testing.assert_array_equal(data["a/values"], [0.0, 1.0, 2.0])
    assert [path.name for path in file.parent.iterdir()] == ["file.h5"]


def test_a_block_that_fails_leaves_the_old_file(file):
    before = file.read_bytes()
    with pytest.raises(TypeError), create_hdf5_atomically(file) as new:
        new.create_dataset("b", data=object())
    assert file.read_bytes() == before


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device without room")
def test_a_full_disk_is_an_error_and_not_the_end(tmp_path, monkeypatch):
    """The library would write when it closes the file, and end the process when it cannot."""
    monkeypatch.setattr("yid_ocp.files.secrets.token_hex", lambda _: "x")
    (tmp_path / ".full.h5.x.tmp").symlink_to("/dev/full")
    with pytest.raises(OutputError, match="No space left"), create_hdf5_atomically(tmp_path / "full.h5") as new:
        new.create_dataset("a", data=np.zeros(1000))
    assert not (tmp_path / "full.h5").exists()


@needs_fork
@pytest.mark.parametrize("kind", ["external link", "external values", "virtual"])
def test_other_files_are_not_read(file, tmp_path, kind):
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as new, h5py.File(file, "a") as data:
        new.create_dataset("secret", data=[1.0])
        if kind == "external link":
            data["a/more"] = h5py.ExternalLink("other.h5", "secret")
        elif kind == "external values":
            data["a"].create_dataset("more", (1,), "f8", external=[(str(other), 0, 8)])
        else:
            layout = h5py.VirtualLayout((1,), "f8")
            layout[:] = h5py.VirtualSource(other, "secret", (1,))
            data["a"].create_virtual_dataset("more", layout)
    with pytest.raises(DataError, match=r"'more'.*another file"), open_checked_hdf5(file):
        pass


@needs_fork
def test_groups_without_end_are_refused(file):
    with h5py.File(file, "a") as data:
        data["a/self"] = data["a"]
    with pytest.raises(DataError, match="stand in one another"), open_checked_hdf5(file):
        pass


@needs_fork
def test_a_small_file_that_unpacks_to_more_than_fits_is_refused(tmp_path):
    """Its bytes are few and its numbers of one byte each; as float64 with copies they are 27 GB."""
    with h5py.File(tmp_path / "bomb.h5", "w") as data:
        data.create_dataset("joints/position", (120_000_000, 7), "i1", chunks=(1 << 20, 7), compression="gzip")
    assert (tmp_path / "bomb.h5").stat().st_size < 100_000
    with pytest.raises(DataError, match="declares 840 million numbers"), open_checked_hdf5(tmp_path / "bomb.h5"):
        pass


@needs_fork
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="no /proc")
def test_the_trial_has_a_limit_on_its_memory(file):
    def greedy(path):
        return f"took {len(bytearray(4 << 30))} bytes"

    with pytest.raises(DataError, match="ends the HDF5 library") as caught:
        recording_hdf5.check_readable_in_fork(file, greedy, "HDF5")
    assert "took" not in caught.value.what


@needs_fork
def test_what_is_declared_but_not_there_is_refused(file):
    with h5py.File(file, "a") as data:
        data.create_dataset("huge", (10**9,), "f8", chunks=(1000,))
    with pytest.raises(DataError, match="declares 1000 million numbers"), open_checked_hdf5(file):
        pass


@needs_fork
def test_a_file_that_ends_the_library_does_not_end_us(file, monkeypatch):
    monkeypatch.setattr(recording_hdf5, "_foreign", lambda group: os.kill(os.getpid(), signal.SIGSEGV))
    with pytest.raises(DataError, match="SIGSEGV"), open_checked_hdf5(file):
        pass


@needs_fork
def test_a_file_that_never_ends_is_given_up(file, monkeypatch):
    monkeypatch.setattr(recording_hdf5, "_READ_TIMEOUT", 0.3)
    monkeypatch.setattr(recording_hdf5, "_foreign", lambda group: signal.pause())
    with pytest.raises(DataError, match=r"within 0\.3 s"), open_checked_hdf5(file):
        pass
