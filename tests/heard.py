"""Progress that keeps what it is told."""

from __future__ import annotations


class Heard:
    """See `yid_ocp.progress_display.Progress`."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.iterates: list[object] = []
        self.parts: list[tuple[int, int, str]] = []

    def stage(self, text):
        self.stages.append(text)

    def iterate(self, entry):
        self.iterates.append(entry)

    def advance(self, done, total, text):
        self.parts.append((done, total, text))
