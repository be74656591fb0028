"""Eigenvalues of symmetric matrices, also where LAPACK's divide and conquer does not end."""

import numpy as np
import pytest

from calib.linear.symmetric import eigh, pinv


def drawn(*shape):
    """Symmetric, half of the eigenvalues the same, as of what priors alone tell."""
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(*shape, 8, 8)))[0]
    return (turn * np.r_[np.ones(4), 1e-4 * np.arange(1, 5)]) @ np.swapaxes(turn, -1, -2)


def never_ends(matrix):
    raise np.linalg.LinAlgError("Eigenvalues did not converge")


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
@pytest.mark.parametrize("ends", [True, False])
def test_eigenvectors_make_the_matrix_again(monkeypatch, shape, ends):
    if not ends:
        monkeypatch.setattr(np.linalg, "eigh", never_ends)
    matrix = drawn(*shape)
    values, vectors = eigh(matrix)
    assert values.shape == (*shape, 8) and (np.diff(values) > -1e-15).all()
    turned = np.swapaxes(vectors, -1, -2)
    np.testing.assert_allclose((vectors * values[..., None, :]) @ turned, matrix, atol=1e-14)
    np.testing.assert_allclose(
        turned @ vectors, np.broadcast_to(np.eye(8), matrix.shape), atol=1e-14
    )


def test_what_is_not_finite_has_none(monkeypatch):
    monkeypatch.setattr(np.linalg, "eigh", never_ends)
    with pytest.raises(np.linalg.LinAlgError):
        eigh(np.full((2, 2), np.nan))


@pytest.mark.parametrize("least", [1e-15, 2.5e-4])
def test_a_pseudo_inverse_leaves_out_what_is_small(least):
    matrix = drawn(2)
    np.testing.assert_allclose(
        pinv(matrix, least), np.linalg.pinv(matrix, least), rtol=1e-9, atol=1e-9
    )
    assert pinv(np.zeros((3, 3))).tolist() == np.zeros((3, 3)).tolist()
