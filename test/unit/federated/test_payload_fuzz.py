"""Any byte string on any parameter topic is refused with a reason, or valid: never a crash."""

import copy
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from federation_parts import Camera, first_tensors, roster_of, update_of
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.federated.encodings.encoding import EncodingSettings, make_encoding
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.keys import Member, Roster, Signer, Verifier
from geoorbit_ros.federated.payloads.lane_parameters import ThetaInbox, ThetaPayload
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.update_checks import UpdateChecks
from geoorbit_ros.lanes.parameters import LaneParameters

CASES = {
    "client_update": 35_000,
    "global_model": 35_000,
    "lane_parameters": 35_000,
    "masked_client_update": 10_000,
    "secure_aggregation": 4_000,  # a valid one costs its reader milliseconds of key agreement
}
Take = Callable[[bytes], object]

# Unsigned, so that a changed byte is checked by what it says and not by its signature.
NAMES = ("north", "south", "west")
CONFIG = ServerConfig(encoding="top_k", rounds=9, validation_divisor=1)
SERVER = FederatedServer(CONFIG, first_tensors(), Roster(Member(n, None) for n in NAMES))
WHOLE = SERVER.start(0.0)
CLIENTS = [
    FederatedClient(n, Camera.drawn(k).train, encoding=make_encoding(e, EncodingSettings(0.3)))
    for k, (n, e) in enumerate(zip(NAMES, ("top_k", "int8", "float32"), strict=True))
]
UPDATES = [update for client in CLIENTS if (update := client.answer(WHOLE))]
THETA = ThetaPayload("north", 5, 6, 7, {"smoothing": 9.5, "angle": 0.25, "width_scale": 1.5})


def server_topic() -> tuple[Take, list[bytes]]:
    admission = UpdateChecks(
        CONFIG,
        Roster(Member(n, None) for n in NAMES),
        SERVER.layout.size,
        asynchronous=False,
    )
    state = SERVER._state
    return (lambda payload: admission.check(payload, state, frozenset())), UPDATES


def client_topic() -> tuple[Take, list[bytes]]:
    client = FederatedClient("north")
    client.receive(WHOLE)
    server = FederatedServer(CONFIG, first_tensors(), Roster(Member(n, None) for n in NAMES))
    server.start(0.0)
    delta = [server.receive(update, 0.0) for update in UPDATES][-1]
    assert delta is not None
    kept = client._state

    def take(payload: bytes) -> object:
        client._state = copy.copy(kept)
        return client.receive(payload)

    return take, [WHOLE, delta]


def theta_topic() -> tuple[Take, list[bytes]]:
    inbox = ThetaInbox("north", Verifier(None, "geoorbit"))

    def take(payload: bytes) -> object:
        inbox._newest = (THETA.run, THETA.round)
        return inbox.take(payload, LaneParameters())

    return take, [Signer(None, "geoorbit").seal(THETA.unsigned())]


MASKED = replace(CONFIG, encoding="float32", secure_aggregation=True)


def masked_server() -> tuple[FederatedServer, list[FederatedClient], list[bytes]]:
    """A server under masks, its clients, and their keys."""
    members = Roster(Member(n, None) for n in NAMES)
    server = FederatedServer(MASKED, first_tensors(), members)
    start = server.start(0.0)
    clients = [FederatedClient(n, Camera.drawn(k).train) for k, n in enumerate(NAMES)]
    return server, clients, [keys for client in clients if (keys := client.answer(start))]


def masked_server_topic() -> tuple[Take, list[bytes]]:
    server, clients, keys = masked_server()
    peers = [server.receive(payload, 0.0) for payload in keys][-1]
    assert peers is not None
    shares = [step for client in clients if (step := client.assist(peers))]
    assert server._masked is not None
    coordinator = server._masked.coordinator

    def take(payload: bytes) -> object:
        coordinator._came.clear()  # so that the steps are never complete
        message = server._checks.check_masked(payload, server._state, frozenset())
        coordinator.take(message)
        return message

    return take, shares


def masked_client_topic() -> tuple[Take, list[bytes]]:
    server, clients, keys = masked_server()
    peers = [server.receive(payload, 0.0) for payload in keys][-1]
    assert peers is not None
    client = clients[0]
    kept = client._masked._participant
    assert kept is not None

    def take(payload: bytes) -> object:
        client._masked._participant = copy.copy(kept)
        client._masked._participant._held = {}
        return client.assist(payload)

    return take, [peers]


