"""Rounds: who is asked, what is waited for, what is refused, and what comes of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from federation_parts import (
    FEDERATION,
    Camera,
    Federation,
    first_tensors,
    roster_of,
    signer_id,
    signer_of,
    update_of,
)

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.plugins import registered
from geoorbit_ros.federated.encodings.int8 import Int8
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.keys import Member, Roster, read_private_key, write_private_key
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.federated.rounds.in_process import run_in_process
from geoorbit_ros.federated.rounds.selection import make_selection
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.strategies.fedbuff import FedBuff
from geoorbit_ros.federated.strategies.strategy import StrategySettings, make_strategy

NAMES = tuple(f"camera_{k}" for k in range(6))
CONFIG = ServerConfig(federation=FEDERATION, rounds=5, deadline_s=100.0)
ZERO = np.zeros(53, np.float32)


def server_with(**changes: object) -> FederatedServer:
    config = replace(CONFIG, **changes)  # type: ignore[arg-type]
    return FederatedServer(config, first_tensors(), roster_of(NAMES), signer=signer_of("server"))


def refusal_of(server: FederatedServer, payload: bytes) -> Refusal:
    before = server.refused.total()
    with pytest.raises(PayloadError) as refused:
        server.receive(payload, 0.0)
    assert server.refused.total() == before + 1
    assert server.refused[refused.value.reason] >= 1
    return refused.value.reason


def test_a_federation_learns_what_its_members_know_together() -> None:
    federation = Federation(NAMES, replace(CONFIG, rounds=15))
    before = federation.loss()
    traffic = run_in_process(federation.server, federation.clients, federation.train_many)
    server = federation.server
    assert federation.loss() < 0.1 * before
    assert server.finished
    assert [record.round for record in server.history] == list(range(1, 16))
    losses = [record.loss for record in server.history]
    assert losses == sorted(losses, reverse=True)
    assert (traffic.up_messages, traffic.down_messages) == (15 * 6, 16 * 6)
    for client in federation.clients:
        assert client.finished
        for name, tensor in server.published.items():
            assert client.tensors is not None
            np.testing.assert_array_equal(client.tensors[name], tensor)


@pytest.mark.parametrize("name", registered("strategy"))
def test_every_strategy_learns(name: str) -> None:
    settings = StrategySettings(buffer_size=3, server_learning_rate=0.3, momentum=0.5)
    federation = Federation(
        NAMES, replace(CONFIG, rounds=15), lambda: make_strategy(name, settings)
    )
    before = federation.loss()
    run_in_process(federation.server, federation.clients, federation.train_many)
    assert federation.loss() < 0.5 * before
    assert len(federation.server.history) == 15


def test_one_round_is_the_weighted_mean_of_the_members() -> None:
    server = server_with()
    server.start(0.0)
    for k, name in enumerate(NAMES):
        vector = np.full(53, k, np.float32)
        server.receive(update_of(server, name, vector, sample_count=k + 1, loss=float(k)), 3.0)
    weights = np.arange(1, 7)
    mean = np.average(np.arange(6), weights=weights)
    before = server.layout.flatten(first_tensors())
    np.testing.assert_allclose(server.layout.flatten(server.tensors), before + mean, rtol=1e-6)
    record = server.history[0]
    assert (record.round, record.updates, record.seconds) == (1, 6, 3.0)
    assert record.loss == pytest.approx(mean)


def test_training_stops_at_the_target_loss() -> None:
    server = server_with(target_loss=0.5)
    server.start(0.0)
    for name in NAMES:
        server.receive(update_of(server, name, ZERO, loss=0.5), 0.0)
    assert server.finished
    assert len(server.history) == 1
    late = update_of(server, NAMES[0], ZERO)
    assert refusal_of(server, late) == Refusal.OLD_ROUND
    assert server.tick(1e9) is None


@pytest.mark.parametrize("selection", ["random", "round_robin", "importance"])
def test_a_subset_is_asked_and_nobody_else_is_heard(selection: str) -> None:
    server = server_with(clients_per_round=2, selection=selection)
    clients = {
        name: FederatedClient(name, federation=FEDERATION, signer=signer_of(name)) for name in NAMES
    }
    payload: bytes | None = server.start(0.0)
    asked = []
    while payload is not None and not server.finished:
        work = {name: client.receive(payload) for name, client in clients.items()}
        chosen = sorted(name for name, job in work.items() if job is not None)
        assert len(chosen) == 2
        assert {signer_id(name) for name in chosen} == server.selected
        other = next(name for name in NAMES if name not in chosen)
        assert refusal_of(server, update_of(server, other, ZERO)) == Refusal.NOT_SELECTED
        payload = [server.receive(update_of(server, name, ZERO), 0.0) for name in chosen][-1]
        asked.append(tuple(chosen))
    assert len(set(asked)) > 1
    if selection == "round_robin":
        assert sorted(sum(asked[:3], ())) == sorted(NAMES)


def test_importance_prefers_those_with_more_to_learn() -> None:
    clients = list(range(10))
    utility = np.array([20.0] + [1.0] * 9)
    choice = make_selection("importance", 0)
    chosen = [choice.choose(clients, 2, n, utility) for n in range(1, 301)]
    counts = np.bincount(np.ravel(chosen), minlength=10)
    assert counts[0] > 2 * counts[1:].max()
    assert counts.min() > 0, "nobody is forgotten: losses change"
    assert chosen == [choice.choose(clients, 2, n, utility) for n in range(1, 301)]


def test_the_deadline_ends_a_round_with_a_quorum() -> None:
    server = server_with(quorum=0.5)
    server.start(10.0)
    for name in NAMES[:2]:
        server.receive(update_of(server, name, ZERO), 20.0)
    assert server.tick(109.9) is None
    assert server.round == 1
    server.receive(update_of(server, NAMES[2], ZERO), 100.0)
    assert server.tick(109.9) is None
    assert server.tick(110.0) is not None
    assert (server.round, server.history[0].updates) == (2, 3)
    straggler = update_of(server, NAMES[5], ZERO, round=1, model=server._state.digests[1])
    assert refusal_of(server, straggler) == Refusal.OLD_ROUND


def test_without_a_quorum_the_round_is_opened_to_all_and_keeps_what_it_has() -> None:
    server = server_with(clients_per_round=3, quorum=0.6)
    server.start(0.0)
    first = server.selected
    one = next(name for name in NAMES if signer_id(name) in first)
    others = [name for name in NAMES if signer_id(name) not in first]
    server.receive(update_of(server, one, ZERO), 0.0)
    again = server.tick(100.0)
    assert again is not None
    assert server.round == 1
    joiner = FederatedClient(others[0], federation=FEDERATION, signer=signer_of(others[0]))
    assert joiner.receive(again) is not None
    assert server.receive(update_of(server, others[0], ZERO), 150.0) is None
    assert server.tick(199.0) is None
    assert server.tick(200.0) is not None
    assert (server.round, server.history[0].updates) == (2, 2)


def test_a_refused_update_leaves_no_trace() -> None:
    server = server_with()
    server.start(0.0)
    size, north = server.layout.size, NAMES[0]
    good = update_of(server, north, ZERO)
    nan, huge = ZERO.copy(), ZERO.copy()
    nan[3], huge[3] = np.nan, 1001.0
    cases = {
        Refusal.TOO_LONG: good + bytes(5 * size + 512),
        Refusal.TRUNCATED: good[:-1],
        Refusal.FOREIGN: server.latched[0],
        Refusal.VERSION: good[:16] + b"\x09" + good[17:],
        Refusal.UNKNOWN_SENDER: update_of(server, "stranger", ZERO),
        Refusal.OLD_ROUND: update_of(server, north, ZERO, round=0),
        Refusal.FUTURE_ROUND: update_of(server, north, ZERO, round=2),
        Refusal.OTHER_MODEL: update_of(server, north, ZERO, model=1),
        Refusal.SIGNATURE: good[:-64] + bytes(64),
        Refusal.ENCODING: update_of(server, north, ZERO, encoding=77),
        Refusal.SHAPE: update_of(server, north, ZERO[:-1]),
        Refusal.NOT_FINITE: update_of(server, north, nan),
        Refusal.OUT_OF_RANGE: update_of(server, north, huge),
    }
    for reason, payload in cases.items():
        assert refusal_of(server, payload) == reason
    huge_count = update_of(server, north, ZERO, sample_count=2**31)
    assert refusal_of(server, huge_count) == Refusal.OUT_OF_RANGE
    validated = update_of(server, north, ZERO[:0], sample_count=0)
    assert refusal_of(server, validated) == Refusal.NOT_SELECTED
    assert refusal_of(server, update_of(server, north, ZERO, loss=np.inf)) == Refusal.NOT_FINITE
    assert (server.collected, server.accepted) == (0, 0)
    server.receive(good, 0.0)
    assert refusal_of(server, good) == Refusal.DUPLICATE
    assert server.collected == 1


def test_an_update_of_another_federation_or_another_key_is_no_signature() -> None:
    server = server_with()
    server.start(0.0)
    good = update_of(server, NAMES[0], ZERO)
    for signer in (signer_of(NAMES[0], "elsewhere"), signer_of(NAMES[1])):
        assert refusal_of(server, signer.seal(good[:-64])) == Refusal.SIGNATURE


def test_a_late_joiner_gets_the_model_and_takes_part() -> None:
    config = replace(CONFIG, encoding="int8", rounds=6)
    federation = Federation(NAMES, config, encoding=Int8())
    server, early = federation.server, federation.clients[:5]
    payload: bytes | None = server.start(0.0)
    for _ in range(3):
        assert payload is not None
        for client in early:
            update = client.answer(payload)
            assert update is not None
            assert server.receive(update, 0.0) is None
        payload = server.tick(server._deadline_s)
    late = federation.clients[5]
    work = [late.receive(earlier) for earlier in server.latched][-1]
    assert len(server.latched) == 4, "the first model and three changes"
    assert work is not None
    assert late.tensors is not None
    for name, tensor in server.published.items():
        np.testing.assert_array_equal(late.tensors[name], tensor)
    update = late.finish(work, federation.cameras[NAMES[5]].train(work.tensors, work.order))
    assert update is not None
    server.receive(update, 0.0)
    assert server.collected == 1


def test_clients_refuse_what_is_not_from_their_server() -> None:
    server = server_with(encoding="int8")
    payload = server.start(0.0)
    public = signer_of("server").public

    def client(**arguments: object) -> FederatedClient:
        return FederatedClient("camera_0", federation=FEDERATION, **arguments)  # type: ignore

    def reason(listener: FederatedClient, sent: bytes) -> Refusal:
        with pytest.raises(PayloadError) as refused:
            listener.receive(sent)
        assert listener.refused[refused.value.reason] == 1
        return refused.value.reason

    assert reason(client(server_key=signer_of("other").public), payload) == Refusal.SIGNATURE
    assert reason(client(interface=5), payload) == Refusal.SHAPE
    good = client(server_key=public)
    assert good.receive(payload) is not None
    delta = [server.receive(update_of(server, name, ZERO), 0.0) for name in NAMES][-1]
    assert delta is not None
    assert reason(client(server_key=public), delta) == Refusal.OTHER_MODEL
    forged = signer_of("other").seal(delta[:-64])
    assert reason(good, forged) == Refusal.SIGNATURE
    assert good.model_of[1] == 1
    assert good.receive(delta) is not None
    assert reason(good, payload) == Refusal.OLD_ROUND
    # A federation that began later replaces this one; an earlier one does not.
    assert good.receive(server_with(run=2).start(0.0)) is not None
    assert good.model_of[:2] == (2, 1)
    good.refused.clear()
    assert reason(good, payload) == Refusal.OLD_ROUND


def test_a_client_sends_the_same_update_again_and_learns_once() -> None:
    server = server_with()
    calls = []
    camera = Camera.drawn(1)

    def train(tensors: object, order: object) -> object:
        calls.append(order)
        return camera.train(tensors, order)  # type: ignore[arg-type]

    client = FederatedClient(NAMES[0], train, federation=FEDERATION)  # type: ignore[arg-type]
    payload = server.start(0.0)
    assert client.answer(payload) == client.answer(payload)
    assert len(calls) == 1


def test_fedbuff_takes_late_updates_and_forgets_very_late_ones() -> None:
    strategy = FedBuff(buffer_size=2)
    config = replace(CONFIG, max_staleness=1)
    server = FederatedServer(config, first_tensors(), roster_of(NAMES), strategy)
    server.start(0.0)
    first = {"round": 1, "model": server._state.digests[1]}
    one = ZERO + np.float32(1)
    assert server.receive(update_of(server, NAMES[0], one), 0.0) is None
    assert server.receive(update_of(server, NAMES[1], one), 0.0) is not None
    assert refusal_of(server, update_of(server, NAMES[0], one, **first)) == Refusal.DUPLICATE
    server.receive(update_of(server, NAMES[2], one, **first), 0.0)
    server.receive(update_of(server, NAMES[0], one), 0.0)
    # 1 from the first two, then (1/√2 + 1) / 2.
    before = server.layout.flatten(first_tensors())
    change = server.layout.flatten(server.tensors) - before
    np.testing.assert_allclose(change, 1 + (2**-0.5 + 1) / 2, rtol=1e-5)
    assert refusal_of(server, update_of(server, NAMES[3], one, **first)) == Refusal.OLD_ROUND


def test_settings_and_rosters_that_make_no_sense_are_named() -> None:
    with pytest.raises(ParameterError, match="encoding"):
        replace(CONFIG, encoding="x")
    for name, value in (("quorum", 1.5), ("rounds", 0), ("selection", "best")):
        with pytest.raises(FederationError, match=name):
            server_with(**{name: value})
    with pytest.raises(FederationError, match="twice"):
        Roster([Member("a", None), Member("a", bytes(32))])
    with pytest.raises(FederationError, match="no camera"):
        Roster([])


def test_keys_and_rosters_are_files(tmp_path: Path) -> None:
    public = write_private_key(tmp_path / "north.key")
    assert (tmp_path / "north.key").stat().st_mode & 0o77 == 0
    with pytest.raises(FederationError, match=r"north\.key"):
        write_private_key(tmp_path / "north.key")
    assert len(read_private_key(tmp_path / "north.key")) == 32
    roster = tmp_path / "roster.txt"
    roster.write_text(f"# cameras\nnorth {public.hex()}\nsouth unsigned  # without a key\n")
    members = [Roster.read(roster).get(number) for number in Roster.read(roster)]
    assert {m.camera_id: m.public for m in members if m} == {"north": public, "south": None}
    assert Roster.read(roster).unsigned == ("south",)
    for line in ("south\n", f"north {public.hex()} x\n"):
        roster.write_text(line)
        with pytest.raises(FederationError, match=r"roster\.txt, line 1: .*, or '\w+ unsigned'"):
            Roster.read(roster)
    roster.write_text(f"north {public.hex()}\n")
    with pytest.raises(FederationError, match="'north' with the server's key"):
        Roster.read(roster, public)
    roster.write_text("north 12ab\n")
    with pytest.raises(FederationError, match=r"roster\.txt, line 1"):
        Roster.read(roster)
    with pytest.raises(FederationError, match=r"nothing\.key"):
        read_private_key(tmp_path / "nothing.key")
