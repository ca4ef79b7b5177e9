"""Essential and fundamental matrices of general motion."""

from __future__ import annotations

from importlib import resources

import cv2
import numpy as np
import pytest

from visctrl.contracts import Health
from visctrl.geometry.two_view.essential import constraint_rows, epipoles, null_matrices, singular
from visctrl.geometry.two_view.robust_matrices import (
    Degeneracy,
    robust_essential,
    robust_fundamental,
)

K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
NOISE_PX = 0.5


def rotation(axis: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(np.asarray(axis, dtype=float))[0])


def cross(t: np.ndarray) -> np.ndarray:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


class Pair:
    """Two views, b at ``t`` in a's axes, turned by R: X_a = R X_b + t."""

    def __init__(self, rng: np.random.Generator, *, ahead: bool, count: int = 100) -> None:
        self.R = rotation(rng.normal(0, 0.1, 3))
        self.t = np.array([0.3, -0.2, 1.0]) + rng.normal(0, 0.1, 3)
        low, high = ([-3, -2, 5], [3, 2, 12]) if ahead else ([-6, -6, -6], [6, 6, 6])
        X = rng.uniform(low, high, (20 * count, 3))
        X = X[(np.linalg.norm(X, axis=1) > 2) & (np.linalg.norm(X - self.t, axis=1) > 2)][:count]
        self.a = X
        self.b = (X - self.t) @ self.R
        self.E = cross(self.t) @ self.R


def directed_error(found: np.ndarray, true: np.ndarray) -> float:
    """Angle (rad) between two lines through the origin."""
    return float(np.arccos(min(1.0, abs(found @ true) / np.linalg.norm(true))))


