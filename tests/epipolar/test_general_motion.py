"""Fundamental and essential matrices of general motion by MAGSAC, and what they are known by."""

from __future__ import annotations

from importlib import resources

import cv2
import numpy as np
import pytest
from epipolar_world import World

from visctrl.geometry.two_view.degeneracy import Degeneracy
from visctrl.geometry.two_view.general_motion import EpipolarGeometry, epipoles, magsac
from visctrl.hal.cameras.catalogue import load_camera
from visctrl.robots.errors import InputError
from visctrl.schemes.epipolar.motion_solvers import solver_for

SIGMA = 0.5 / 600.0


def rotation(axis: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(np.asarray(axis, dtype=float))[0])


def cross(t: np.ndarray) -> np.ndarray:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


class Pair:
    """Two views, b at ``t`` in a's axes, turned by R: X_a = R X_b + t."""

    def __init__(self, rng: np.random.Generator, count: int = 100) -> None:
        self.R = rotation(rng.normal(0, 0.1, 3))
        self.t = np.array([0.3, -0.2, 1.0]) + rng.normal(0, 0.1, 3)
        self.a = rng.uniform([-3, -2, 5], [3, 2, 12], (count, 3))
        self.b = (self.a - self.t) @ self.R
        self.E = cross(self.t) @ self.R

    def points(self, sigma: float, rng: np.random.Generator, outliers: int = 0) -> list[np.ndarray]:
        """Image points of both views, the first ones of b anywhere."""
        found = [X[:, :2] / X[:, 2:] for X in (self.a, self.b)]
        found = [x + rng.normal(0, sigma, x.shape) for x in found]
        found[1][:outliers] = rng.uniform([-0.53, -0.4], [0.53, 0.4], (outliers, 2))
        return found


def directed_error(found: np.ndarray, true: np.ndarray) -> float:
    """Angle (rad) between two lines through the origin."""
    return float(np.arccos(min(1.0, abs(found @ true) / np.linalg.norm(true))))


@pytest.mark.parametrize("calibrated", [False, True])
def test_exact_points_give_the_exact_matrix(calibrated: bool) -> None:
    rng = np.random.default_rng(0)
    pair = Pair(rng)
    found = magsac(*pair.points(0.0, rng), 1e-4, calibrated=calibrated)
    E = pair.E / np.linalg.norm(pair.E)
    assert found.degeneracy is None
    assert min(np.abs(found.matrix - E).max(), np.abs(found.matrix + E).max()) < 1e-4
    assert directed_error(found.epipole_a.direction, pair.t) < 1e-4
    assert directed_error(found.epipole_b.direction, pair.R.T @ pair.t) < 1e-4


@pytest.mark.parametrize("calibrated", [False, True])
def test_standard_deviations_of_the_epipoles_are_those_of_the_errors(calibrated: bool) -> None:
    scaled = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pair = Pair(rng)
        found = magsac(*pair.points(SIGMA, rng), SIGMA, calibrated=calibrated, seed=seed)
        error = directed_error(found.epipole_a.direction, pair.t)
        scaled.append(error / np.sqrt(found.epipole_a.covariance.trace()))
    assert 0.8 < np.sqrt(np.mean(np.square(scaled))) < 1.2


def test_at_least_as_accurate_as_bare_opencv_among_gross_errors() -> None:
    """F against `findFundamentalMat`, E against `findEssentialMat`, a fifth of gross errors."""
    errors: dict[str, list[float]] = {"F": [], "cv F": [], "E": [], "cv E": []}
    for seed in range(60):
        rng = np.random.default_rng([seed, 11])
        pair = Pair(rng)
        a, b = points = pair.points(SIGMA, rng, 20)
        F, E = (magsac(*points, SIGMA, calibrated=known, seed=seed) for known in (False, True))
        assert E.inliers[:20].mean() < 0.3 < 0.9 < E.inliers[20:].mean()
        cv_F, _ = cv2.findFundamentalMat(600.0 * b, 600.0 * a, cv2.USAC_MAGSAC, 1.0, 0.999, 10000)
        K = np.diag([600.0, 600.0, 1.0])
        cv_E, _ = cv2.findEssentialMat(600.0 * b, 600.0 * a, K, cv2.USAC_MAGSAC, 0.999, 1.0)
        found = {
            "F": F.epipole_a.direction,
            "cv F": np.linalg.svd(K @ cv_F @ K)[0][:, 2],
            "E": E.epipole_a.direction,
            "cv E": np.linalg.svd(cv_E[:3])[0][:, 2],
        }
        for name, direction in found.items():
            errors[name].append(directed_error(direction, pair.t))
    medians = {name: float(np.median(values)) for name, values in errors.items()}
    assert medians["F"] <= 1.05 * medians["cv F"], medians
    assert medians["E"] <= 1.05 * medians["cv E"], medians


