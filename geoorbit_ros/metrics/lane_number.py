"""The paper's lane number loss (section IV-A)."""

from __future__ import annotations


def lane_number_loss(detected: int, reference: int, tolerated: int = 0) -> float:
    """L_lane_num = |N_det - N_ref|, in lanes.

    Args:
        detected: N_det, lanes in the map.
        reference: N_ref, lanes that must be there.
        tolerated: Reference lanes beyond those that may be there or not, since hardly anybody
            drove on them: N_ref is then only known to lie in [reference, reference + tolerated],
            and the loss is the distance from that interval. 0 is the paper's equation.
    """
    return float(max(reference - detected, detected - reference - tolerated, 0))