def noisy_rays(X: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    unit = X / np.linalg.norm(X, axis=1, keepdims=True)
    unit = unit + rng.normal(0, sigma, X.shape)
    return unit / np.linalg.norm(unit, axis=1, keepdims=True)


def test_essential_matrix_from_rays_all_round() -> None:
    rng = np.random.default_rng(0)
    pair = Pair(rng, ahead=False)
    found = robust_essential(noisy_rays(pair.a, 1e-9, rng), noisy_rays(pair.b, 1e-9, rng), 1e-6)
    E = pair.E / np.linalg.norm(pair.E)
    assert found.health is Health.OK
    assert min(np.abs(found.matrix - E).max(), np.abs(found.matrix + E).max()) < 1e-6
    assert directed_error(found.epipole_a.direction, pair.t) < 1e-6
    assert directed_error(found.epipole_b.direction, pair.R.T @ pair.t) < 1e-6


def test_standard_deviations_of_the_epipoles_are_those_of_the_errors() -> None:
    sigma, scaled = 1e-3, []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        pair = Pair(rng, ahead=False)
        a, b = noisy_rays(pair.a, sigma, rng), noisy_rays(pair.b, sigma, rng)
        b[:20] = noisy_rays(rng.normal(size=(20, 3)), sigma, rng)
        found = robust_essential(a, b, sigma, seed=seed)
        error = directed_error(found.epipole_a.direction, pair.t)
        scaled.append(error / np.sqrt(found.epipole_a.covariance.trace()))
        assert found.inliers[:20].mean() < 0.2 < 0.9 < found.inliers[20:].mean()
    assert 0.5 < np.sqrt(np.mean(np.square(scaled))) < 1.5


def test_epipole_covariance_agrees_with_differences() -> None:
    rng = np.random.default_rng(3)
    M = singular(rng.normal(size=(3, 3)))
    L = 1e-5 * rng.normal(size=(9, 9))
    epipole_a, epipole_b = epipoles(M, L @ L.T)
    moved = [epipoles(M + (L @ z).reshape(3, 3), np.eye(9)) for z in rng.normal(size=(1500, 9))]
    for k, found in enumerate((epipole_a, epipole_b)):
        drawn = np.array(
            [e[k].direction * np.sign(e[k].direction @ found.direction) for e in moved]
        )
        assert np.cov(drawn.T) == pytest.approx(found.covariance, rel=0.2, abs=0.05 * 1e-10)


def test_null_matrices_fit_exact_samples() -> None:
    rng = np.random.default_rng(5)
    pair = Pair(rng, ahead=False)
    rows = constraint_rows(pair.a, pair.b)
    M = null_matrices(rows[rng.permuted(np.tile(np.arange(80), (16, 1)), axis=1)[:, :8]])
    assert np.abs(rows @ M.reshape(16, 9).T).max() < 1e-6


def test_degenerate_views_have_a_name() -> None:
    rng = np.random.default_rng(1)
    pair = Pair(rng, ahead=True)
    sigma = 1e-3

    def of(X_a: np.ndarray, X_b: np.ndarray) -> Degeneracy:
        found = robust_essential(noisy_rays(X_a, sigma, rng), noisy_rays(X_b, sigma, rng), sigma)
        assert np.isfinite(found.matrix).all()
        return found.degeneracy

    plane = pair.a.copy()
    plane[:, 2] = 8.0 + 0.3 * plane[:, 0]
    small = np.array([0.0, 0.0, 8.0]) + 0.02 * rng.normal(size=(60, 3))
    assert of(plane, (plane - pair.t) @ pair.R) is Degeneracy.MANY_SOLUTIONS
    assert of(pair.a, pair.a @ pair.R) is Degeneracy.MANY_SOLUTIONS
    assert of(small, (small - pair.t) @ pair.R) is Degeneracy.CLUSTERED
    assert of(pair.a[:6], pair.b[:6]) is Degeneracy.TOO_FEW
    assert of(rng.normal(size=(40, 3)), rng.normal(size=(40, 3))) is Degeneracy.NO_AGREEMENT


def test_at_least_as_accurate_as_opencv_on_the_same_data() -> None:
    """F against `findFundamentalMat`, E against `findEssentialMat`, both with MAGSAC."""
    errors: dict[str, list[float]] = {"F": [], "cv F": [], "E": [], "cv E": []}
    for seed in range(40):
        rng = np.random.default_rng([seed, 11])
        pair = Pair(rng, ahead=True)
        pixels = [X @ K.T / X[:, 2:] for X in (pair.a, pair.b)]
        pixels = [p[:, :2] + rng.normal(0, NOISE_PX, (len(p), 2)) for p in pixels]
        pixels[1][:20] = rng.uniform([0, 0], [640, 480], (20, 2))
        a, b = (np.column_stack([p, np.ones(len(p))]) @ np.linalg.inv(K).T for p in pixels)
        rays = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b)]
        F = robust_fundamental(*pixels, NOISE_PX, seed=seed)
        E = robust_essential(*rays, NOISE_PX / 600.0, seed=seed)
        cv_F, _ = cv2.findFundamentalMat(pixels[1], pixels[0], cv2.USAC_MAGSAC, 1.0, 0.999, 10000)
        cv_E, _ = cv2.findEssentialMat(pixels[1], pixels[0], K, cv2.USAC_MAGSAC, 0.999, 1.0)
        backwards = np.linalg.inv(K)
        candidates = {
            "F": backwards @ F.epipole_a.direction,
            "cv F": backwards @ np.linalg.svd(cv_F)[0][:, 2],
            "E": E.epipole_a.direction,
            "cv E": np.linalg.svd(cv_E[:3])[0][:, 2],
        }
        for name, e in candidates.items():
            errors[name].append(directed_error(e / np.linalg.norm(e), pair.t))
    medians = {name: float(np.median(values)) for name, values in errors.items()}
    assert medians["F"] <= 1.05 * medians["cv F"], medians
    assert medians["E"] <= 1.05 * medians["cv E"], medians


@pytest.mark.parametrize(("first", "second"), [("eiffel-1.png", "eiffel-2.png")])
def test_agrees_with_magsac_on_photographs_of_a_building(first: str, second: str) -> None:
    folder = resources.files("mvtbdata") / "images"
    images = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in (first, second)]
    sift = cv2.SIFT_create(3000)
    (keys_a, found_a), (keys_b, found_b) = (sift.detectAndCompute(i, None) for i in images)
    pairs = cv2.BFMatcher().knnMatch(found_a, found_b, k=2)
    good = [m for m, n in pairs if m.distance < 0.8 * n.distance]
    a = np.array([keys_a[m.queryIdx].pt for m in good])
    b = np.array([keys_b[m.trainIdx].pt for m in good])
    _, mask = cv2.findFundamentalMat(b, a, cv2.USAC_MAGSAC, 1.0, 0.9999, 10000)
    theirs = mask.ravel().astype(bool)
    found = robust_fundamental(a, b, NOISE_PX)
    assert found.health is Health.OK
    assert theirs.sum() > 500
    assert (theirs & found.inliers).sum() >= 0.97 * theirs.sum()
    assert (theirs & found.inliers).sum() >= 0.85 * (theirs | found.inliers).sum()
