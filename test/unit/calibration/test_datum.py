"""Degrees to metres and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError

# To a tenth of a metre: PROJ loses its footing within a hair's breadth of the equator.
latitudes = st.floats(-80, 80).map(lambda degrees: round(degrees, 6))
longitudes = st.floats(-179, 179)
offsets = st.floats(-5000, 5000)


@given(latitudes, longitudes, offsets, offsets)
def test_there_and_back_is_the_identity(
    latitude: float, longitude: float, x: float, y: float
) -> None:
    datum = Datum(latitude, longitude)
    there = datum.to_geodetic([[x, y]])
    np.testing.assert_allclose(datum.to_local(there[:, 0], there[:, 1]), [[x, y]], atol=1e-6)


@given(latitudes, longitudes, st.floats(10, 5000), st.floats(0, 360))
def test_lengths_and_bearings_are_those_of_the_ellipsoid(
    latitude: float, longitude: float, length: float, bearing: float
) -> None:
    lon, lat, _ = Geod(ellps="WGS84").fwd(longitude, latitude, bearing, length)
    x, y = Datum(latitude, longitude).to_local(lat, lon)[0]
    assert np.hypot(x, y) == pytest.approx(length, rel=1e-6)
    turn = np.degrees(np.arctan2(x, y)) - bearing
    assert abs((turn + 180) % 360 - 180) < 1e-3


def test_origin_east_and_north() -> None:
    datum = Datum(43.04, -89.34)
    assert np.abs(datum.to_local(43.04, -89.34)).max() < 1e-9
    assert datum.to_local(43.04, -89.33)[0, 0] > 800
    assert datum.to_local(43.05, -89.34)[0, 1] > 1100


@pytest.mark.parametrize(
    ("latitude", "longitude", "name"),
    [(91.0, 0.0, "latitude"), (0.0, 181.0, "longitude"), (float("nan"), 0.0, "latitude")],
)
def test_a_datum_off_the_earth_is_refused(latitude: float, longitude: float, name: str) -> None:
    with pytest.raises(CalibrationError, match=name):
        Datum(latitude, longitude)
