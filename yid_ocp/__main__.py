"""Run `yid-ocp` as `python -m yid_ocp`."""

import sys

from yid_ocp.cli import main

if __name__ == "__main__":
    sys.exit(main())
