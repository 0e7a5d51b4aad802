"""A model is used only once it is approved, with late joiners, restarts and false reports."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from federation_parts import FEDERATION, Camera, Federation, signer_id, update_of
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.federated.encodings.encoding import make_encoding
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.payloads.global_model import GlobalModel
from geoorbit_ros.federated.rounds.client import FederatedClient, LocalResult, Work
from geoorbit_ros.federated.rounds.in_process import run_in_process
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.verdict import (
    GAIN_LIMIT,
    GainSums,
    gain_terms,
    is_training_client,
    is_validation_client,
    validation_divisor,
)
from geoorbit_ros.federated.strategies.fedbuff import FedBuff

NAMES = tuple(f"camera{k}" for k in range(12))
DIVISOR = validation_divisor([signer_id(name) for name in NAMES], 4)
VALIDATING = tuple(name for name in NAMES if is_validation_client(signer_id(name), DIVISOR))
TRAINING = tuple(name for name in NAMES if name not in VALIDATING)
CONFIG = ServerConfig(federation=FEDERATION, rounds=4, validation_divisor=DIVISOR, encoding="top_k")
GAINS = st.lists(st.floats(-9, 9), min_size=2, max_size=20)


@given(GAINS)
def test_a_verdict_is_mean_and_standard_error_in_any_order(gains: list[float]) -> None:
    verdict = GainSums.of(gains).verdict()
    assert verdict is not None
    cut = np.clip(gains, -GAIN_LIMIT, GAIN_LIMIT)
    error = cut.std(ddof=1) / np.sqrt(len(cut))
    assert verdict.gain == pytest.approx(cut.mean(), abs=1e-6)
    assert verdict.error == pytest.approx(error, abs=1e-3)
    assert GainSums.of(sorted(gains)) == GainSums.of(gains)


@given(GAINS)
def test_sums_from_under_masks_give_the_same_verdict(gains: list[float]) -> None:
    verdict = GainSums.of(gains).verdict()
    masked = GainSums.of_sums(np.sum([gain_terms(g) for g in gains], axis=0)).verdict()
    assert verdict is not None
    assert masked is not None
    assert masked.clients == verdict.clients
    assert masked.gain == pytest.approx(verdict.gain, abs=1e-6)
    assert masked.error == pytest.approx(verdict.error, abs=1e-3)


@pytest.mark.parametrize("honest", [0.0, 0.01, 0.5])
@pytest.mark.parametrize("lie", [-0.1, -1.0, -100.0])
@pytest.mark.parametrize("clients", [3, 8, 40, 400])
def test_a_minority_of_false_gains_brings_no_model_in(
    honest: float, lie: float, clients: int
) -> None:
    false = (clients - 1) // 2
    verdict = GainSums.of([lie] * false + [honest] * (clients - false)).verdict()
    assert verdict is not None
    assert not verdict.accepted


def test_who_abstains_does_not_count_and_one_judge_is_none() -> None:
    nothing = float("nan")
    assert GainSums.of([nothing, -1.0]).verdict() is None
    assert GainSums.of([nothing, -1.0, -1.1]) == GainSums.of([-1.0, -1.1])


@pytest.mark.parametrize("clients", [8, 12, 40, 1000])
@pytest.mark.parametrize("every", [2, 4, 10])
def test_about_one_in_so_many_only_validates(clients: int, every: int) -> None:
    numbers = np.random.default_rng(clients).integers(0, 2**32, clients).tolist()
    divisor = validation_divisor(numbers, every)
    validating = sum(is_validation_client(n, divisor) for n in numbers)
    if clients < 2 * every:
        assert divisor == 1
        return
    assert abs(validating - clients / every) <= 1 + 2.5 * np.sqrt(clients / every)
    assert validating + sum(is_training_client(n, divisor) for n in numbers) == clients


def with_gains(federation: Federation, gains: dict[str, float]) -> Federation:
    """Validation clients that report the gains that the test wants."""

    class Fixed(Camera):
        def gain(self, tensors: object) -> float:
            return gains[next(n for n, c in federation.cameras.items() if c is self)]

    for name in gains:
        camera = federation.cameras[name]
        federation.cameras[name] = Fixed(camera.x, camera.y)
    return federation


def federation_of(
    names: Sequence[str] = NAMES, config: ServerConfig = CONFIG, folder: Path | None = None
) -> Federation:
    return Federation(names, config, encoding=make_encoding(config.encoding), folder=folder)


def run(federation: Federation) -> None:
    run_in_process(federation.server, federation.clients, federation.train_many)


def test_a_better_model_is_used_by_all_and_judges_teach_nothing() -> None:
    assert 2 <= len(VALIDATING) <= 4
    federation = federation_of()
    run(federation)
    server = federation.server
    assert server.verdict.accepted
    assert server.verdict.clients == len(VALIDATING)
    assert [r.updates for r in server.history] == [*[len(TRAINING)] * 4, 0]
    for client in federation.clients:
        assert client.used_tensors is not None
        for name, value in server.published.items():
            np.testing.assert_array_equal(client.used_tensors[name], value)
    alone = federation_of(TRAINING, replace(CONFIG, validation_divisor=0))
    alone.cameras = {name: federation.cameras[name] for name in TRAINING}
    run(alone)
    for name, value in alone.server.tensors.items():
        assert value.tobytes() == server.tensors[name].tobytes()


def test_a_model_that_judges_find_worse_is_used_by_nobody() -> None:
    federation = with_gains(federation_of(), dict.fromkeys(VALIDATING, 0.1))
    run(federation)
    assert not federation.server.verdict.accepted
    assert all(client.finished and client.used_tensors is None for client in federation.clients)
    assert federation.clients[0].tensors is not None  # it was trained, and stays unused


def test_without_judges_every_model_is_used() -> None:
    federation = federation_of(config=replace(CONFIG, validation_divisor=0))
    client = federation.clients[0]
    client.receive(federation.server.start(0.0))
    assert client.used == client.model_of[2] != 0


def test_in_a_small_fleet_all_teach_and_judge() -> None:
    federation = federation_of(NAMES[:3], replace(CONFIG, validation_divisor=1))
    run(federation)
    assert [(r.updates, r.validation_clients) for r in federation.server.history] == [
        *[(3, 3)] * 4,
        (0, 3),
    ]
    assert federation.server.verdict.accepted


def test_masked_judges_give_the_verdict_of_open_ones() -> None:
    names = NAMES[:5]
    plain = federation_of(
        names, replace(CONFIG, validation_divisor=1, encoding="float32", rounds=2)
    )
    masked = federation_of(names, replace(plain.config, secure_aggregation=True))
    for federation in (plain, masked):
        run(federation)
    for open_, hidden in zip(plain.server.history, masked.server.history, strict=True):
        assert (hidden.validation_clients, hidden.updates) == (
            open_.validation_clients,
            open_.updates,
        )
        assert hidden.gain == pytest.approx(open_.gain, abs=1e-4)
        assert hidden.gain_error == pytest.approx(open_.gain_error, abs=1e-2)
        assert hidden.approved == open_.approved


def test_an_asynchronous_server_has_its_models_judged_too() -> None:
    config = replace(CONFIG, encoding="float32", max_staleness=3)
    federation = Federation(NAMES, config, lambda: FedBuff(3, 1.0))
    run(federation)
    server = federation.server
    assert [r.updates for r in server.history] == [*[3] * CONFIG.rounds, 0]
    assert server.verdict.accepted
    assert server.verdict.clients == len(VALIDATING)
    assert {client.used for client in federation.clients} == {federation.clients[0].model_of[2]}


def rounds_of(federation: Federation, number: int) -> list[bytes]:
    """Announcements of so many rounds, with everybody answering."""
    announced = [federation.server.start(0.0)]
    for _ in range(number):
        last = announced[-1]
        for client in federation.clients:
            update = client.answer(last)
            if update and (following := federation.server.receive(update, 0.0)):
                announced.append(following)
    return announced


def test_who_joins_late_uses_the_defaults_until_the_next_verdict(tmp_path: Path) -> None:
    federation = federation_of(config=replace(CONFIG, encoding="float32"), folder=tmp_path)
    announced = rounds_of(federation, 2)
    late = FederatedClient("late", federation=FEDERATION)
    for payload in federation.server.latched:
        late.receive(payload)
    kept = federation.clients[0]
    kept.receive(announced[-1])
    assert kept.used not in (0, kept.model_of[2])  # the model before this one was validated
    assert late.used == 0
    assert late.tensors is not None
    # Started again, the first one still has what it used.
    again = federation.new_client(NAMES[0])
    for payload in federation.server.latched:
        try:
            again.receive(payload)
        except PayloadError as error:
            assert error.reason == Refusal.OLD_ROUND
    assert again.used == kept.used
    for client in federation.clients:
        update = client.answer(announced[-1])
        following = federation.server.receive(update, 0.0) if update else None
    assert following is not None
    late.receive(following)
    assert late.used != 0


def test_the_end_can_not_be_taken_back() -> None:
    federation = with_gains(federation_of(), dict.fromkeys(VALIDATING, -1.0))
    announced = rounds_of(federation, 5)
    client = federation.clients[0]
    client.receive(announced[-1])
    assert client.finished
    for old in announced[:-1]:
        with pytest.raises(PayloadError) as refused:
            client.receive(old)
        assert refused.value.reason == Refusal.OLD_ROUND
    assert client.finished


def refusal(federation: Federation, payload: bytes) -> Refusal:
    with pytest.raises(PayloadError) as refused:
        federation.server.receive(payload, 0.0)
    return refused.value.reason


def test_nobody_does_the_others_part() -> None:
    federation = federation_of()
    server = federation.server
    server.start(0.0)
    zero = np.zeros(server.layout.size, np.float32)
    empty = zero[:0]
    validating, training = VALIDATING[0], TRAINING[0]
    words = {"sample_count": 0, "gain": -1.0}
    assert refusal(federation, update_of(server, validating, zero)) == Refusal.NOT_SELECTED
    assert refusal(federation, update_of(server, training, empty, **words)) == Refusal.NOT_SELECTED
    assert refusal(federation, update_of(server, validating, zero, **words)) == Refusal.SHAPE
    endless = words | {"gain": math.inf}
    assert (
        refusal(federation, update_of(server, validating, empty, **endless)) == Refusal.NOT_FINITE
    )
    server.receive(update_of(server, validating, empty, **words), 0.0)
    assert refusal(federation, update_of(server, validating, empty, **words)) == Refusal.DUPLICATE
    assert (server.validated, server.collected) == (1, 0)


def test_a_silent_judge_holds_training_up_until_the_deadline_only() -> None:
    federation = federation_of()
    server = federation.server
    first = server.start(0.0)
    for client in federation.clients:
        if client.camera_id != VALIDATING[0]:
            update = client.answer(first)
            assert update is not None
            assert server.receive(update, 0.0) is None
    assert server.tick(CONFIG.deadline_s - 1.0) is None
    assert server.tick(CONFIG.deadline_s) is not None
    assert (server.round, server.history[0].validation_clients) == (2, len(VALIDATING) - 1)


def test_settings_that_leave_too_few_are_refused() -> None:
    for divisor, words in ((3_000_001, "2 or more"), (2, "train")):
        names = [n for n in (f"n{k}" for k in range(60)) if signer_id(n) % 2 == 0][:5]
        with pytest.raises(FederationError, match=words):
            federation_of(names, replace(CONFIG, validation_divisor=divisor % (1 << 16)))


def test_the_announcement_says_who_judges_and_what_is_approved() -> None:
    federation = federation_of(config=replace(CONFIG, encoding="float32"))
    announced = [GlobalModel.decode(payload) for payload in rounds_of(federation, 5)]
    assert {model.validation_divisor for model in announced} == {DIVISOR}
    assert announced[0].approved == 0
    for before, model in itertools.pairwise(announced[1:-1]):
        assert model.approved == before.model
    assert announced[-1].approved == announced[-1].model == announced[-2].model


def test_a_result_without_a_gain_is_an_abstention() -> None:
    federation = federation_of(NAMES[:3], replace(CONFIG, validation_divisor=1))

    def silent(asked: Sequence[tuple[FederatedClient, Work]]) -> list[LocalResult]:
        return [replace(r, gain=float("nan")) for r in federation.train_many(asked)]

    run_in_process(federation.server, federation.clients, silent)
    assert federation.server.finished
    assert not federation.server.verdict.accepted
    assert federation.clients[0].used == 0
