"""Noise and cuts: as much as promised, the same after a restart, and what it is worth."""

from dataclasses import replace

import numpy as np
import pytest
from federation_parts import FEDERATION, Federation, first_tensors, update_of
from scipy.stats import kstest

from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.privacy.differential import clipped, epsilon, normal_noise
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.strategies.strategy import make_strategy

NAMES = ("north", "south")
CONFIG = ServerConfig(federation=FEDERATION, rounds=3, clip_norm=0.5, noise_multiplier=2.0)


def test_an_update_is_cut_to_its_length_and_keeps_its_direction() -> None:
    vector = np.array([3.0, 4.0], np.float32)
    np.testing.assert_allclose(clipped(vector, 1.0), [0.6, 0.8], rtol=1e-5)
    assert np.linalg.norm(clipped(vector, 1.0).astype(float)) <= 1.0
    np.testing.assert_array_equal(clipped(vector, 5.1), vector)


def test_the_noise_is_normal_and_depends_on_secret_and_round() -> None:
    noise = normal_noise(bytes(32), 1, 20_000)
    assert kstest(noise, "norm").pvalue > 0.001
    np.testing.assert_array_equal(noise, normal_noise(bytes(32), 1, 20_000))
    for other in (normal_noise(bytes(32), 2, 20_000), normal_noise(b"\1" * 32, 1, 20_000)):
        assert abs(np.corrcoef(noise, other)[0, 1]) < 0.03


def test_the_released_model_is_the_cut_mean_plus_the_noise() -> None:
    federation = Federation(NAMES, CONFIG)
    server = federation.server
    server.start(0.0)
    size = server.layout.size
    long, short = np.full(size, 10, np.float32), np.full(size, 0.01, np.float32)
    server.receive(update_of(server, "north", long, sample_count=100), 0.0)
    server.receive(update_of(server, "south", short, sample_count=1), 0.0)
    cut = long / np.linalg.norm(long) * 0.5
    noise = normal_noise(server._state.secret, 1, size) * (2.0 * 0.5 / 2)
    before = server.layout.flatten(first_tensors())
    expected = before + (cut + short) / 2 + noise
    np.testing.assert_allclose(server.layout.flatten(server.tensors), expected, atol=1e-5)
    assert len(server._state.secret) == 32
    assert federation.new_server()._state.secret != server._state.secret


def test_epsilon_is_that_of_the_gaussian_mechanism() -> None:
    # Balle and Wang, ICML 2018: noise 1 gives epsilon 4.377 at delta 1e-5; T rounds of noise z
    # are one of noise z / sqrt(T).
    assert epsilon(1.0, 1, 1e-5) == pytest.approx(4.377, abs=0.01)
    assert epsilon(4.0, 16, 1e-5) == pytest.approx(4.377, abs=0.03)
    assert epsilon(4.0, 20, 1e-5) > epsilon(4.0, 10, 1e-5) > epsilon(8.0, 10, 1e-5)


def test_privacy_that_would_be_none_is_refused() -> None:
    with pytest.raises(FederationError, match="importance"):
        replace(CONFIG, selection="importance")
    with pytest.raises(FederationError, match="mean"):
        Federation(NAMES, CONFIG, lambda: make_strategy("trimmed_mean"))
    for arguments in ((0.0, 1, 1e-5), (1.0, 0, 1e-5), (1.0, 1, 1.0)):
        with pytest.raises(FederationError):
            epsilon(*arguments)
