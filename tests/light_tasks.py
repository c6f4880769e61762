"""Tasks for workers of a cluster, in a file that they import in no time."""

import os
import time
from pathlib import Path


def squared(number: int, marks: str) -> int:
    """A square; files say which process began it, and when it ended."""
    begun = Path(marks) / f"{number}.{os.getpid()}.begun"
    begun.write_text("")
    time.sleep(0.15)
    begun.with_suffix(".ended").write_text("")
    return number**2


def deadly(number: int) -> int:
    """The number itself, but for one, which ends the process."""
    if number == 1:
        os._exit(7)
    return number
