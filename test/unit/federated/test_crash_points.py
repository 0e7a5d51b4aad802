"""Kill the server or a client at any point of any round: the final model has the same bits."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from federation_parts import FEDERATION, Federation, signer_id

from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.encodings.encoding import EncodingSettings, make_encoding
from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.rounds import client as client_module
from geoorbit_ros.federated.rounds import server as server_module
from geoorbit_ros.federated.rounds.server_config import ServerConfig
from geoorbit_ros.federated.rounds.server_state import KIND, Answers, read_checkpoint
from geoorbit_ros.federated.strategies.fedbuff import FedBuff
from geoorbit_ros.federated.strategies.server_optimizers import FedAdam

NAMES = ("north", "south", "east")
ROUNDS = 3
SERVER = "server"
CONFIG = ServerConfig(
    federation=FEDERATION,
    rounds=ROUNDS,
    validation_divisor=1,
    encoding="top_k",
    top_k_share=0.3,
    deadline_s=10.0,
)
CLIENT_SAVES = 18
"""One per client, round and final judgement; one more where the model in use is an earlier one."""
HARMLESS = {Refusal.DUPLICATE, Refusal.OLD_ROUND, Refusal.OTHER_MODEL}


class Killed(BaseException):
    """What `kill -9` is to the code that runs."""


@dataclass
class Network:
    """Delivers payloads in order and can kill whoever handles the next one."""

    federation: Federation
    queue: deque[tuple[str, bytes]] = field(default_factory=deque)
    now_s: float = 0.0
    steps: int = 0
    handling: str = ""

    def broadcast(self, payload: bytes | None) -> None:
        if payload is not None:
            self.queue.extend((name, payload) for name in NAMES)

    def restart(self, victim: str, keep_messages: bool) -> None:
        """A new process: only its file is left; messages to it may be lost."""
        if not keep_messages:
            self.queue = deque((to, payload) for to, payload in self.queue if to != victim)
        federation = self.federation
        if victim == SERVER:
            federation.server = federation.new_server()
            self.broadcast(federation.server.start(self.now_s))
            return
        federation.clients[NAMES.index(victim)] = federation.new_client(victim)
        latched = [(victim, payload) for payload in federation.server.latched]
        self.queue.extend(latched)

    def deliver(self, to: str, payload: bytes) -> None:
        self.handling = to
        try:
            if to == SERVER:
                self.broadcast(self.federation.server.receive(payload, self.now_s))
            else:
                update = self.federation.clients[NAMES.index(to)].answer(payload)
                self.queue.extend([(SERVER, update)] if update else [])
        except PayloadError as error:
            assert error.reason in HARMLESS, error

    def run(
        self,
        kill_at: int | None,
        victim: str,
        keep_messages: bool = True,
        stop_at: int | None = None,
    ) -> None:
        self.broadcast(self.federation.server.start(self.now_s))
        self.run_on(kill_at, victim, keep_messages, stop_at)

    def run_on(
        self,
        kill_at: int | None = None,
        victim: str = "",
        keep_messages: bool = True,
        stop_at: int | None = None,
    ) -> None:
        while not self.federation.server.finished and self.steps != stop_at:
            if self.steps == kill_at:
                self.restart(victim, keep_messages)
            self.steps += 1
            if self.queue:
                self.deliver(*self.queue.popleft())
            else:
                self.now_s += 10.0
                self.broadcast(self.federation.server.tick(self.now_s))
            assert self.steps < 500


@pytest.fixture(autouse=True)
def no_power_loss_here() -> Iterator[None]:
    with patch("os.fsync"):  # the kernel keeps what a killed process wrote
        yield


def federation_in(folder: Path, config: ServerConfig = CONFIG, strategy: Any = FedAdam) -> Network:
    return Network(
        Federation(NAMES, config, strategy, make_encoding("top_k", EncodingSettings(0.3)), folder)
    )


Result = tuple[bytes, str, list[int]]


def final_bits(network: Network) -> Result:
    """Final model, what was said of each round's, and what every client uses in the end."""
    server = network.federation.server
    assert [record.updates for record in server.history][:ROUNDS] == [len(NAMES)] * ROUNDS
    while network.queue:  # the last announcement
        network.deliver(*network.queue.popleft())
    told = repr([replace(record, seconds=0.0) for record in server.history])
    used = [client.used for client in network.federation.clients]
    return server.layout.flatten(server.tensors).tobytes(), told, used


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, int]:
    network = federation_in(tmp_path_factory.mktemp("whole"))
    network.run(None, SERVER)
    steps = network.steps
    result = final_bits(network)
    assert len(set(result[2])) == 1
    assert result[2][0] != 0
    return result, steps


