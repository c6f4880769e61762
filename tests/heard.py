"""Progress that keeps what it is told."""

from yid_ocp.display import Progress


class Heard(Progress):
    def __init__(self) -> None:
        self.stages, self.parts, self.table = [], [], []

    def begin_stage(self, text, work=0.0, ahead=None):
        self.stages.append(text)

    def report_parts_done(self, done, total, text):
        self.parts.append((done, total, text))

    def renew_results_table(self, rows):
        self.table = rows
