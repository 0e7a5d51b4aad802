"""The payload definitions are valid ROS 2 messages that survive a round trip through CDR."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FOLDER = Path(__file__).parents[2] / "msg_defs"
PAYLOADS = ("LaneParameters", "GlobalModel", "ModelDelta", "ClientUpdate", "SecureAggregation")
SCHEMAS = dict(zip(PAYLOADS, ("theta", "model", "delta", "update", "secure"), strict=True))

TEXTS = ["smoothing", "angle", ""]
SAMPLES: dict[str, Any] = {
    "string": "ä name",
    "string[]": TEXTS,
    "uint8": 255,
    "uint16": 1,
    "uint32": 2**32 - 1,
    "uint64": 2**64 - 1,
    "float32": 0.5,
    "uint8[64]": np.arange(64, dtype=np.uint8),
    "uint8[]": np.arange(256, dtype=np.uint8),
    "uint32[]": np.array([2, 1], dtype=np.uint32),
    "float64[]": np.array([10.0, -0.5, 1e-300]),
}


def declared_fields(name: str) -> list[tuple[str, str]]:
    """Type and name of every field, read from the text independently of rosbags."""
    lines = (line.partition("#")[0].split() for line in (FOLDER / f"{name}.msg").open())
    return [(words[0], words[1]) for words in lines if words and "=" not in words[1]]


def test_each_definition_has_a_payload_and_each_payload_a_definition() -> None:
    assert {path.stem for path in FOLDER.glob("*.msg")} == set(PAYLOADS)


@pytest.mark.parametrize("name", PAYLOADS)
def test_schema_and_version_come_first_and_the_signature_last(name: str) -> None:
    fields = declared_fields(name)
    assert fields[:2] == [("string", "schema"), ("uint16", "version")]
    assert fields[-1] == ("uint8[64]", "signature")
    assert "round" in {field for _, field in fields}


@pytest.mark.parametrize("name", PAYLOADS)
def test_a_payload_survives_serialisation(name: str) -> None:
    full_name = f"geoorbit_ros/msg/{name}"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg((FOLDER / f"{name}.msg").read_text(), full_name))
    message_type = store.types[full_name]
    assert getattr(message_type, "SCHEMA") == SCHEMAS[name]  # noqa: B009

    values = {field: SAMPLES[kind] for kind, field in declared_fields(name)}
    payload = store.serialize_cdr(message_type(**values), full_name)
    decoded = store.deserialize_cdr(payload, full_name)

    for field, value in values.items():
        np.testing.assert_array_equal(getattr(decoded, field), value, err_msg=field)
