"""Bags of ROS 1 and ROS 2, and MCAP files, written by the tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

SECOND = 10**9
START = 1_700_000_000 * SECOND
BAG_KINDS = ("bag", "mcap", "mcap folder", "db3", "db3 folder")


class Bag:
    """A bag in the making, of one of `BAG_KINDS`; the bytes of what it holds may be in the other order."""

    def __init__(self, folder: Path, kind: str, big: bool = False) -> None:
        pytest.importorskip("rosbags", reason="bags need rosbags: pip install '.[bags]'")
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore

        self.ros1, self.big, self.connections, self.log = kind == "bag", big, dict[tuple[str, str], Any](), START
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        place = folder / ("run.bag" if self.ros1 else "run")
        self.path = place / f"run.{kind}" if kind in ("mcap", "db3") else place
        plugin = rosbag2.StoragePlugin.MCAP if kind.startswith("mcap") else rosbag2.StoragePlugin.SQLITE3
        self.writer: Any = (
            rosbag1.Writer(place) if self.ros1 else rosbag2.Writer(place, version=9, storage_plugin=plugin)
        )

    def __enter__(self) -> Bag:
        self.writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.writer.close()

    def of(self, kind: str, *values: Any, **fields: Any) -> Any:
        """A message of a type."""
        return self.store.types[kind](*values, **fields)

    def header(self, stamp: int, frame: str = "camera") -> Any:
        """A header with a stamp [ns]."""
        time = self.of("builtin_interfaces/msg/Time", *divmod(stamp, SECOND))
        return self.of("std_msgs/msg/Header", *((0,) if self.ros1 else ()), stamp=time, frame_id=frame)

    def put(self, topic: str, kind: str, logged: int | None = None, **fields: Any) -> None:
        """Write a message, recorded at a time [ns], a millisecond after the one before where there is none."""
        if (topic, kind) not in self.connections:
            self.connections[topic, kind] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.log = self.log + 10**6 if logged is None else logged
        self.writer.write(self.connections[topic, kind], self.log, bytes(pack(self.of(kind, **fields), kind)))
