"""What a client must not forget, and its file: replaced as a whole before an update is sent."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.payloads.model_layout import ModelLayout, Vector
from geoorbit_ros.storage.atomic import atomic_output

FORMAT = 2
"""Of the file."""
_UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    zipfile.BadZipFile,
    GeoOrbitError,
)


@dataclass(slots=True)
class ClientState:
    """The model that a client follows, and its last update.

    Attributes:
        layout: Of the model.
        run: When the federation began.
        round: Of the model.
        model: Weights, shape (size,).
        digest: The model's.
        proximal_mu: FedProx's penalty weight.
        residual: What the encoding of updates has not sent yet, shape (size,).
        answered: Round of the last update; 0: none.
        answered_model: Digest of the model it started from.
        update: That update as it was sent.
        validation_divisor: Names the validation clients, see `verdict.is_validation_client`.
        used: Digest of the model in use, which was approved; 0: none is.
        used_model: Its weights, shape (size,).
    """

    layout: ModelLayout
    run: int
    round: int
    model: Vector
    digest: int
    proximal_mu: float
    residual: Vector
    answered: int = 0
    answered_model: int = 0
    update: bytes = b""
    validation_divisor: int = 0
    used: int = 0
    used_model: Vector = field(default_factory=lambda: np.zeros(0, np.float32))


def write_client_state(path: Path, state: ClientState) -> None:
    """Replace the file.

    Raises:
        InputFileError: It can't be written.
    """
    facts = {
        "format": FORMAT,
        "names": state.layout.names,
        "shapes": state.layout.shapes,
        "run": state.run,
        "round": state.round,
        "digest": state.digest,
        "proximal_mu": state.proximal_mu,
        "answered": state.answered,
        "answered_model": state.answered_model,
        "update": state.update.hex(),
        "validation_divisor": state.validation_divisor,
        "used": state.used,
    }
    buffer = io.BytesIO()
    np.savez(
        buffer,
        allow_pickle=False,
        model=state.model,
        residual=state.residual,
        used_model=state.used_model,
        facts=np.frombuffer(json.dumps(facts).encode(), np.uint8),
    )
    with atomic_output(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def read_client_state(path: Path) -> ClientState | None:
    """The state in a file; None when there is none.

    Raises:
        FederationError: A file that is none of this kind.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        facts = json.loads(arrays["facts"].tobytes())
        layout = ModelLayout(tuple(facts["names"]), tuple(map(tuple, facts["shapes"])))
        return ClientState(
            layout,
            facts["run"],
            facts["round"],
            arrays["model"],
            facts["digest"],
            facts["proximal_mu"],
            arrays["residual"],
            facts["answered"],
            facts["answered_model"],
            bytes.fromhex(facts["update"]),
            facts.get("validation_divisor", facts.get("judges")),
            facts["used"],
            arrays["used_model"],
        )
    except _UNREADABLE as error:
        raise FederationError(str(path), error, "a state of meta_client") from None
