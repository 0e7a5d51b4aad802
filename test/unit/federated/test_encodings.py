"""Encodings: how much they keep, how small they are, and that nothing is lost for good."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.federated.encodings.encoding import (
    Encoding,
    EncodingSettings,
    ErrorFeedback,
    decode_vector,
    make_encoding,
)
from geoorbit_ros.federated.encodings.floats import Float16, Float32
from geoorbit_ros.federated.encodings.int8 import Int8
from geoorbit_ros.federated.encodings.top_k import TopK, decode_indices, encode_indices
from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal

Vector = NDArray[np.float32]
VECTORS = arrays(
    np.float32, st.integers(1, 60), elements=st.floats(-1e3, 1e3, width=32, allow_subnormal=False)
)
ALL = [Float32(), Float16(), Int8(), TopK(0.2, 4), TopK(0.2, 8), TopK(1.0, 8)]


@given(VECTORS)
def test_float32_is_exact(vector: Vector) -> None:
    np.testing.assert_array_equal(Float32().decode(Float32().encode(vector), len(vector)), vector)


@given(VECTORS, st.sampled_from([(Float16(), 2.0**-11), (Int8(), 0.5 / 127)]))
def test_the_error_is_bounded(vector: Vector, case: tuple[Encoding, float]) -> None:
    encoding, share = case
    error = np.abs(encoding.decode(encoding.encode(vector), len(vector)) - vector)
    assert error.max() <= 1.001 * share * np.abs(vector).max() + 2.0**-24


@given(VECTORS, st.floats(0.01, 1.0), st.sampled_from([4, 8]))
def test_top_k_keeps_the_largest_and_nothing_else(vector: Vector, share: float, bits: int) -> None:
    encoding = TopK(share, bits)
    decoded = encoding.decode(encoding.encode(vector), len(vector))
    kept = np.flatnonzero(decoded)
    count = int(np.ceil(share * len(vector)))
    assert len(kept) <= count
    least = np.sort(np.abs(vector))[::-1][count - 1]
    assert (np.abs(vector[kept]) >= least).all()
    step = np.abs(vector).max() / (7 if bits == 4 else 127)
    assert (np.abs(decoded[kept] - vector[kept]) <= 0.5001 * step).all()


@given(VECTORS, st.sampled_from(ALL))
def test_decoding_again_gives_the_same_bits(vector: Vector, encoding: Encoding) -> None:
    data = encoding.encode(vector)
    assert encoding.encode(vector) == data
    first = decode_vector(encoding.code, data, len(vector))
    np.testing.assert_array_equal(first, encoding.decode(data, len(vector)))
    assert first.dtype == np.float32


@given(st.sets(st.integers(0, 5000), max_size=80))
def test_indices_survive(chosen: set[int]) -> None:
    indices = np.array(sorted(chosen), np.int64)
    parameter, data = encode_indices(indices)
    found = decode_indices(data, parameter, len(indices), 5001)
    np.testing.assert_array_equal(found, indices)


def test_the_sizes_are_what_thrift_is_about() -> None:
    vector = np.random.default_rng(0).standard_t(3, 323).astype(np.float32)
    size = {str(e): len(e.encode(vector)) for e in (Float32(), Float16(), Int8(), TopK(0.1, 4))}
    assert list(size.values())[:3] == [1292, 646, 327]
    # 33 indices of 323 carry 19 bytes of information, values 17, scale and counts 6.
    assert list(size.values())[3] <= 43


@pytest.mark.parametrize("encoding", ALL[1:], ids=str)
def test_error_feedback_delivers_the_sum_in_the_end(encoding: Encoding) -> None:
    generator = np.random.default_rng(1)
    feedback = ErrorFeedback(encoding, 200)
    meant, sent = np.zeros(200), np.zeros(200)
    for _ in range(60):
        vector = generator.normal(0.05, 1, 200).astype(np.float32)
        meant += vector
        sent += encoding.decode(feedback.encode(vector), 200)
    np.testing.assert_allclose(sent + feedback.residual, meant, atol=1e-3)
    # What is owed does not grow with the number of rounds.
    assert np.abs(feedback.residual).max() < 15


@pytest.mark.parametrize(
    ("code", "data", "reason"),
    [
        (0, b"123", Refusal.SHAPE),
        (0, np.array([np.nan, 1], "<f4").tobytes(), Refusal.NOT_FINITE),
        (0, np.array([1, -np.inf], "<f4").tobytes(), Refusal.NOT_FINITE),
        (1, np.array([1, np.inf], "<f2").tobytes(), Refusal.NOT_FINITE),
        (2, np.array([np.inf], "<f4").tobytes() + b"12", Refusal.NOT_FINITE),
        (2, np.array([-1], "<f4").tobytes() + b"12", Refusal.NOT_FINITE),
        (2, b"1234" + b"1", Refusal.SHAPE),
        (3, b"12", Refusal.SHAPE),
        (3, b"\0\0\0\0", Refusal.ENCODING),
        (3, b"\0\0\0\0\0", Refusal.ENCODING),
        (3, b"\0\0\0\0\0\xff\xff\xff\xff\xff", Refusal.ENCODING),
        (3, b"\0\0\0\0\x1f\x01\x11\0", Refusal.ENCODING),
        (3, b"\0\0\0\0\0\x03\x11\x11\0", Refusal.SHAPE),
        (3, b"\0\0\0\0\0\x01\x11\xe0", Refusal.SHAPE),
        (3, b"\0\0\0\0\0\x01\x11\0\0", Refusal.ENCODING),
        (9, b"", Refusal.ENCODING),
    ],
)
def test_data_that_fits_no_vector_of_two_is_refused(
    code: int, data: bytes, reason: Refusal
) -> None:
    with pytest.raises(PayloadError) as refused:
        decode_vector(code, data, 2)
    assert refused.value.reason == reason


def test_names_give_encodings_and_nothing_else() -> None:
    names = ("float32", "float16", "int8", "top_k")
    assert [make_encoding(name).code for name in names] == [0, 1, 2, 3]
    with pytest.raises(ParameterError):
        make_encoding("zip")
    for wrong in (EncodingSettings(0.0), EncodingSettings(0.1, 5)):
        with pytest.raises(FederationError):
            make_encoding("top_k", wrong)