@pytest.mark.parametrize("keep_messages", [True, False], ids=["delivered", "lost"])
@pytest.mark.parametrize("victim", [SERVER, NAMES[0]])
def test_killed_between_any_two_messages(
    tmp_path: Path, uninterrupted: tuple[Result, int], victim: str, keep_messages: bool
) -> None:
    expected, steps = uninterrupted
    assert steps >= 2 * ROUNDS * len(NAMES)
    for kill_at in range(1, steps):
        folder = tmp_path / str(kill_at)
        folder.mkdir()
        network = federation_in(folder)
        network.run(kill_at, victim, keep_messages)
        assert final_bits(network) == expected, f"killed before message {kill_at}"


def test_killed_between_any_two_messages_where_some_only_judge(tmp_path: Path) -> None:
    numbers = {name: signer_id(name) for name in NAMES}
    divisor = next(d for d in range(2, 99) if sum(n % d == 0 for n in numbers.values()) == 2)
    validating = next(name for name, number in numbers.items() if number % divisor == 0)
    config = replace(CONFIG, validation_divisor=divisor)

    def result(folder: Path, kill_at: int | None, victim: str) -> tuple[bytes, str]:
        folder.mkdir()
        network = federation_in(folder, config)
        network.run(kill_at, victim, keep_messages=False)
        server = network.federation.server
        told = repr([replace(record, seconds=0.0) for record in server.history])
        assert [(r.updates, r.validation_clients) for r in server.history] == [
            *[(1, 2)] * ROUNDS,
            (0, 2),
        ]
        return server.layout.flatten(server.tensors).tobytes(), told

    expected = result(tmp_path / "whole", None, SERVER)
    for victim in (SERVER, validating):
        for kill_at in range(1, 22):
            found = result(tmp_path / f"{victim} {kill_at}", kill_at, victim)
            assert found == expected, f"{victim} killed before message {kill_at}"


@contextmanager
def killed_while_saving(module: Any, function: str, call: int, after: bool) -> Iterator[list[int]]:
    """Ends the process in its n-th save, just before or just after the file is replaced."""
    real, calls = getattr(module, function), [0]

    def save(*arguments: Any) -> None:
        calls[0] += 1
        if calls[0] != call:
            real(*arguments)
            return
        if after:
            real(*arguments)
        raise Killed

    with patch.object(module, function, save):
        yield calls


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("call", range(2, ROUNDS + 3))
def test_the_server_killed_while_it_saves(
    tmp_path: Path, uninterrupted: tuple[Result, int], call: int, after: bool
) -> None:
    network = federation_in(tmp_path)
    with killed_while_saving(server_module, "write_checkpoint", call, after) as calls:
        with pytest.raises(Killed):
            network.run(None, SERVER)
        assert calls[0] == call
        network.restart(SERVER, keep_messages=False)
        network.run_on()
    assert final_bits(network) == uninterrupted[0]


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("call", range(1, CLIENT_SAVES + 1))
def test_a_client_killed_while_it_saves(
    tmp_path: Path, uninterrupted: tuple[Result, int], call: int, after: bool
) -> None:
    network = federation_in(tmp_path)
    with killed_while_saving(client_module, "write_client_state", call, after):
        with pytest.raises(Killed):
            network.run(None, SERVER)
        network.restart(network.handling, keep_messages=False)
        network.run_on()
    assert final_bits(network) == uninterrupted[0]


def test_everybody_killed_at_once(tmp_path: Path, uninterrupted: tuple[Result, int]) -> None:
    for kill_at in range(1, uninterrupted[1], 2):
        folder = tmp_path / str(kill_at)
        folder.mkdir()
        network = federation_in(folder)
        network.run(None, SERVER, stop_at=kill_at)
        network.queue.clear()
        for victim in (*NAMES, SERVER):
            network.restart(victim, keep_messages=False)
        network.run_on()
        assert final_bits(network) == uninterrupted[0], f"killed before message {kill_at}"


def test_an_asynchronous_server_goes_on(tmp_path: Path) -> None:
    config = replace(CONFIG, rounds=6, validation_divisor=0, max_staleness=3)
    for kill_at in range(2, 30, 3):
        folder = tmp_path / str(kill_at)
        folder.mkdir()
        network = federation_in(folder, config, lambda: FedBuff(2, 0.5))
        network.run(kill_at, SERVER)
        assert [record.updates for record in network.federation.server.history] == [2] * 6


def test_a_checkpoint_is_read_as_it_was_written(tmp_path: Path) -> None:
    network = federation_in(tmp_path)
    network.run(None, SERVER)
    server = network.federation.server
    answers = Answers(server._state.answers.members)
    saved = read_checkpoint(StateFile(tmp_path / "server.npz", KIND), server.layout, answers)
    assert saved is not None
    for name in ("run", "round", "trained", "finished", "approved", "digests", "secret"):
        assert getattr(saved, name) == getattr(server._state, name), name
    assert repr(saved.history) == repr(server._state.history)  # NaN is not equal to itself
    np.testing.assert_array_equal(answers.answered, server._state.answers.answered)
    np.testing.assert_array_equal(answers.utility, server._state.answers.utility)
    np.testing.assert_array_equal(saved.model, server._state.model)
    np.testing.assert_array_equal(saved.optimiser["moments"], server._state.optimiser["moments"])
