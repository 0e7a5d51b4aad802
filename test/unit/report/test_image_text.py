"""Text has its rim all around, whatever the font makes of thickness."""

import numpy as np
import pytest

from geoorbit_ros.report.image_overlay import write_text


@pytest.mark.parametrize("size", [0.4, 0.7, 1.5])
@pytest.mark.parametrize("thickness", [1, 2])
def test_every_letter_lies_on_its_own_black_rim(size: float, thickness: int) -> None:
    image = np.full((80, 700, 3), 90, np.uint8)
    write_text(image, "12 vehicles 3 lanes", (20, 55), size, (0, 255, 255), thickness)
    letter, rim = (image[..., 1] > 200).any(axis=0), (image < 40).all(axis=2).any(axis=0)
    first, last = np.flatnonzero(letter)[[0, -1]]
    assert np.flatnonzero(rim)[0] == pytest.approx(first, abs=2 * size + 3)
    assert np.flatnonzero(rim)[-1] == pytest.approx(last, abs=2 * size + 3)
