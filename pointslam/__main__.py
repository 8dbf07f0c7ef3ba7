"""`python -m pointslam`, where the command `pointslam` is not on the path."""

import sys

from pointslam.cli import main

if __name__ == "__main__":
    sys.exit(main())
