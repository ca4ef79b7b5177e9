"""Small matrices in plain floats against numpy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from visctrl.geometry.robust.symmetric import Symmetric2, inverse4

NUMBERS = st.floats(-3.0, 3.0)


@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS)
def test_it_is_what_numpy_makes_of_it(p: float, q: float, r: float, x: float, y: float) -> None:
    L = np.array([[p, 0.0], [q, r]])
    M = L @ L.T + 1e-3 * np.eye(2)
    ours = Symmetric2.of(M)
    assert_allclose(ours.array, M, atol=1e-12)
    assert_allclose(ours.eigenvalues, np.linalg.eigvalsh(M), rtol=1e-6)
    assert_allclose(ours.inverse().array, np.linalg.inv(M), rtol=1e-6, atol=1e-9)
    assert_allclose(ours.apply((x, y)), M @ [x, y], atol=1e-12)
    assert_allclose(ours.plus(ours.times(2.0), 0.5).array, 2.0 * M, atol=1e-12)


@given(NUMBERS, NUMBERS)
def test_pseudo_inverse_of_a_matrix_of_rank_one_or_none(p: float, q: float) -> None:
    vector = np.array([p, q]) if max(abs(p), abs(q)) > 1e-3 else np.zeros(2)
    M = np.outer(vector, vector)
    expected = np.linalg.pinv(M, hermitian=True, rcond=1e-12)
    assert_allclose(Symmetric2.of(M).pseudo_inverse().array, expected, rtol=1e-6, atol=1e-9)


@given(st.lists(NUMBERS, min_size=10, max_size=10), st.floats(-9.0, 0.0))
def test_the_inverse_of_four_holds_for_any_condition(numbers: list[float], least: float) -> None:
    L = np.zeros((4, 4))
    L[np.tril_indices(4)] = numbers
    M = L @ L.T + 10.0**least * np.eye(4)
    inverse = inverse4(M)
    assert_allclose(inverse @ M, np.eye(4), atol=1e-13 * np.linalg.cond(M) + 1e-12)
    assert_allclose(inverse, inverse.T, rtol=1e-12 * np.linalg.cond(M), atol=1e-12)
