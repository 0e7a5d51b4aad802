"""Three of ten clients lie: robust strategies end within a tenth of the run without them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from federation_parts import FEDERATION, Camera, Federation, signer_id, update_of
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.rounds.client import TrainingOrder
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.strategies.strategy import StrategySettings, make_strategy

HONEST = tuple(f"honest_{k}" for k in range(7))
ATTACKERS = tuple(f"attacker_{k}" for k in range(3))
CONFIG = ServerConfig(federation=FEDERATION, rounds=25, quorum=0.7, deadline_s=1.0)
Vector = NDArray[np.float32]
Attack = Callable[[Vector], Vector]
"""Makes a false update of all honest ones, shape (number, size): attackers know all of them."""


def not_a_number(honest: Vector) -> Vector:
    return np.full_like(honest[0], np.nan)


def huge(honest: Vector) -> Vector:
    return np.full_like(honest[0], 900.0)


def sign_flipped(honest: Vector) -> Vector:
    return np.asarray(-5 * honest.mean(axis=0), np.float32)


def colluding(honest: Vector) -> Vector:
    """Baruch et al., "A little is enough", NeurIPS 2019: all lie alike, within the usual spread."""
    return np.asarray(honest.mean(axis=0) - 1.5 * honest.std(axis=0), np.float32)


ATTACKS: dict[str, Attack] = {
    "nan": not_a_number,
    "huge": huge,
    "sign_flipped": sign_flipped,
    "colluding": colluding,
}


def noisy_camera(number: int) -> Camera:
    """Targets that no model can hit exactly: without, a ratio of losses would compare zeros."""
    exact = Camera.drawn(100 + number, 200)
    noise = np.random.default_rng(number).normal(0, 0.15, exact.y.shape)
    return Camera(exact.x, exact.y + noise)


def final_loss(strategy: str, attack: Attack | None) -> float:
    """Mean loss of the honest cameras after training; the byzantine_count lie in every round."""
    settings = StrategySettings(byzantine_share=0.3)
    names = (*HONEST, *(ATTACKERS if attack else ()))
    config = replace(CONFIG, quorum=0.7) if attack else CONFIG
    federation = Federation(names, config, lambda: make_strategy(strategy, settings))
    cameras = {name: noisy_camera(k) for k, name in enumerate(HONEST)}
    server = federation.server
    server.start(0.0)
    now_s = 0.0
    while not server.finished:
        tensors, number = server.published, server.round
        order = TrainingOrder(number, 0.0)
        deltas = [
            server.layout.flatten(cameras[name].train(tensors, order).delta) for name in HONEST
        ]
        lies = {name: attack(np.array(deltas)) for name in ATTACKERS if attack is not None}
        for name, vector in [*lies.items(), *zip(HONEST, deltas, strict=True)]:
            try:
                # An attacker would claim more examples, too.
                count = 200 if name in HONEST else 100_000
                server.receive(update_of(server, name, vector, sample_count=count), now_s)
            except PayloadError as error:
                assert error.reason == Refusal.NOT_FINITE
        now_s += 1.0
        if server.round == number:
            server.tick(now_s)
    if attack is not_a_number:
        assert server.refused[Refusal.NOT_FINITE] == len(ATTACKERS) * CONFIG.rounds
    assert not {signer_id(name) for name in ATTACKERS} & {signer_id(name) for name in HONEST}
    return float(np.mean([camera.loss(server.tensors) for camera in cameras.values()]))


@pytest.fixture(scope="module")
def clean() -> dict[str, float]:
    return {
        name: final_loss(name, None)
        for name in ("fedavg", "fedmedian", "trimmed_mean", "multi_krum")
    }


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("strategy", ["fedmedian", "trimmed_mean", "multi_krum"])
def test_robust_strategies_end_where_the_clean_run_ends(
    strategy: str, attack: str, clean: dict[str, float]
) -> None:
    assert final_loss(strategy, ATTACKS[attack]) <= 1.1 * clean["fedavg"]


@pytest.mark.parametrize("attack", ["huge", "sign_flipped", "colluding"])
def test_a_plain_mean_does_not(attack: str, clean: dict[str, float]) -> None:
    assert final_loss("fedavg", ATTACKS[attack]) > 1.25 * clean["fedavg"]
