"""Store of finished refits, kept beside the run folder so that an interrupted diagnosis can resume."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import threading
from collections.abc import Mapping

from yid_ocp.diagnosis import StoredFit
from yid_ocp.errors import OutputError
from yid_ocp.files import json_sha256, write_json
from yid_ocp.workflow.run_folder import RunFolder

_STORE_FORMAT = "yid-refits/1"
log = logging.getLogger(__name__)


class JsonRefitStore:
    """A store of refits in one JSON file: {format, key, refits: {name: {values, std, message}}}.

    The file is replaced as a whole after every refit. One that was made from other inputs, by another configuration or
    by another version is skipped with a notice.

    Refits run in threads, not as tasks of `yid_ocp.parallel`: all of one diagnosis share a compiled step and what was
    worked out from the recordings, and a refit takes less time than to build these in another process.
    """

    def __init__(self, folder: RunFolder, *made_from: Mapping[str, str] | str) -> None:
        self.file = folder.resume_folder / "refits.json"
        self._folder = folder
        self._key = json_sha256(made_from)
        self._lock = threading.Lock()
        self._warned = False
        self._known = self._read()

    def __len__(self) -> int:
        return len(self._known)

    def get(self, name: str) -> StoredFit | None:
        """The stored refit of that name, or None; a reused refit is logged."""
        found = self._known.get(name)
        if found is not None:
            self._folder.log_event("resumed", refit=name)
        return found

    def put(self, name: str, refitted: StoredFit) -> None:
        """Store a refit and rewrite the file."""
        with self._lock:
            self._known[name] = refitted
            refits = {
                key: {
                    "values": _texts(fit.values),
                    "std": _texts(fit.std),
                    "amplitude_std": _texts(fit.amplitude_std),
                    "message": fit.solver_message,
                }
                for key, fit in self._known.items()
            }
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                write_json(self.file, {"format": _STORE_FORMAT, "key": self._key, "refits": refits})
            except (OSError, OutputError) as error:
                if not self._warned:
                    log.warning("finished refits cannot be kept (%s); the diagnosis goes on without", error)
                self._warned = True

    def delete_file(self) -> None:
        """Delete the file, its temporary copies and its folder if empty."""
        with contextlib.suppress(OSError):
            for file in self.file.parent.glob(f"*{self.file.name}*"):
                file.unlink()
            self.file.parent.rmdir()

    def _read(self) -> dict[str, StoredFit]:
        try:
            held = json.loads(self.file.read_text(encoding="utf-8"))
            if (held["format"], held["key"]) == (_STORE_FORMAT, self._key):
                return {
                    name: StoredFit(
                        _numbers(fit["values"]),
                        _numbers(fit["std"]),
                        _numbers(fit["amplitude_std"]),
                        str(fit["message"]),
                    )
                    for name, fit in held["refits"].items()
                }
            reason = "other inputs, another configuration or another version"
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            reason = "something that cannot be read"
        log.warning("the refits in %s are from %s and are not resumed", self.file, reason)
        return {}


def _texts(values: Mapping[str, float]) -> dict[str, float | str]:
    """JSON has no infinities: what is not finite is kept as text."""
    return {name: value if math.isfinite(value) else str(value) for name, value in values.items()}


def _numbers(values: Mapping[str, float | str]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}
