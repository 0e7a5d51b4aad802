"""A trained meta-learner as a file."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from geoorbit_ros.core.errors import InputFileError, TableError
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.storage.atomic import atomic_output

_FEATURES, _PARAMETERS = "feature_names", "parameter_names"


def save_model(learner: MetaLearner, path: Path) -> None:
    """Write phi with the names of its inputs and outputs to one .npz file."""
    with atomic_output(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            **{
                _FEATURES: np.array(learner.feature_names),
                _PARAMETERS: np.array(learner.parameter_names),
                **learner.weights,
            },  # type: ignore[arg-type]
        )


def load_model(path: Path) -> MetaLearner:
    """Read what `save_model` wrote.

    Raises:
        InputFileError: Not such a file, or a model for other features or parameters.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        names = [tuple(arrays.pop(key).tolist()) for key in (_FEATURES, _PARAMETERS)]
        learner = MetaLearner.from_tensors(arrays)
    except (OSError, BadZipFile, ValueError, KeyError, TableError) as error:
        raise InputFileError(str(path), error, "a model written by geoorbit train") from error
    expected = [learner.feature_names, learner.parameter_names]
    if names != expected:
        raise InputFileError(str(path), f"a model of {names}", f"one of {expected}")
    return learner
