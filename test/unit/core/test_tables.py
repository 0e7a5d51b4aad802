import numpy as np

from geoorbit_ros.core.tables import CAR, PIXEL_TRACK_DTYPE, TRUCK, one_class_each


def rows(*values: tuple[int, int, float, float]) -> np.ndarray:
    """Rows of (track_id, class_id, height, score)."""
    table = np.zeros(len(values), PIXEL_TRACK_DTYPE)
    for k, name in enumerate(("track_id", "class_id", "height", "score")):
        table[name] = [value[k] for value in values]
    table["width"] = table["height"]
    return table


def test_a_track_has_the_class_that_its_near_and_sure_rows_have() -> None:
    far_car_near_lorry = [(1, CAR, 10.0, 0.8)] * 5 + [(1, TRUCK, 90.0, 0.8)] * 2
    seldom_lorry = [(2, TRUCK, 40.0, 0.3), *[(2, CAR, 40.0, 0.9)] * 3]
    kinds = one_class_each(rows(*far_car_near_lorry, *seldom_lorry))
    assert kinds.tolist() == [TRUCK] * 7 + [CAR] * 4


def test_no_rows_have_no_classes() -> None:
    assert len(one_class_each(rows())) == 0
