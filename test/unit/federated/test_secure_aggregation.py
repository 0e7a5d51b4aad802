"""Masked sums: the right sum, whoever drops out, and no summand for the server to see."""

import contextlib
import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from federation_parts import FEDERATION, Federation, signer_id, signer_of
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.payloads.header import schema_of
from geoorbit_ros.federated.privacy import shamir
from geoorbit_ros.federated.privacy.coordinator import Coordinator
from geoorbit_ros.federated.privacy.message import (
    SecureMessage,
    Stage,
    read_rows,
    write_rows,
)
from geoorbit_ros.federated.privacy.participant import Participant
from geoorbit_ros.federated.privacy.random_stream import Quantiser, pairwise_mask, stream
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.federated.rounds.in_process import run_in_process
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.strategies.strategy import make_strategy

NAMES = tuple(f"camera_{k}" for k in range(6))
SIZE, LIMIT = 40, 4.0
CONFIG = ServerConfig(
    federation=FEDERATION, rounds=4, secure_aggregation=True, quorum=0.5, deadline_s=100.0
)


@given(st.binary(min_size=32, max_size=32), st.integers(2, 6), st.data())
def test_enough_shares_restore_a_secret_and_fewer_do_not(
    secret: bytes, threshold: int, data: Any
) -> None:
    points = data.draw(st.lists(st.integers(1, 2**32 - 1), min_size=6, max_size=8, unique=True))
    shares = shamir.split(secret, points, threshold)
    chosen = data.draw(st.permutations(points))[:threshold]
    assert shamir.restore({p: shares[p] for p in chosen}) == secret
    with contextlib.suppress(FederationError):  # a number that no secret can be
        assert shamir.restore({p: shares[p] for p in chosen[1:]}) != secret


def test_sharing_that_can_not_work_is_refused() -> None:
    for points, threshold in (([1, 2], 3), ([0, 1], 2), ([1, 1], 2)):
        with pytest.raises(FederationError):
            shamir.split(bytes(32), points, threshold)


def test_masks_cancel_in_pairs_and_look_like_noise() -> None:
    seed = bytes(range(32))
    both = pairwise_mask(3, 9, seed, 1000) + pairwise_mask(9, 3, seed, 1000)
    assert not both.any()
    words = stream(seed, 100_000)
    assert abs(words.mean() / 2**31 - 1) < 0.01
    assert stream(bytes(32), 4).tobytes().hex() == "76b8e0ada0f13d90405d6ae55386bd28"  # RFC 8439


@given(st.integers(1, 1000), st.lists(st.floats(-4, 4, width=32), min_size=1, max_size=20))
def test_quantised_sums_do_not_wrap_around(clients: int, values: list[float]) -> None:
    quantiser = Quantiser(LIMIT, clients)
    vector = np.array(values, np.float32)
    with np.errstate(over="ignore"):
        total = quantiser.forward(vector) * np.uint32(clients)
    np.testing.assert_allclose(
        quantiser.backward(total), clients * vector.astype(float), atol=clients**2 * LIMIT / 2**31
    )


class Sum:
    """A masked sum with clients that fall silent after a given stage."""

    def __init__(self, silent: dict[int, Stage] | None = None, clients: int = 10) -> None:
        generator = np.random.default_rng(0)
        self.silent = silent or {}
        self.ids = [int(n) for n in generator.choice(2**32 - 1, clients, replace=False) + 1]
        self.values = generator.uniform(-3, 3, (clients, SIZE)).astype(np.float32)
        self.parties = {
            n: Participant(n, 7, 99, row) for n, row in zip(self.ids, self.values, strict=True)
        }
        self.coordinator = Coordinator(self.ids, 7, 99, 1234, SIZE, LIMIT)
        self.seen: dict[Stage, dict[int, SecureMessage]] = {}

    def heard(self, index: int, stage: Stage) -> bool:
        return stage <= self.silent.get(index, Stage.REVEAL)

    def run(self) -> "np.ndarray[Any, Any]":
        sent = {n: party.keys() for n, party in self.parties.items()}
        while True:
            stage = self.coordinator.stage
            sent = {n: m for n, m in sent.items() if self.heard(self.ids.index(n), stage)}
            self.seen[stage] = sent
            for message in sent.values():
                # Over the wire and back.
                self.coordinator.take(SecureMessage.decode(message.unsigned() + bytes(64)))
            following = self.coordinator.advance()
            if following is None:
                return self.coordinator.total()
            sent = {n: self.parties[n].answer(following) for n in sent}


