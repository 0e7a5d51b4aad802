"""An update whose arrival nothing shows is sent again, ever more rarely, and not after that."""

from federation_parts import FEDERATION, Federation

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.rounds.client import ResendQueue
from geoorbit_ros.federated.rounds.server_config import ServerConfig

NAMES = ("north", "south")


def federation(**settings: object) -> Federation:
    return Federation(NAMES, ServerConfig(federation=FEDERATION, rounds=2, **settings))  # type: ignore[arg-type]


def times_sent(queue: ResendQueue, client: object, start_s: float, end_s: float) -> list[float]:
    """Seconds at which the last update goes out again, looked at ten times a second."""
    ticks = [start_s + 0.1 * k for k in range(round(10 * (end_s - start_s)))]
    return [t for t in ticks if queue.pass_on(None, client, t) is not None]  # type: ignore[arg-type]


def test_it_is_repeated_after_longer_and_longer_times_until_a_newer_model_comes() -> None:
    parts = federation()
    first = parts.server.start(0.0)
    north, south = parts.clients
    update = north.answer(first)
    assert update
    queue = ResendQueue(10.0)
    assert queue.pass_on(update, north, 100.0) == update
    assert times_sent(queue, north, 100.1, 300.0) == [110.0, 130.0, 170.0, 250.0]
    parts.server.receive(update, 1.0)
    answer = south.answer(first)
    assert answer
    second = parts.server.receive(answer, 2.0)
    assert second
    north.receive(second)
    assert times_sent(queue, north, 300.0, 2000.0) == []


def test_a_lost_update_costs_a_round_nothing_but_time() -> None:
    lossless, lossy = federation(), federation()
    for parts, loses in ((lossless, False), (lossy, True)):
        queues = {name: ResendQueue(10.0) for name in NAMES}
        payload: bytes | None = parts.server.start(0.0)
        now_s = 0.0
        while payload:
            updates = []
            for client in parts.clients:
                update = queues[client.camera_id].pass_on(client.answer(payload), client, now_s)
                if update and not (loses and client.camera_id == "south"):
                    updates.append(update)
            payload = None
            for update in updates:
                payload = parts.server.receive(update, now_s) or payload
            if loses and not parts.server.finished and payload is None:
                now_s += 10.0
                for client in parts.clients:  # north's came, and is refused the second time
                    again = queues[client.camera_id].pass_on(None, client, now_s)
                    try:
                        payload = parts.server.receive(again or b"", now_s) or payload
                    except PayloadError as error:
                        assert error.reason is Refusal.DUPLICATE
        assert parts.server.finished
    assert lossy.server.published.keys() == lossless.server.published.keys()
    for name, value in lossless.server.published.items():
        assert lossy.server.published[name].tobytes() == value.tobytes()


def test_after_the_end_nothing_is_sent() -> None:
    parts = federation(validation_divisor=1)
    queue = ResendQueue(10.0)
    payload: bytes | None = parts.server.start(0.0)
    while payload:
        answers = [client.answer(payload) for client in parts.clients]
        if answers[0]:
            queue.pass_on(answers[0], parts.clients[0], 0.0)
        payload = None
        for answer in answers:
            payload = (parts.server.receive(answer, 0.0) if answer else None) or payload
    assert parts.clients[0].finished
    assert times_sent(queue, parts.clients[0], 0.0, 100.0) == []


def test_zero_is_never_and_masked_steps_are_not_repeated() -> None:
    parts = federation()
    north = parts.clients[0]
    update = north.answer(parts.server.start(0.0))
    assert update
    for resend_s, payload in ((0.0, update), (10.0, update.replace(b"update\0", b"secure\0", 1))):
        queue = ResendQueue(resend_s)
        assert queue.pass_on(payload, north, 0.0) == payload
        assert times_sent(queue, north, 0.1, 1000.0) == []
