"""The parts of the batch against those of single runs, robot by robot, on random input."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest
from many_plans import plan_from

from visctrl.contracts import Health
from visctrl.geometry.trifocal import tensor as trifocal
from visctrl.geometry.trifocal.fit import Coupling, coupling
from visctrl.geometry.trifocal.fit import refine as refine_one
from visctrl.geometry.trifocal.solvers import identical_views
from visctrl.geometry.trifocal.tensor import (
    current_view_basis,
    initial_view_basis,
    linearised,
)
from visctrl.geometry.two_view.planar import ransac_planar_motion
from visctrl.hal.cameras.central import camera_names, load_camera
from visctrl.hal.types import Velocity
from visctrl.montecarlo.bases import Bases, Guards, Reckonings, Shapers
from visctrl.montecarlo.eyes import pixels_of, rays_of
from visctrl.montecarlo.fit import Couplings, couple, refine
from visctrl.montecarlo.initial_views import InitialViews
from visctrl.montecarlo.planar import identical, search
from visctrl.montecarlo.planar_fit import Rays
from visctrl.montecarlo.relation import FixedViews
from visctrl.montecarlo.robots import Velocities
from visctrl.robots import Limits, load_robot
from visctrl.runtime.safety import Guard, SafetyOptions
from visctrl.schemes.command_shaping import CommandShaper
from visctrl.schemes.path_scale import DeadReckoning
from visctrl.schemes.trifocal.initial_view import InitialView, InitialViewFilter

Array = np.ndarray
ROBOTS, FEATURES = 12, 40
LIMITS = load_robot("p3dx").operating
SIGMA = 2e-3


def unit(rays: Array) -> Array:
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def parts(rays: Array) -> tuple[Array, Array, Array]:
    return tuple(np.moveaxis(rays, 2, 0))


def views_of(rng: np.random.Generator, poses: Array, points: Array, noise: float) -> Array:
    """Return noisy unit rays (R, N, 3) of points (R, N, 3) seen from poses (R, 3)."""
    x, y, phi = poses.T[:, :, None]
    s, c = np.sin(phi), np.cos(phi)
    dx, dy = points[..., 0] - x, points[..., 1] - y
    rays = unit(np.stack([c * dx + s * dy, c * dy - s * dx, points[..., 2]], axis=2))
    return unit(rays + noise * rng.normal(size=rays.shape))


def scenes(rng: np.random.Generator, noise: float = SIGMA) -> tuple[Array, Array, Array, Array]:
    """Return the initial poses, and the rays of the initial, the current and the target view."""
    points = rng.uniform((-6.0, -6.0, -0.5), (6.0, 6.0, 2.0), (ROBOTS, FEATURES, 3))
    starts = rng.uniform((-1.0, -3.0, -0.5), (1.0, -1.5, 0.5), (ROBOTS, 3))
    views = (views_of(rng, share * starts, points, noise) for share in (1.0, 0.6, 0.0))
    return (starts, *views)


def initial_state(starts: Array) -> Array:
    """Return the headings and the bearings of the target (R, 2)."""
    x, y, phi = starts.T
    return np.stack([phi, np.arctan2(-x, -y) + phi], axis=1)


@pytest.mark.parametrize("name", [*camera_names(), "tilted"])
def test_eyes_see_what_the_camera_sees(name: str) -> None:
    """Inside the image, outside of it and where there is none."""
    rng = np.random.default_rng(7)
    camera = load_camera("fisheye" if name == "tilted" else name)
    if name == "tilted":
        camera = camera.altered(pitch_deg=7.0, yaw_deg=30.0, skew=0.3, xi=1.2)
    rays = rng.normal(size=(ROBOTS, 200, 3))
    u, v, seen = pixels_of(camera, parts(rays))
    pixels, valid = camera.robot_pixels(rays)
    assert 0 < np.count_nonzero(seen) < seen.size
    np.testing.assert_array_equal(seen, valid)
    np.testing.assert_allclose(np.stack([u, v], axis=2), pixels, rtol=1e-12)
    pixels = rng.uniform(-100.0, 900.0, (ROBOTS, 200, 2))
    found, seen = rays_of(camera, pixels[..., 0], pixels[..., 1])
    rays, valid = camera.robot_rays(pixels)
    assert 0 < np.count_nonzero(seen) < seen.size
    np.testing.assert_array_equal(seen, valid)
    np.testing.assert_allclose(np.stack(found, axis=2), rays, rtol=1e-12, atol=1e-14)


def test_the_relation_is_the_trilinear_one_in_any_view() -> None:
    rng = np.random.default_rng(0)
    rays = [unit(rng.normal(size=(ROBOTS, FEATURES, 3))) for _ in range(3)]
    state, z = rng.normal(size=(ROBOTS, 2)), rng.normal(size=(ROBOTS, 4))
    relation = FixedViews(parts(rays[0]), parts(rays[2])).relation(state, parts(rays[1]))
    products = relation.products(z)
    residual, slopes = relation.linearised(products)
    by_z, by_q = np.empty((ROBOTS, 4, FEATURES)), np.empty((ROBOTS, 2, FEATURES))
    relation.jacobian(slopes, by_z)
    relation.by_initial(products, slopes, by_q)
    for k in range(ROBOTS):
        view = InitialView(*state[k].tolist(), np.eye(2))
        single = trifocal.FixedViews(rays[0][k], rays[2][k]).relation(rays[1][k])
        within = single.within(current_view_basis(view.parameters))
        linear = linearised(within, z[k])
        by_view = single.within(initial_view_basis(z[k]) @ view.jacobian)
        scale = 1.0 + np.abs(by_q[k])
        np.testing.assert_allclose(residual[k], linear.residual, atol=1e-10)
        np.testing.assert_allclose(by_z[k], linear.jacobian(within), rtol=1e-8, atol=1e-9)
        assert np.abs((by_q[k] - linear.jacobian(by_view)) / scale).max() < 1e-9


def test_fits_and_couplings_are_those_of_single_robots() -> None:
    """Some features are not seen, some are gross errors; starts are near and far."""
    rng = np.random.default_rng(1)
    starts, initial, current, target = scenes(rng)
    state = initial_state(starts)
    current[:, :4] = unit(rng.normal(size=(ROBOTS, 4, 3)))
    seen = (rng.random((ROBOTS, FEATURES)) > 0.1).astype(float)
    phi = 0.6 * starts[:, 2]
    ahead = trifocal.target_in_view(0.6 * starts) / np.hypot(*starts.T[:2])[:, None]
    z = trifocal.view_parameters(phi, ahead)
    z += rng.normal(size=z.shape) * np.linspace(0.0, 0.1, ROBOTS)[:, None]
    relation = FixedViews(parts(initial), parts(target)).relation(state, parts(current))
    fits = refine(relation, z, np.full(ROBOTS, SIGMA), seen)
    coupled = couple(relation, fits)
    for k in range(ROBOTS):
        which = seen[k] > 0.0
        view = InitialView(*state[k].tolist(), np.eye(2))
        rays = (each[k][which] for each in (initial, current, target))
        single = trifocal.trilinear(*rays)
        fit = refine_one(single.within(view.basis), z[k], SIGMA)
        known = coupling(single, fit, view.parameters, view.jacobian)
        np.testing.assert_allclose(fits.z[k], fit.z, atol=1e-12)
        np.testing.assert_allclose(fits.covariance[k], fit.covariance, rtol=1e-7, atol=1e-15)
        np.testing.assert_allclose(fits.residuals[k][which], fit.residuals, atol=1e-12)
        np.testing.assert_allclose(fits.spread[k], fit.spread, rtol=1e-9)
        np.testing.assert_allclose(coupled.sensitivity[k], known.sensitivity, atol=1e-8)
        np.testing.assert_allclose(coupled.information[k], known.information, rtol=1e-7, atol=1e-3)
        np.testing.assert_allclose(coupled.gradient[k], known.gradient, rtol=1e-7, atol=1e-5)


def test_initial_views_are_filtered_like_single_ones() -> None:
    """With priors that are right, wrong and next to nothing, and information in one direction."""
    rng = np.random.default_rng(2)
    prior = rng.normal(size=(ROBOTS, 2))
    sd = np.geomspace(1e-4, 1.0, ROBOTS)
    covariance = np.stack([np.array([[1.0, 0.3], [0.3, 0.5]]) * each**2 for each in sd])
    many = InitialViews(prior, covariance)
    ones = [
        InitialViewFilter(InitialView(*p.tolist(), c))
        for p, c in zip(prior, covariance, strict=True)
    ]
    for tick in range(30):
        J = rng.normal(size=(ROBOTS, 2, 1 if tick < 3 else 4)) * 100.0
        information, gradient = J @ J.swapaxes(1, 2), 30.0 * rng.normal(size=(ROBOTS, 2))
        with np.errstate(divide="ignore"):
            many.update(Couplings(np.zeros((ROBOTS, 4, 2)), information, gradient))
        for k, one in enumerate(ones):
            nothing = np.zeros((8, 2)), np.zeros((4, 2))
            one.update(Coupling(*nothing, information[k], gradient[k]))
            np.testing.assert_allclose(many.state[k], [one.view.phi, one.view.bearing], atol=1e-9)
            a, b, c = (float(each[k]) for each in many.covariance)
            np.testing.assert_allclose([[a, b], [b, c]], one.view.covariance, rtol=1e-7)


@pytest.mark.parametrize(("noise", "wrong"), [(0.0, 0.0), (SIGMA, 0.0), (SIGMA, 0.3), (0.03, 0.1)])
def test_planar_motions_are_those_of_single_searches(noise: float, wrong: float) -> None:
    """With features that only one view shows, and wrong matches; some motions are not sound."""
    rng = np.random.default_rng(3)
    _, a, _, b = scenes(rng, noise)
    gross = rng.random((ROBOTS, FEATURES)) < wrong
    b[gross] = unit(rng.normal(size=(gross.sum(), 3)))
    b[0] = a[0]  # identical views
    shared = (rng.random((ROBOTS, FEATURES)) > np.linspace(0.0, 0.95, ROBOTS)[:, None]) * 1.0
    sigma = np.full(ROBOTS, max(noise, SIGMA))
    views, seeds = Rays(parts(a), parts(b), shared, sigma), list(range(ROBOTS))
    with np.errstate(all="ignore"):
        motions, same = search(views, seeds, 4.0, 300), identical(views)
    sound = []
    for k in range(ROBOTS):
        which = shared[k] > 0.0
        one = ransac_planar_motion(
            a[k][which], b[k][which], sigma[k], seed=k, threshold_sigmas=4.0, hypotheses=300
        )
        assert motions.sound[k] == (one.health is Health.OK)
        if which.sum() > 1:
            assert same[k] == identical_views(a[k][which], b[k][which], sigma[k])
        if not motions.sound[k]:
            continue
        sound.append(k)
        # The search takes a last step of less than 1 % of a ray's noise or does not, by rounding.
        np.testing.assert_allclose(motions.phi[k], one.phi, atol=1e-8)
        np.testing.assert_allclose(np.sin(motions.direction[k] - one.direction), 0.0, atol=1e-8)
        np.testing.assert_allclose(motions.covariance[k], one.covariance, rtol=1e-6, atol=1e-12)
    assert 0 < len(sound) < ROBOTS


def random_velocities(rng: np.random.Generator) -> Velocities:
    """Some beyond the limits, some the same from tick to tick."""
    v, omega = rng.integers(-3, 4, ROBOTS) * 0.2, rng.integers(-3, 4, ROBOTS) * 0.4
    return Velocities(v + 0.01 * rng.normal(size=ROBOTS) * (v > 0.0), omega)


def each(velocities: Velocities) -> list[Velocity]:
    return [Velocity(*pair) for pair in zip(*(part.tolist() for part in velocities), strict=True)]


@pytest.mark.parametrize("setting", ["mock.ideal=true", "mock.actuation.quantise=false", "seed=1"])
def test_bases_move_as_the_mock_does(setting: str) -> None:
    rng = np.random.default_rng(4)
    plan = plan_from((0.3, -2.0, 10.0), 0, setting)
    start = plan.scenario.start.pose()
    bases = Bases(np.tile(np.array(start), (ROBOTS, 1)), plan)
    with ExitStack() as stack:
        ones = [stack.enter_context(plan.open_backend()) for _ in range(ROBOTS)]
        for _ in range(30):
            sent = bases.command(velocities := random_velocities(rng))
            bases.sleep_until(bases.now + rng.choice([0.05, 0.1, 0.3], ROBOTS))
            for k, one in enumerate(ones):
                command = one.base.command(each(velocities)[k])
                np.testing.assert_allclose(each(sent)[k], command, atol=1e-15)
                one.clock.sleep_until(float(bases.now[k]))
                np.testing.assert_allclose(
                    each(bases.set_point)[k], one.base.odometry().velocity, atol=1e-12
                )
                turn = bases.pose[k] - np.array(one.truth())
                np.testing.assert_allclose(turn[:2], 0.0, atol=1e-12)
                assert abs(np.sin(turn[2] / 2.0)) < 1e-12


@pytest.mark.parametrize("limits", [LIMITS, None])
def test_shapers_guards_and_reckonings_are_those_of_single_robots(limits: Limits | None) -> None:
    rng = np.random.default_rng(5)
    shapers = Shapers(ROBOTS, limits, whole_units=True)
    guards, reckonings = Guards(ROBOTS, limits), Reckonings(ROBOTS, limits)
    single = [
        (
            CommandShaper(limits, whole_units=True),
            Guard(limits, SafetyOptions(), 0.1),
            DeadReckoning(limits, 0.0),
        )
        for _ in range(ROBOTS)
    ]
    now, dt = np.zeros(ROBOTS), np.full(ROBOTS, 0.1)
    for tick in range(30):
        wanted = random_velocities(rng)
        shaped = shapers.command(wanted, dt)
        sent = guards.permit(wanted, dt)
        guards.was_sent(sent)
        motion = reckonings.motion(sent, dt)
        halted = rng.random(ROBOTS) < 0.1
        shapers.stop(halted)
        for k, (shaper, guard, reckoning) in enumerate(single):
            time, step = float(now[k]), float(dt[k])
            expected = shaper.command(each(wanted)[k], step)
            np.testing.assert_allclose(each(shaped)[k], expected, atol=1e-15)
            permitted = guard.permit(each(wanted)[k], time)
            guard.was_sent(permitted, time)
            np.testing.assert_allclose(each(sent)[k], permitted, atol=1e-12)
            np.testing.assert_allclose(motion[k], reckoning.motion(permitted, step), atol=1e-12)
            if halted[k]:
                shaper.stop()
        dt = rng.choice([0.1, 0.1 + 1e-15, 0.07], ROBOTS)
        now = now + dt
        assert tick < 29 or np.abs(motion).max() > 0.01


def test_robots_taken_and_joined_are_the_same_robots() -> None:
    plan = plan_from((0.3, -2.0, 10.0), 0)
    bases = Bases(np.random.default_rng(6).normal(size=(5, 3)), plan)
    bases.command(Velocities(np.arange(5.0) / 10.0, np.arange(5.0) / 10.0))
    some = [bases.take(np.array(index, dtype=np.intp)) for index in ([0, 3], [], [4, 1, 2])]
    joined = Bases.joined(some)
    for one in (bases, joined):
        one.sleep_until(one.now + 0.2)
    np.testing.assert_array_equal(joined.pose, bases.pose[[0, 3, 4, 1, 2]])
    np.testing.assert_array_equal(joined.set_point.v, bases.set_point.v[[0, 3, 4, 1, 2]])