@pytest.mark.parametrize(
    "silent",
    [
        {},
        {0: Stage.KEYS, 1: Stage.KEYS},
        {1: Stage.SHARES},
        {2: Stage.MASKED},
        {5: Stage.SHARES, 3: Stage.MASKED},
        {4: Stage.KEYS},
    ],
    ids=str,
)
def test_the_sum_is_right_whoever_drops_out(silent: dict[int, Stage]) -> None:
    masked = Sum(silent)
    total = masked.run()
    present = [k for k in range(10) if silent.get(k, Stage.REVEAL) >= Stage.MASKED]
    np.testing.assert_allclose(total, masked.values[present].sum(0, dtype=float), atol=1e-6)
    assert masked.coordinator.survivors == sorted(masked.ids[k] for k in present)


def test_too_many_drop_outs_end_the_attempt_and_give_nothing_away() -> None:
    masked = Sum({k: Stage.SHARES for k in range(4)})
    with pytest.raises(FederationError, match="MASKED"):
        masked.run()


def test_what_the_server_sees_of_a_client_says_nothing_about_its_values() -> None:
    masked = Sum()
    masked.run()
    first = np.frombuffer(masked.seen[Stage.MASKED][masked.ids[0]].data, "<u4")
    again = Sum()  # the same values under fresh secrets
    again.run()
    second = np.frombuffer(again.seen[Stage.MASKED][again.ids[0]].data, "<u4")
    assert not (first == second).any()
    plain = Quantiser(LIMIT, 10).forward(masked.values[0])
    for words in (first, second):
        correlation = np.corrcoef(words.astype(float), plain.view(np.int32).astype(float))[0, 1]
        assert abs(correlation) < 0.6  # 40 values: four standard errors


def test_no_client_reveals_both_secrets_of_anybody() -> None:
    masked = Sum({2: Stage.SHARES})
    masked.run()
    for message in masked.seen[Stage.REVEAL].values():
        assert len(message.data) == 10 * (4 + shamir.SHARE_BYTES)
    party, ids = masked.parties[masked.ids[0]], sorted(masked.ids)
    rows = write_rows({(n,): b"" for n in ids}, 1)
    with pytest.raises(PayloadError):  # asked again, with another set of survivors
        party.answer(SecureMessage(Stage.SURVIVORS, 7, 99, 1234, 0, rows))


def peers_message(masked: Sum, threshold: int, leave_out: int = -1) -> SecureMessage:
    rows = {(n,): party.keys().data for n, party in masked.parties.items()}
    if leave_out >= 0:
        del rows[(masked.ids[leave_out],)]
    data = np.array([threshold], "<u4").tobytes() + np.array([LIMIT], "<f4").tobytes()
    return SecureMessage(Stage.PEERS, 7, 99, 5, 0, data + write_rows(rows, 1))


def test_a_client_refuses_a_server_that_could_look_under_a_mask() -> None:
    masked = Sum()
    party = masked.parties[masked.ids[0]]
    for message in (
        peers_message(masked, 5),  # half of the peers could then be asked twice
        peers_message(masked, 7, leave_out=0),
        replace(peers_message(masked, 7), data=b"\0\0\0"),
        replace(peers_message(masked, 7), round=8),
        replace(peers_message(masked, 7), stage=Stage.SURVIVORS),
    ):
        with pytest.raises(PayloadError):
            party.answer(message)
    party.answer(peers_message(masked, 7))
    few = write_rows({(n, masked.ids[0]): bytes(148) for n in masked.ids[1:3]}, 2)
    with pytest.raises(PayloadError):
        party.answer(SecureMessage(Stage.BUNDLES, 7, 99, 5, 0, few))


