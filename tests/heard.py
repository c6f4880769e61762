"""Progress that keeps what it is told."""

from __future__ import annotations


class Heard:
    """See `yid_ocp.progress.Progress`."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.iterates: list[object] = []
        self.parts: list[tuple[int, int, str]] = []

    def begin_stage(self, text):
        self.stages.append(text)

    def report_iterate(self, entry):
        self.iterates.append(entry)

    def report_parts_done(self, done, total, text):
        self.parts.append((done, total, text))
