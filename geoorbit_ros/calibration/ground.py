"""The seam between calibration and everything that needs metres on the road."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class GroundProjector(Protocol):
    """Turns one camera's tracked boxes into ground tracks, frame by frame, in time order."""

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Project one frame.

        Args:
            stamp_ns: Capture time of the frame, later than that of the previous call.
            rows: (N,) `PIXEL_TRACK_DTYPE`.

        Returns:
            (M,) `TRACK_DTYPE`, M <= N: rows above the horizon are left out.
        """
        ...
