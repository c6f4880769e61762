"""`python -m yid_ocp` is `yid-ocp`."""

import sys

from yid_ocp.cli import main

if __name__ == "__main__":
    sys.exit(main())
