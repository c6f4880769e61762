"""PLY files of every kind are read, and damaged ones refused in words."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from yid_ocp.errors import DataError
from yid_ocp.vision import FrameSequence, read_frames, write_frame_folder

CLOUD = np.random.default_rng(0).normal(size=(7, 3))
COLUMNS = [("red", "u1"), ("x", "f4"), ("nx", "f8"), ("y", "f4"), ("z", "f4")]
NAMES = {"u1": "uchar", "f4": "float", "f8": "double", "i2": "short"}


def head(form: str, count: object = 7, before: str = "") -> bytes:
    rows = "".join(f"property {NAMES[kind]} {name}\n" for name, kind in COLUMNS)
    return f"ply\nformat {form} 1.0\ncomment made\n{before}element vertex {count}\n{rows}end_header\n".encode()


def body(order: str) -> bytes:
    rows = np.zeros(7, [(name, order + kind) for name, kind in COLUMNS])
    for axis, column in zip("xyz", CLOUD.T, strict=True):
        rows[axis] = column
    return rows.tobytes()


TEXT = "".join(f"255 {x:.9g} 0.5 {y:.9g} {z:.9g}\n" for x, y, z in CLOUD).encode()
FACES = b"element face 1\nproperty list uchar int vertex_indices\n"
CAMERA = "element camera 2\nproperty short view\n"
SOUND = {
    "little": head("binary_little_endian") + body("<"),
    "big": head("binary_big_endian") + body(">"),
    "text": head("ascii") + TEXT,
    "text without a last newline": head("ascii") + TEXT[:-1],
    "windows": (head("ascii") + TEXT).replace(b"\n", b"\r\n"),
    "another element before": head("binary_little_endian", before=CAMERA) + b"\x01\x00\x02\x00" + body("<"),
    "the same as text": head("ascii", before=CAMERA) + b"1\n2\n" + TEXT,
    "a comment longer than any buffer": (head("ascii") + TEXT).replace(b"made", b"made" + b"9" * 5000),
    "faces after": head("ascii").replace(b"end_header", FACES + b"end_header") + TEXT + b"3 0 1 2\n",
}


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """The points of a file with some bytes."""
    folder = tmp_path_factory.mktemp("frames")
    write_frame_folder(FrameSequence.from_clouds([0.0], [CLOUD], np.eye(4)), folder)
    sequence = read_frames(folder)

    def points(data):
        (folder / sequence.frame_names[0]).write_bytes(data)
        return sequence.load_cloud(0)

    return points


@pytest.mark.parametrize("kind", SOUND)
def test_points_are_read(read, kind):
    assert np.allclose(read(SOUND[kind]), CLOUD, atol=1e-6)


WRONG = {
    "no ply": (b"plx\n", "has no head"),
    "no end": (head("ascii")[:-12], "has no head"),
    "no format": (head("ascii").replace(b"format ascii 1.0\n", b"") + TEXT, "does not say the format"),
    "another format": (head("ascii").replace(b"ascii", b"utf") + TEXT, "head says 'format utf 1.0'"),
    "another type": (head("ascii").replace(b"float", b"flaot", 1) + TEXT, "head says 'property flaot x'"),
    "no z": (head("ascii").replace(b"float z", b"float w") + TEXT, "no x, y and z"),
    "two of a name": (head("ascii").replace(b"double nx", b"double x") + TEXT, "no x, y and z"),
    "lists before": (head("ascii", before=FACES.decode()) + TEXT, "lists of 'face'"),
    "too many": (head("binary_little_endian", 3_000_000_000) + body("<"), r"declares 3e\+09 points"),
    "negative": (head("ascii", -1) + TEXT, "element vertex -1"),
    "none": (head("ascii", 0), "has no vertices"),
    "cut": (SOUND["little"][:-5], "declares 7 points"),
    "cut by one byte": (SOUND["little"][:-1], "declares 7 points"),
    "cut text": (head("ascii") + TEXT[:90], "a vertex is not|vertices are missing|declares"),
    "words": (head("ascii") + TEXT.replace(b"0.5", b"0.5 one", 1), "a vertex is not"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_damage_is_said(read, kind):
    data, message = WRONG[kind]
    with pytest.raises(DataError, match=message):
        read(data)


def test_whatever_is_damaged_is_read_or_refused(read):
    rng = np.random.default_rng(1)
    for data in SOUND.values():
        for _ in range(100):
            made = bytearray(data)
            for at in rng.integers(len(made), size=3):
                made[at] = int(rng.integers(256))
            with contextlib.suppress(DataError):
                assert read(bytes(made)).shape[1] == 3
