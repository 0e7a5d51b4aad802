"""Plug-in detectors: the method `warm_up`, and its old name `prime`."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.detection.detector import make_detector

PLUGIN = """
import numpy as np

from geoorbit_ros.core.tables import DETECTION_DTYPE


class Own:
    name = "own"
    seen = 0

    def {method}(self, images):
        Own.seen = len(list(images))

    def detect(self, stamp_ns, image):
        rows = np.ones(1, DETECTION_DTYPE)
        rows["x"], rows["y"] = stamp_ns, Own.seen
        return rows
"""
IMAGE = np.zeros((4, 4, 3), np.uint8)


def plugin(folder: Path, method: str) -> Path:
    (folder / "own.py").write_text(PLUGIN.format(method=method), encoding="utf-8")
    return folder / "own.py:Own"


def test_a_plugin_with_warm_up_is_used_as_it_is(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        detector = make_detector(plugin(tmp_path, "warm_up"))
    detector.warm_up([(1, IMAGE), (2, IMAGE)])
    assert detector.detect(5, IMAGE)[["x", "y"]].tolist() == [(5, 2)]


def test_the_old_name_works_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(FutureWarning, match="`prime` is now called `warm_up`"):
        detector = make_detector(plugin(tmp_path, "prime"))
    detector.warm_up([(1, IMAGE)])
    assert detector.name == "own"
    assert detector.detect(5, IMAGE)[["x", "y"]].tolist() == [(5, 1)]


def test_a_plugin_with_neither_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="Own without warm_up"):
        make_detector(plugin(tmp_path, "learn"))