TOPICS = {
    "client_update": server_topic,
    "global_model": client_topic,
    "lane_parameters": theta_topic,
    "masked_client_update": masked_server_topic,
    "secure_aggregation": masked_client_topic,
}


def mutations(valid: list[bytes], number: int, seed: int) -> Iterator[bytes]:
    """Valid payloads with bytes changed, cut, repeated, or nothing but noise."""
    generator = np.random.default_rng(seed)
    kinds = generator.integers(0, 6, number)
    picks = generator.integers(0, len(valid), number)
    draws = generator.integers(0, 2**32, (number, 3), dtype=np.uint64)
    special = (0, 1, 0x7F, 0x80, 0xFF)
    for kind, pick, (a, b, c) in zip(kinds.tolist(), picks.tolist(), draws.tolist(), strict=True):
        payload = bytearray(valid[pick])
        at = a % len(payload)
        if kind == 0:
            payload[at] ^= 1 << (b % 8)
        elif kind == 1:
            payload[at] = special[b % 5]
        elif kind == 2:  # a length or a number, all of it
            at = min(a % 96, len(payload) - 4) & ~3
            payload[at : at + 4] = (c if b % 2 else c % 1000).to_bytes(4, "little")
        elif kind == 3:
            del payload[at:]
        elif kind == 4:
            payload[at:at] = payload[b % len(payload) :][: c % 40]
        else:
            payload = bytearray(generator.bytes(b % 200))
        yield bytes(payload)


@pytest.mark.parametrize("topic", TOPICS)
def test_a_changed_payload_is_refused_or_valid(topic: str) -> None:
    take, valid = TOPICS[topic]()
    for payload in valid:
        take(payload)
    outcomes: Counter[str] = Counter()
    for payload in mutations(valid, CASES[topic], seed=1):
        try:
            take(payload)
            outcomes["valid"] += 1
        except PayloadError as error:
            outcomes[error.reason] += 1
    assert sum(outcomes.values()) == CASES[topic]
    # The cases reach every check that this topic has.
    expected = {"valid", Refusal.TRUNCATED, Refusal.FOREIGN, Refusal.VERSION, Refusal.TOO_LONG}
    expected |= {Refusal.OLD_ROUND}
    if topic != "secure_aggregation":
        expected |= {Refusal.SHAPE}
    assert expected <= set(outcomes), outcomes
    if topic == "client_update":
        expected = {
            Refusal.UNKNOWN_SENDER,
            Refusal.OTHER_MODEL,
            Refusal.OUT_OF_RANGE,
            Refusal.NOT_FINITE,
            Refusal.ENCODING,
            Refusal.MALFORMED,
        }
        assert expected <= set(outcomes), outcomes


@pytest.mark.parametrize("topic", TOPICS)
@given(payload=st.binary(max_size=300))
def test_noise_is_refused(topic: str, payload: bytes) -> None:
    take, _ = TOPICS[topic]()
    with pytest.raises(PayloadError):
        take(payload)


def test_a_payload_of_the_largest_length_costs_no_memory() -> None:
    for name in TOPICS:
        take, valid = TOPICS[name]()
        with pytest.raises(PayloadError) as refused:
            take(valid[0] + bytes((1 << 26) + 1))
        assert refused.value.reason == Refusal.TOO_LONG


def test_a_signature_is_worth_nothing_with_another_byte_before_it() -> None:
    server = FederatedServer(
        ServerConfig(federation="test"), first_tensors(), roster_of(NAMES), signer=None
    )
    server.start(0.0)
    size = server.layout.size
    update = update_of(server, "north", np.zeros(size, np.float32))
    generator = np.random.default_rng(0)
    for at in generator.integers(0, len(update), 300).tolist():
        forged = bytearray(update)
        forged[at] ^= 1 << int(generator.integers(8))
        with pytest.raises(PayloadError):
            server.receive(bytes(forged), 0.0)
    assert server.refused[Refusal.SIGNATURE] > 100
    assert server.collected == 0
    server.receive(update, 0.0)
    assert server.collected == 1
