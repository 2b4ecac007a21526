"""The service as it is, with the points of tests/chaos/points.py."""

from __future__ import annotations

import sys

from service.__main__ import main
from tests.chaos.points import install_service_points

if __name__ == "__main__":
    install_service_points()
    sys.exit(main())
