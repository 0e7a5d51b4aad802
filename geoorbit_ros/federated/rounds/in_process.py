"""A whole federation in one process, through the real state machines and the real wire format."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal
from geoorbit_ros.federated.payloads.header import schema_of
from geoorbit_ros.federated.privacy.message import SCHEMA as SECURE
from geoorbit_ros.federated.rounds.client import FederatedClient, LocalResult, Work
from geoorbit_ros.federated.rounds.server import FederatedServer
from geoorbit_ros.federated.rounds.traffic import Traffic

TrainMany = Callable[[Sequence[tuple[FederatedClient, Work]]], Iterable[LocalResult]]
"""Trains several clients, perhaps in parallel; results in the same order."""


def run_in_process(
    server: FederatedServer,
    clients: Sequence[FederatedClient],
    train_many: TrainMany,
    on_round: Callable[[FederatedServer, Traffic], None] | None = None,
) -> Traffic:
    """Run all rounds that are left.

    Args:
        server: Fresh, or resumed from its checkpoint.
        clients: The clients of the roster that take part.
        train_many: Local training of all clients of a round.
        on_round: Called after each round.

    Returns:
        What crossed the wire.

    Raises:
        FederationError: A round that no client can complete.
        PayloadError: A payload that was refused, which does not happen here.
    """
    traffic, now_s = Traffic(), 0.0
    payloads = [server.start(now_s)]
    for _ in range(_most_announcements(server)):
        for payload in payloads:
            traffic.down(payload, len(clients))
        number = server.round
        asked = [(c, w) for c in clients if (w := _receive(c, server, payloads)) is not None]
        payloads = _answer(server, asked, train_many, traffic, now_s)
        if on_round and server.round > number:
            on_round(server, traffic)
        if not payloads and not server.finished:
            now_s += server.config.deadline_s  # simulated time
            payloads = [again] if (again := server.tick(now_s)) else []
        if not payloads:
            break
    if not server.finished:
        raise FederationError("federation", f"no end after round {server.round}", "clients enough")
    return traffic


def _most_announcements(server: FederatedServer) -> int:
    """A bound: every round, each opened to all once, the last model, and its verdict."""
    return 2 * (server.config.rounds + 2) + 2


def _receive(
    client: FederatedClient, server: FederatedServer, payloads: Sequence[bytes]
) -> Work | None:
    """Hand a client what was announced; one that has just joined gets what is latched."""
    work = None
    for payload in payloads if client.tensors is not None else server.latched:
        work = client.receive(payload)
    return work


def _answer(
    server: FederatedServer,
    asked: Sequence[tuple[FederatedClient, Work]],
    train_many: TrainMany,
    traffic: Traffic,
    now_s: float,
) -> list[bytes]:
    """Train the clients that are asked and give their updates to the server; its answers."""
    results = iter(train_many([(client, work) for client, work in asked if not work.ready]))
    updates = [work.ready or client.finish(work, next(results)) for client, work in asked]
    clients = [client for client, _ in asked]
    announced: list[bytes] = []
    for update in updates:
        announced += _hand_in(server, clients, update, traffic, now_s) if update else []
    return announced


def _hand_in(
    server: FederatedServer,
    clients: Sequence[FederatedClient],
    update: bytes,
    traffic: Traffic,
    now_s: float,
) -> list[bytes]:
    """Give the server an update, and see the steps of a masked sum through."""
    waiting, announced = [update], []
    # An asynchronous server may be done before all updates of a batch are in.
    while waiting and not server.finished:
        payload = waiting.pop(0)
        traffic.up(payload)
        try:
            following = server.receive(payload, now_s)
        except PayloadError as error:
            if not (server.asynchronous and error.reason is Refusal.OLD_ROUND):
                raise
            continue  # an asynchronous server has gone on meanwhile
        if following is not None and schema_of(following) == SECURE:
            traffic.down(following, len(clients))
            waiting += [step for client in clients if (step := client.assist(following))]
        elif following is not None:
            announced.append(following)
    return announced
