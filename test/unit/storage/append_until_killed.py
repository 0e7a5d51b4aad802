"""A writer for the kill test: DATABASE STEP_NS; prints stamp and monotonic time of every append."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.storage.database.writer import TrajectoryDatabase

database = TrajectoryDatabase(Path(sys.argv[1]))
rows = np.zeros(3, TRACK_DTYPE)
stamp_ns = 0
while True:
    stamp_ns += int(sys.argv[2])
    rows["x"] = stamp_ns % 1_000_003
    database.append("pole_7", stamp_ns, rows)
    os.write(1, f"{stamp_ns} {time.monotonic_ns()}\n".encode())
