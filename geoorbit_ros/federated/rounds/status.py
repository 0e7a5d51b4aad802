"""What a server says of itself, for people and programs that watch."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

from geoorbit_ros.federated.rounds.server import FederatedServer


def progress(server: FederatedServer) -> str:
    """Where training is."""
    rounds = server.config.rounds
    over = server.round > rounds
    return f"all {rounds} rounds done" if over else f"round {server.round} of {rounds}"


def server_facts(server: FederatedServer) -> dict[str, object]:
    """Round, clients heard, refusals by reason, last loss and verdict: one word or number each."""
    last = next((record for record in reversed(server.history) if record.updates), None)
    return {
        "run": server.run,
        "progress": progress(server),
        "round": server.round,
        "rounds": server.config.rounds,
        "finished": server.finished,
        "selected": len(server.selected),
        "collected": server.collected,
        "answers": f"{server.collected} of {server.wanted}",
        "validated": server.validated,
        "judged": server.validated,  # its old name, until 0.2.0
        "accepted": server.accepted,
        **{f"refused_{r.replace(' ', '_')}": n for r, n in server.refused.items()},
        "loss": round(last.loss, 6) if last else "",
        "model_approved": server.verdict.accepted,
    }


def status_text(server: FederatedServer, facts: dict[str, object]) -> str:
    """These facts and what came of the last round as JSON; what is not a number is null."""
    rows = [
        {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(record).items()
        }
        | {"judges": record.validation_clients}  # its old name, until 0.2.0
        for record in server.history[-1:]
    ]
    return json.dumps(facts | {"last_round": rows})