def test_epipole_covariance_agrees_with_differences() -> None:
    rng = np.random.default_rng(3)
    U, s, Vt = np.linalg.svd(rng.normal(size=(3, 3)))
    M = (U * [s[0], s[1], 0.0]) @ Vt
    L = 1e-5 * rng.normal(size=(9, 9))
    epipole_a, epipole_b = epipoles(M, L @ L.T)
    moved = [epipoles(M + (L @ z).reshape(3, 3), np.eye(9)) for z in rng.normal(size=(1500, 9))]
    for k, found in enumerate((epipole_a, epipole_b)):
        drawn = np.array(
            [e[k].direction * np.sign(e[k].direction @ found.direction) for e in moved]
        )
        assert np.cov(drawn.T) == pytest.approx(found.covariance, rel=0.2, abs=0.05 * 1e-10)


@pytest.mark.parametrize("calibrated", [False, True])
def test_degenerate_views_have_a_name(calibrated: bool) -> None:
    rng = np.random.default_rng(1)
    pair = Pair(rng)

    def of(X_a: np.ndarray, X_b: np.ndarray) -> EpipolarGeometry:
        points = [X[:, :2] / X[:, 2:] + rng.normal(0, SIGMA, (len(X), 2)) for X in (X_a, X_b)]
        found = magsac(*points, SIGMA, calibrated=calibrated)
        assert np.isfinite(found.matrix).all()
        return found

    plane = pair.a.copy()
    plane[:, 2] = 8.0 + 0.3 * plane[:, 0]
    small = np.array([0.0, 0.0, 8.0]) + 0.02 * rng.normal(size=(60, 3))
    few = of(pair.a[:6], pair.b[:6])
    assert of(plane, (plane - pair.t) @ pair.R).degeneracy is Degeneracy.MANY_SOLUTIONS
    assert of(pair.a, pair.a @ pair.R).degeneracy is Degeneracy.MANY_SOLUTIONS
    assert of(small, (small - pair.t) @ pair.R).degeneracy is Degeneracy.NARROW
    assert few.degeneracy is Degeneracy.TOO_FEW
    assert not few.inliers.any()


def test_agrees_with_magsac_on_photographs_of_a_building() -> None:
    folder = resources.files("mvtbdata") / "images"
    names = ("eiffel-1.png", "eiffel-2.png")
    images = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in names]
    sift = cv2.SIFT_create(3000)
    (keys_a, found_a), (keys_b, found_b) = (sift.detectAndCompute(i, None) for i in images)
    pairs = cv2.BFMatcher().knnMatch(found_a, found_b, k=2)
    good = [m for m, n in pairs if m.distance < 0.8 * n.distance]
    a = np.array([keys_a[m.queryIdx].pt for m in good])
    b = np.array([keys_b[m.trainIdx].pt for m in good])
    _, mask = cv2.findFundamentalMat(b, a, cv2.USAC_MAGSAC, 1.0, 0.9999, 10000)
    theirs = mask.ravel().astype(bool)
    middle, focal = np.array(images[0].shape[::-1]) / 2.0, 1.2 * max(images[0].shape)
    found = magsac((a - middle) / focal, (b - middle) / focal, 0.5 / focal, calibrated=False)
    assert found.degeneracy is None
    assert theirs.sum() > 500
    assert (theirs & found.inliers).sum() >= 0.95 * theirs.sum()
    assert (theirs & found.inliers).sum() >= 0.85 * (theirs | found.inliers).sum()


@pytest.mark.parametrize("name", ["fundamental", "essential"])
def test_a_pair_of_views_gives_heading_and_epipoles(name: str) -> None:
    """The heading and the epipoles' bearings of a planar motion, within four deviations."""
    x, y, phi = start = (0.4, -3.0, -0.1)
    world = World(start, noise_px=0.5, seed=4, outliers=0.1)
    solver = solver_for(name, world.camera)  # type: ignore[arg-type]
    views = world.views(start, 0.0)
    motion = solver.search(views.target, views.current, views.sigma, 2000, 0)
    assert motion.determined
    assert abs(motion.phi - phi) < 4.0 * motion.phi_sd < 0.1
    error = np.angle(np.exp(1j * (motion.direction - np.arctan2(x, y))))
    assert abs(error) < 4.0 * motion.direction_sd < 0.1


def test_other_cameras_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="'essential' needs a perspective camera"):
        solver_for("essential", load_camera("hypercatadioptric"))
