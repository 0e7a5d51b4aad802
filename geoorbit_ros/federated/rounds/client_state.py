"""What a client must not forget, and its file: replaced as a whole before an update is sent."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.state_file import NewerStateError, StateFile
from geoorbit_ros.federated.payloads.model_layout import ModelLayout, Vector

FORMAT = 3
"""Of the file. 2: validation; 3: the server's key. Older ones are read."""
KIND = "a state of meta_client"


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
        server: Public key of the server that all of this is from, in hex digits; empty: unsigned.
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
    server: str = ""


def write_client_state(file: StateFile, state: ClientState) -> None:
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
        "server": state.server,
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
    file.write(buffer.getvalue())


def read_client_state(file: StateFile, server: str) -> ClientState | None:
    """The state in a file; None when there is none that can be used.

    A damaged one is set aside, and so is what was learned under another key of the server: a
    server that has lost everything begins anew with a new key.

    Args:
        file: The file.
        server: Public key of the server, in hex digits; empty: unsigned.

    Raises:
        NewerStateError: A file of a newer version.
    """
    state = file.read(_client_state)
    if state is not None and state.server and state.server != server:
        file.told.append(f"{file.path}: the server has another key, learning begins anew")
        return None
    if state is not None:
        state.server = server
    return state


def _client_state(path: Path) -> ClientState:
    arrays = read_arrays(path, KIND)
    facts = json.loads(arrays["facts"].tobytes())
    version = facts.get("format", 1)
    if version > FORMAT:
        found = f"format {version}, of a newer version"
        raise NewerStateError(str(path), found, f"{KIND}, format {FORMAT} or older")
    layout = ModelLayout(tuple(facts["names"]), tuple(map(tuple, facts["shapes"])))
    none = np.zeros(0, np.float32)
    state = ClientState(
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
        facts.get("validation_divisor", facts.get("judges", 0)),
        facts.get("used", 0),
        arrays.get("used_model", none),
        facts.get("server", ""),
    )
    used = state.used_model if state.used else state.model
    for name, vector in (("model", state.model), ("residual", state.residual), ("used", used)):
        if vector.shape != (layout.size,):
            raise ValueError(f"{name} of shape {vector.shape}")
    return state
