"""Whether a trained model is used at all: only if cameras it hasn't learned from are better off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geoorbit_ros.learning.parameter_search import log_loss
from geoorbit_ros.metrics.composite import LaneLosses

STANDARD_ERRORS = 2.0


@dataclass(frozen=True, slots=True)
class Acceptance:
    """What the judges say.

    Attributes:
        accepted: Whether the model is used.
        gain: Mean over the judges of ln(L_total with the model / L_total with the defaults);
            negative is better. NaN without judges.
        error: Standard error of that mean.
    """

    accepted: bool
    gain: float
    error: float


NOBODY_ASKED = Acceptance(True, float("nan"), float("nan"))


def acceptance(model: Sequence[LaneLosses], fixed: Sequence[LaneLosses]) -> Acceptance:
    """Compare a model with the defaults, camera by camera.

    It is accepted when its mean gain is more than `STANDARD_ERRORS` standard errors away from
    none. What can't be told from chance is not worth leaving the defaults for.

    Args:
        model: Losses of the judges with the model.
        fixed: The same cameras' losses with the default parameters. With fewer than two of them
            nothing can be said, and the model is taken as it is.
    """
    if len(fixed) < 2:
        return NOBODY_ASKED
    change = np.array(
        [log_loss(new) - log_loss(old) for new, old in zip(model, fixed, strict=True)]
    )
    gain, error = float(change.mean()), float(change.std(ddof=1) / np.sqrt(len(change)))
    return Acceptance(gain + STANDARD_ERRORS * error < 0.0, gain, error)
