"""How a federation is run: the settings of a server."""

from __future__ import annotations

from dataclasses import dataclass, field

from geoorbit_ros.federated.encodings.encoding import Encoding, EncodingSettings, make_encoding
from geoorbit_ros.federated.encodings.floats import Float32
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.privacy.coordinator import MIN_CLIENTS
from geoorbit_ros.federated.rounds.selection import SELECTIONS
from geoorbit_ros.federated.rounds.verdict import MIN_VALIDATION_CLIENTS
from geoorbit_ros.federated.strategies.strategy import RobustStrategy, Strategy


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """Settings of a server.

    Attributes:
        federation: Name of the federation, part of every signature.
        run: When it began, whole seconds since 1970. Clients change over to a later run of the same
            federation and refuse an earlier one.
        rounds: Models to make after the first; then training is over.
        target_loss: Training is over, too, once the mean loss that the clients report is not above
            this: the paper's threshold lambda. NaN: never.
        clients_per_round: Clients selected for a round; 0: all.
        selection: How, see `selection.py`.
        validation_divisor: Names the validation clients, see `verdict.is_validation_client`. 0:
            none, and every model is used without validation.
        quorum: Share of the selected clients whose updates suffice at the deadline.
        deadline_s: Longest time for a round. One without a quorum is opened to all clients, and
            goes on until there is one.
        max_staleness: How many models late an update may come with an asynchronous strategy.
        encoding: How the model is sent, see `ModelBroadcast`.
        top_k_share: Share of weights that top-k sends of it.
        top_k_bits: Bits per such weight, 4 or 8.
        keyframe_interval: A whole model is sent at least so often, for those who join.
        max_abs_update: An update with a weight beyond this is refused.
        max_sample_count: So is one with more examples than this.
        interface: `global_model.interface_digest` of the model's inputs and outputs; 0: not
            checked.
        seed: Of the selection.
        clip_norm: With noise, longer updates are cut to this length, and all count the same.
        noise_multiplier: Noise on the sum of updates, in `clip_norm`; 0: none. See `privacy`.
        secure_aggregation: Take updates under masks only; then all count the same.
        masked_range: Under masks, larger changes of a weight are cut to this; at least 1.

    Raises:
        FederationError: A setting out of range.
        ParameterError: No such encoding.
    """

    federation: str = "geoorbit"
    run: int = 1
    rounds: int = 20
    target_loss: float = field(default=float("nan"))
    clients_per_round: int = 0
    selection: str = "random"
    validation_divisor: int = 0
    quorum: float = 0.5
    deadline_s: float = 600.0
    max_staleness: int = 20
    encoding: str = "float32"
    top_k_share: float = 0.1
    top_k_bits: int = 4
    keyframe_interval: int = 50
    max_abs_update: float = 1e3
    max_sample_count: int = 100_000
    interface: int = 0
    seed: int = 0
    clip_norm: float = 1.0
    noise_multiplier: float = 0.0
    secure_aggregation: bool = False
    masked_range: float = 8.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("run", 0, 2**32 - 1),
            ("rounds", 1, 2**31),
            ("clients_per_round", 0, 1 << 16),
            ("validation_divisor", 0, 1 << 16),
            ("quorum", 0.0, 1.0),
            ("deadline_s", 1e-3, 1e9),
            ("max_staleness", 0, 10_000),
            ("keyframe_interval", 1, 10_000),
            ("max_abs_update", 1e-6, 1e6),
            ("max_sample_count", 1, 1 << 20),
            ("interface", 0, 2**32 - 1),
            ("clip_norm", 1e-9, 1e9),
            ("noise_multiplier", 0.0, 1e6),
            ("masked_range", 1.0, 1e6),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise FederationError(f"server setting '{name}'", value, f"{low:g} to {high:g}")
        if self.selection not in SELECTIONS:
            found = repr(self.selection)
            raise FederationError("server setting 'selection'", found, " or ".join(SELECTIONS))
        if self.noise_multiplier and self.secure_aggregation:
            found = "noise and secure aggregation together"
            raise FederationError(
                "server settings", found, "one: the server can not cut what is masked"
            )
        if self.noise_multiplier and self.selection == "importance":
            found = "noise and selection by importance"
            raise FederationError("server settings", found, "one: the selection tells of losses")
        self.model_encoding()

    def model_encoding(self) -> Encoding:
        """How the model is sent.

        Raises:
            ParameterError: No such encoding.
        """
        if self.encoding == "float32":
            return Float32()
        return make_encoding(self.encoding, EncodingSettings(self.top_k_share, self.top_k_bits))


def check_settings(
    config: ServerConfig,
    strategy: Strategy,
    clients: int,
    training_clients: int,
    validation_clients: int,
) -> None:
    """Refuse settings that exclude each other.

    Args:
        config: Settings of the server.
        strategy: Its strategy.
        clients: Cameras on the roster.
        training_clients: How many of them train.
        validation_clients: How many of them validate.

    Raises:
        FederationError: Naming both.
    """
    hides = config.secure_aggregation or config.noise_multiplier
    if hides and (isinstance(strategy, RobustStrategy) or strategy.buffer_size):
        found = f"{type(strategy).__name__} with noise or masks"
        raise FederationError("server settings", found, "a strategy that takes a mean")
    if config.secure_aggregation and clients < MIN_CLIENTS:
        found = f"{clients} cameras"
        raise FederationError("secure aggregation", found, f"{MIN_CLIENTS} or more")
    if training_clients == 0:
        raise FederationError(
            "server setting 'validation_divisor'",
            config.validation_divisor,
            "clients left to train",
        )
    least = MIN_CLIENTS if config.secure_aggregation else MIN_VALIDATION_CLIENTS
    if config.validation_divisor > 1 and validation_clients < least:
        raise FederationError("validation clients", validation_clients, f"{least} or more")