def test_a_federation_under_masks_learns_as_one_without() -> None:
    losses, reported = {}, {}
    for masks in (True, False):
        federation = Federation(NAMES, replace(CONFIG, secure_aggregation=masks, rounds=8))
        run_in_process(federation.server, federation.clients, federation.train_many)
        assert [record.updates for record in federation.server.history] == [6] * 8
        losses[masks] = federation.loss()
        reported[masks] = federation.server.history[0].loss
    assert losses[True] == pytest.approx(losses[False], rel=1e-3)
    assert reported[True] == pytest.approx(reported[False], rel=1e-3)


def test_the_server_goes_on_with_those_who_are_left_and_starts_anew_with_too_few() -> None:
    federation = Federation(NAMES, CONFIG)
    server = federation.server
    keys = [client.answer(server.start(0.0)) for client in federation.clients]
    for update in keys[:5]:
        assert update is not None
        assert schema_of(update) == "secure"
        assert server.receive(update, 0.0) is None
    peers = server.tick(100.0)
    assert peers is not None
    shares = [client.assist(peers) for client in federation.clients[:5]]
    bundles = [server.receive(share, 101.0) for share in shares if share][-1]
    assert bundles is not None
    masked = [client.assist(bundles) for client in federation.clients[:5]]
    for message in masked[:2]:
        assert message is not None
        server.receive(message, 102.0)
    again = server.tick(200.0)
    assert again is not None
    assert schema_of(again) == "model", "two of five are too few: the round begins anew"
    assert server.round == 1
    # Fresh secrets, the same updates: nobody trains twice.
    keys = [client.answer(again) for client in federation.clients]
    assert all(schema_of(update or b"") == "secure" for update in keys)
    stale = shares[0]
    assert stale is not None
    with pytest.raises(PayloadError) as refused:
        server.receive(stale, 200.0)
    assert refused.value.reason == Refusal.OLD_ROUND


def test_a_client_started_again_has_dropped_out_and_keeps_its_update(tmp_path: Path) -> None:
    federation = Federation(NAMES, CONFIG, folder=tmp_path)
    payload = federation.server.start(0.0)
    first = federation.clients[0].answer(payload)
    restarted = federation.new_client(NAMES[0])
    peers = SecureMessage(Stage.PEERS, 1, 1, 1, 0, b"").unsigned() + bytes(64)
    assert restarted.assist(peers) is None
    again = restarted.receive(payload)
    assert again is not None
    assert again.ready
    assert again.ready != first, "with other secrets"


def test_masks_do_not_go_with_what_must_see_updates() -> None:
    for strategy in ("fedmedian", "multi_krum", "fedbuff"):
        with pytest.raises(FederationError, match="mean"):
            Federation(NAMES, CONFIG, lambda s=strategy: make_strategy(s))
    with pytest.raises(FederationError, match="3 or more"):
        Federation(NAMES[:2], CONFIG)
    with pytest.raises(FederationError, match="together"):
        replace(CONFIG, noise_multiplier=1.0)


@given(st.binary(max_size=200))
def test_any_bytes_are_rows_or_refused(data: bytes) -> None:
    for width, length in itertools.product((1, 2), (0, 64)):
        try:
            rows = read_rows(data, width, length)
        except PayloadError:
            continue
        assert read_rows(write_rows(rows, width), width, length) == rows


def test_strangers_are_not_let_in() -> None:
    federation = Federation(NAMES, CONFIG)
    payload = federation.server.start(0.0)
    stranger = FederatedClient(
        "stranger", federation.cameras[NAMES[0]].train, federation=FEDERATION
    )
    keys = stranger.answer(payload)
    assert keys is not None
    with pytest.raises(PayloadError) as refused:
        federation.server.receive(keys, 0.0)
    assert refused.value.reason == Refusal.UNKNOWN_SENDER
    forged = Participant(signer_id(NAMES[0]), 1, 2, np.zeros(3, np.float32)).keys().unsigned()
    with pytest.raises(PayloadError) as refused:
        federation.server.receive(signer_of(NAMES[1]).seal(forged), 0.0)
    assert refused.value.reason == Refusal.SIGNATURE
