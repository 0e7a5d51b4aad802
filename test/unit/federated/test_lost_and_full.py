"""A full disk, a lost checkpoint, a clock set back, other settings: nothing twice, all told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from federation_parts import (
    FEDERATION,
    Federation,
    first_tensors,
    key_of,
    roster_of,
    signer_of,
    update_of,
)

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import NewerStateError, StateFile
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.keys import Signer
from geoorbit_ros.federated.rounds import server_state
from geoorbit_ros.federated.rounds.client import FederatedClient
from geoorbit_ros.federated.rounds.epoch import MAX_RUN, Epochs
from geoorbit_ros.federated.rounds.server import RETRY_S, FederatedServer
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.strategies.server_optimizers import FedAdam, FedAvgM
from geoorbit_ros.federated.strategies.strategy import Strategy

NAMES = ("north", "south", "east")
CONFIG = ServerConfig(federation=FEDERATION, rounds=3, validation_divisor=0)


@contextmanager
def full_disk() -> Iterator[None]:
    def write(self: StateFile, _: bytes, *, sync: bool = True) -> None:
        del sync
        raise InputFileError(str(self.path), "No space left on device", "room")

    with patch.object(StateFile, "write", write):
        yield


def server_in(
    folder: Path, config: ServerConfig = CONFIG, strategy: Strategy | None = None
) -> FederatedServer:
    return FederatedServer(
        config,
        first_tensors(),
        roster_of(NAMES),
        strategy,
        signer_of("server"),
        folder / "server.npz",
        Epochs(folder / "server.key.run"),
    )


def client_in(folder: Path, name: str = "north", server: str = "server") -> FederatedClient:
    return FederatedClient(
        name,
        federation=FEDERATION,
        signer=signer_of(name),
        server_key=signer_of(server).public,
        state_path=folder / f"{name}.npz",
    )


def ones(server: FederatedServer) -> np.ndarray:
    return np.ones(server.layout.size, np.float32)


@pytest.mark.parametrize("strategy", [None, FedAdam, FedAvgM])
def test_updates_are_applied_once_although_the_disk_is_full_as_the_round_closes(
    tmp_path: Path, strategy: type[Strategy] | None
) -> None:
    folders = [tmp_path / name for name in ("full", "never")]
    models = []
    for folder in folders:
        folder.mkdir()
        server = server_in(folder, strategy=strategy() if strategy else None)
        server.start(0.0)
        for name in NAMES[:-1]:
            server.receive(update_of(server, name, ones(server)), 0.0)
        last = update_of(server, NAMES[-1], ones(server))
        if folder.name == "full":
            with full_disk():
                assert server.receive(last, 0.0) is None
                assert server.round == 1
                assert "No space left on device" in server.fault
                for k in range(5):  # it tries again, and nothing is made anew
                    assert server.tick(RETRY_S * (k + 1)) is None
                with pytest.raises(PayloadError) as refused:
                    server.receive(update_of(server, "north", ones(server)), 1.0)
                assert refused.value.reason is Refusal.OLD_ROUND
            assert server.tick(RETRY_S * 6) is not None
        else:
            assert server.receive(last, 0.0) is not None
        assert (server.round, server.fault) == (2, "")
        models.append(server.layout.flatten(server.tensors))
        again = server_in(folder, strategy=strategy() if strategy else None)
        np.testing.assert_array_equal(again.layout.flatten(again.tensors), models[-1])
    np.testing.assert_array_equal(models[0], models[1])


def test_a_client_answers_although_its_disk_is_full_and_saves_once_there_is_room(
    tmp_path: Path,
) -> None:
    federation = Federation(NAMES, replace(CONFIG, rounds=3), folder=tmp_path)
    north, payload = federation.clients[0], federation.server.start(0.0)
    with full_disk():
        assert north.answer(payload)
        assert "No space left on device" in north.fault
        for client in federation.clients[1:]:
            federation.server.receive(client.answer(payload) or b"", 0.0)
    assert federation.server.receive(north._state.update if north._state else b"", 0.0)
    assert federation.clients[0].answer(federation.server.latched[-1])
    assert not north.fault
    assert federation.new_client("north").answered == 2


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04 half a zip"])
def test_a_damaged_client_state_costs_one_generation_or_begins_anew(
    tmp_path: Path, content: bytes
) -> None:
    server = server_in(tmp_path)
    federation = Federation(NAMES, CONFIG, folder=tmp_path)
    federation.server = server
    payload = server.start(0.0)
    for client in federation.clients:
        server.receive(client.answer(payload) or b"", 0.0)
    federation.clients[0].answer(server.latched[-1])
    (tmp_path / "north.npz").write_bytes(content)
    before = client_in(tmp_path)
    assert before.answered == 1
    assert "north.npz.damaged" in before.notes[0]
    (tmp_path / "north.npz.previous").write_bytes(content)
    assert client_in(tmp_path).tensors is None


def test_a_damaged_checkpoint_goes_back_one_round_and_clients_follow(tmp_path: Path) -> None:
    server = server_in(tmp_path)
    payload = server.start(0.0)
    clients = [client_in(tmp_path, name) for name in NAMES]
    for name in NAMES:
        payload = server.receive(update_of(server, name, ones(server)), 0.0) or payload
    for client in clients:
        client.receive(payload)
        assert client.model_of[1] == 2
    (tmp_path / "server.npz").write_bytes(b"damage")
    again = server_in(tmp_path)
    payload = again.start(0.0)
    assert (again.round, again.run) == (1, server.run + 1)
    assert any("damage" in note for note in again.notes)
    for client in clients:
        client.receive(payload)
        assert client.model_of[:2] == (again.run, 1)
    (tmp_path / "server.npz").write_bytes(b"damage")
    (tmp_path / "server.npz.previous").write_bytes(b"damage")
    with pytest.raises(FederationError, match=r"server\.npz"):
        server_in(tmp_path)


def test_a_lost_checkpoint_and_a_clock_set_back_end_no_federation(tmp_path: Path) -> None:
    server = server_in(tmp_path, replace(CONFIG, run=1_800_000_000))
    client = client_in(tmp_path)
    client.receive(server.start(0.0))
    (tmp_path / "server.npz").unlink()
    early = replace(CONFIG, run=5)  # 1970
    again = server_in(tmp_path, early)
    client.receive(again.start(0.0))
    assert client.model_of[0] == again.run == 1_800_000_001
    for name in ("server.npz", "server.npz.previous", "server.key.run"):
        (tmp_path / name).unlink(missing_ok=True)
    lost = server_in(tmp_path, early)
    with pytest.raises(PayloadError, match="Give it a new key"):
        client.receive(lost.start(0.0))
    client.answer(again.latched[-1]) if again.latched else None
    renewed = FederatedServer(
        early, first_tensors(), roster_of(NAMES), None, Signer(key_of("second"), FEDERATION)
    )
    with_new_key = client_in(tmp_path, server="second")
    with_new_key.receive(renewed.start(0.0))
    assert with_new_key.model_of[0] == renewed.run


def test_what_was_learned_under_another_key_is_left(tmp_path: Path) -> None:
    federation = Federation(NAMES, CONFIG, folder=tmp_path)
    federation.clients[0].answer(federation.server.start(0.0))
    assert client_in(tmp_path).tensors is not None
    other = client_in(tmp_path, server="second")
    assert other.tensors is None
    assert "another key" in other.notes[0]


def test_rounds_that_are_added_after_the_end_are_trained(tmp_path: Path) -> None:
    config = replace(CONFIG, rounds=1)
    server = server_in(tmp_path, config)
    client = client_in(tmp_path)
    payload = server.start(0.0)
    for name in NAMES:
        payload = server.receive(update_of(server, name, ones(server)), 0.0) or payload
    client.receive(payload)
    assert client.finished
    assert server.finished
    assert server_in(tmp_path, config).finished
    more = server_in(tmp_path, replace(config, rounds=3))
    assert not more.finished
    assert any("goes on to 3 rounds" in note for note in more.notes)
    work = client.receive(more.start(0.0))
    assert work is not None
    assert work.order.train
    np.testing.assert_array_equal(
        more.layout.flatten(more.tensors), server.layout.flatten(server.tensors)
    )
    for _ in range(2):
        for name in NAMES:
            more.receive(update_of(more, name, ones(more)), 0.0)
    assert server_in(tmp_path, replace(config, rounds=3)).finished
    assert [record.round for record in more.history] == [1, 2, 3]


def test_another_strategy_says_that_it_starts_without_memory(tmp_path: Path) -> None:
    server = server_in(tmp_path, strategy=FedAdam())
    server.start(0.0)
    for name in NAMES:
        server.receive(update_of(server, name, ones(server)), 0.0)
    assert server_in(tmp_path, strategy=FedAdam()).notes == []
    assert server_in(tmp_path, strategy=FedAvgM()).notes == [
        "the checkpoint is of FedAdam: FedAvgM starts without its memory"
    ]


@pytest.mark.parametrize("version", [1, 2, 99])
def test_checkpoints_say_their_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    server = server_in(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(server_state, "FORMAT", version)
        server.start(0.0)
    if version > 3:
        with pytest.raises(NewerStateError, match="format 99, of a newer version"):
            server_in(tmp_path)
        assert not list(tmp_path.glob("*.damaged"))
    else:
        assert server_in(tmp_path).resumed


def test_runs_only_grow(tmp_path: Path) -> None:
    file = tmp_path / "server.key.run"
    assert Epochs(file).next(100) == 100
    Epochs(file).note(100)
    assert Epochs(file).next(5) == 101
    assert Epochs(file).next(5, known=200) == 201
    assert Epochs(None).next(5) == 5
    file.write_text("rubbish")
    damaged = Epochs(file)
    assert damaged.next(7) == 7
    assert "damage" in damaged.told[0]
    with pytest.raises(FederationError, match="clock"):
        Epochs(None).next(MAX_RUN + 1)
