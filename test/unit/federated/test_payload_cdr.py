"""Payloads are the CDR of msg_defs/*.msg, byte for byte as rosbags writes it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from geoorbit_ros.federated.errors import PayloadError, Refusal
from geoorbit_ros.federated.payloads import client_update, global_model
from geoorbit_ros.federated.payloads import lane_parameters as theta
from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.payloads.global_model import GlobalModel, ModelDelta
from geoorbit_ros.federated.payloads.header import UNSIGNED, schema_of
from geoorbit_ros.federated.payloads.lane_parameters import ThetaPayload
from geoorbit_ros.federated.payloads.model_layout import ModelLayout

FOLDER = Path(__file__).parents[3] / "msg_defs"
STORE = get_typestore(Stores.ROS2_JAZZY)
for _path in sorted(FOLDER.glob("*.msg")):
    STORE.register(get_types_from_msg(_path.read_text(), f"geoorbit_ros/msg/{_path.stem}"))

U32 = st.integers(0, 2**32 - 1)
BYTE = st.integers(0, 255)
TEXT = st.text(max_size=12).filter(lambda text: "\0" not in text)
LAYOUTS = st.lists(
    st.tuples(TEXT, st.lists(st.integers(1, 4), max_size=3).map(tuple)),
    min_size=1,
    max_size=4,
    unique_by=lambda pair: pair[0],
).map(lambda pairs: ModelLayout(*(tuple(part) for part in zip(*pairs, strict=True))))
WHOLE_NUMBERS = ("run", "round", "model", "interface", "approved", "validation_divisor")
CLIENTS = st.lists(U32, max_size=3).map(tuple)
DATA = st.binary(max_size=40)
FLOAT = st.floats(width=32, allow_nan=False)


def by_rosbags(name: str, **fields: Any) -> bytes:
    kind = f"geoorbit_ros/msg/{name}"
    message = STORE.types[kind](**fields, signature=np.zeros(64, np.uint8))
    return bytes(STORE.serialize_cdr(message, kind))


@given(BYTE, U32, U32, U32, U32, st.tuples(FLOAT, FLOAT), DATA)
def test_client_update(
    encoding: int,
    number: int,
    model: int,
    client: int,
    samples: int,
    losses: tuple[float, float],
    data: bytes,
) -> None:
    update = ClientUpdate(encoding, number, model, client, samples, *losses, data)
    payload = update.unsigned() + UNSIGNED
    assert payload == by_rosbags(
        "ClientUpdate",
        schema="update",
        version=client_update.VERSION,
        encoding=encoding,
        flags=0,
        round=number,
        model=model,
        client=client,
        sample_count=samples,
        loss=losses[0],
        gain=losses[1],
        data=np.frombuffer(data, np.uint8),
    )
    assert ClientUpdate.decode(payload) == update


@given(BYTE, BYTE, st.tuples(U32, U32, U32, U32), CLIENTS, DATA)
def test_model_delta(
    encoding: int,
    flags: int,
    numbers: tuple[int, int, int, int],
    clients: tuple[int, ...],
    data: bytes,
) -> None:
    delta = ModelDelta(encoding, flags, *numbers, clients, data)
    payload = delta.unsigned() + UNSIGNED
    assert payload == by_rosbags(
        "ModelDelta",
        schema="delta",
        version=global_model.DELTA_VERSION,
        encoding=encoding,
        flags=flags,
        **dict(zip(("round", "base", "model", "approved"), numbers, strict=True)),
        clients=np.array(clients, np.uint32),
        data=np.frombuffer(data, np.uint8),
    )
    assert ModelDelta.decode(payload) == delta


@given(
    BYTE,
    st.tuples(*[U32] * 6),
    st.floats(0, 1e3, width=32),
    CLIENTS,
    LAYOUTS,
    DATA,
)
def test_global_model(
    flags: int,
    numbers: tuple[int, int, int, int, int, int],
    proximal_mu: float,
    clients: tuple[int, ...],
    layout: ModelLayout,
    data: bytes,
) -> None:
    model = GlobalModel(2, flags, *numbers, proximal_mu, clients, layout, data)
    payload = model.unsigned() + UNSIGNED
    assert payload == by_rosbags(
        "GlobalModel",
        schema="model",
        version=global_model.VERSION,
        encoding=2,
        flags=flags,
        **dict(zip(WHOLE_NUMBERS, numbers, strict=True)),
        proximal_mu=proximal_mu,
        clients=np.array(clients, np.uint32),
        tensor_names=list(layout.names),
        tensor_ranks=np.array([len(shape) for shape in layout.shapes], np.uint32),
        tensor_shapes=np.array([n for shape in layout.shapes for n in shape], np.uint32),
        data=np.frombuffer(data, np.uint8),
    )
    assert GlobalModel.decode(payload) == model


@given(
    TEXT,
    st.tuples(U32, U32, U32),
    st.dictionaries(TEXT, st.floats(allow_nan=False, allow_infinity=False), max_size=4),
)
def test_lane_parameters(
    camera_id: str, numbers: tuple[int, int, int], values: dict[str, float]
) -> None:
    parameters = ThetaPayload(camera_id, *numbers, values)
    payload = parameters.unsigned() + UNSIGNED
    assert payload == by_rosbags(
        "LaneParameters",
        schema="theta",
        version=theta.VERSION,
        camera_id=camera_id,
        **dict(zip(("run", "round", "model"), numbers, strict=True)),
        names=list(values),
        values=np.array(list(values.values()), np.float64),
    )
    assert ThetaPayload.decode(payload) == parameters


UPDATE = ClientUpdate(0, 1, 2, 3, 4, 0.5, -0.25, b"12345678").unsigned() + UNSIGNED


@pytest.mark.parametrize("length", range(len(UPDATE)))
def test_a_payload_cut_anywhere_is_refused(length: int) -> None:
    with pytest.raises(PayloadError) as refused:
        ClientUpdate.decode(UPDATE[:length])
    assert refused.value.reason == Refusal.TRUNCATED


@pytest.mark.parametrize(
    ("payload", "reason", "words"),
    [
        (UPDATE + b"\0", Refusal.TOO_LONG, "9 bytes of data"),
        (UPDATE.replace(b"update", b"delta\0"), Refusal.FOREIGN, "found schema 'delta"),
        (UPDATE[:16] + b"\x02\0" + UPDATE[18:], Refusal.VERSION, "found version 2"),
        (UPDATE[:19] + b"\x01" + UPDATE[20:], Refusal.MALFORMED, "flags 1"),
        (b"\0\0" + UPDATE[2:], Refusal.FOREIGN, ""),
    ],
)
def test_a_wrong_payload_is_refused_with_its_reason(
    payload: bytes, reason: Refusal, words: str
) -> None:
    with pytest.raises(PayloadError) as refused:
        ClientUpdate.decode(payload)
    assert refused.value.reason == reason
    assert words in str(refused.value)


def test_the_schema_is_read_without_reading_more() -> None:
    assert schema_of(UPDATE) == "update"
    assert schema_of(b"") == schema_of(b"\0\1\0\0\xff\xff\xff\xff") == ""
