"""What the obstacle providers make of a list and of echoes, and runs on sonar alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from obstacle_world import AHEAD, ROBOT, Watch, axle, run, scene_with

from visctrl.contracts import Context, Health, Obstacle
from visctrl.hal.types import Pose, Range
from visctrl.planning.providers.listed import Listed, ListedOptions
from visctrl.planning.providers.occupancy_grid import CELL_M, EchoMap, Reading
from visctrl.planning.providers.sonar import Sonar, SonarOptions
from visctrl.robots.unicycle import relative_pose
from visctrl.schemes.pose.estimate import Need, PoseEstimate
from visctrl.sim.options import Box
from visctrl.sim.world.scene_world import SceneWorld

START = Pose(0.0, -3.5, 0.0)


def estimate(pose: Pose, sd: float = 0.01, need: Need = Need.NOTHING) -> PoseEstimate:
    covariance = np.diag([sd**2, 0.25 * sd**2, 1e-4])
    return PoseEstimate(
        health=Health.OK, pose=pose, covariance=covariance, initial=START, need=need
    )


def context() -> Context:
    # No plugin here looks at the camera.
    return Context(None, None, AHEAD, 0.1, 0, True, ROBOT.body)  # type: ignore[arg-type]


def in_target_frame(found: Obstacle, pose: Pose) -> tuple[float, float]:
    s, c = math.sin(pose.phi), math.cos(pose.phi)
    return (
        pose.x + c * found.right - s * found.forward,
        pose.y + s * found.right + c * found.forward,
    )


def test_listed_obstacles_are_noticed_from_their_own_distance_and_kept() -> None:
    discs = [{"x_m": 1.0, "y_m": 0.0, "radius_m": 0.2, "noticed_m": 1.0}, {"x_m": 9.0, "y_m": 0.0}]
    source = Listed(ListedOptions.model_validate({"discs": discs}), context())
    assert not source.update(estimate(Pose(-0.25, 0.0, 0.0)), (), 0.0)
    for pose in (Pose(-0.15, 0.0, 0.5), Pose(-3.0, 1.0, -2.0)):
        (found,) = source.update(estimate(pose), (), 1.0)
        assert in_target_frame(found, pose) == pytest.approx((1.0, 0.0))
        assert found.radius == pytest.approx(0.2 + 2 * 0.01)
        assert found.certain
    assert source.values() == {"noticed": 1.0}


def test_listed_obstacles_grow_with_the_doubt_about_the_pose_but_not_without_end() -> None:
    source = Listed(ListedOptions.model_validate({"discs": [{"x_m": 0.0, "y_m": 0.0}]}), context())
    radii = [
        source.update(estimate(START._replace(y=-1.0), sd), (), 0.0)[0].radius
        for sd in (0, 0.05, 9)
    ]
    assert radii == pytest.approx([0.3, 0.4, 0.6])


def test_nothing_is_listed_before_the_robot_knows_where_it_is() -> None:
    source = Listed(ListedOptions.model_validate({"discs": [{"x_m": 0.0, "y_m": 0.0}]}), context())
    assert not source.update(estimate(Pose(0.0, 0.0, 0.0), need=Need.FORWARD), (), 0.0)
    (expected,) = source.expected()
    assert expected[:3] == (0.0, 0.0, 0.3)


def test_an_echo_lies_where_the_sensor_looked() -> None:
    source = Sonar(SonarOptions(), context())
    here = Pose(1.0, -3.0, math.pi / 2)
    found: list[Obstacle] = []
    for tick in range(3):
        found = list(source.update(estimate(here), [Range(0.1, 0.2, 0.3, 1.0)], 0.1 * tick))
    # Where a turn to the left by 90° takes what the sensor meets.
    met = np.array([0.1 + math.sin(0.3), 0.2 - AHEAD + math.cos(0.3)])
    expected = np.array([here.x - met[1], here.y + met[0]])
    cells = np.array([in_target_frame(each, here) for each in found])
    assert np.hypot(*(cells.mean(axis=0) - expected).T) < 0.06
    assert not any(each.certain for each in found)


def test_an_old_echo_counts_from_where_the_robot_was() -> None:
    """A robot that turns: readings that are 0.4 s old lie where they were heard, not beside."""
    late, prompt = Sonar(SonarOptions(), context()), Sonar(SonarOptions(), context())
    for tick in range(12):
        now = 0.1 * tick
        pose = START._replace(phi=0.3 * now)
        turned_by = 0.3 * 0.4
        heard = [Range(0.0, AHEAD, 0.0, 1.2, 0.4)] if tick >= 4 else []
        late.update(estimate(pose), heard, now)
        prompt.update(
            estimate(START._replace(phi=pose.phi - turned_by)),
            [heard[0]._replace(age=0.0)] if heard else [],
            now,
        )
    later, sooner = (
        np.array([in_target_frame(o, pose._replace(phi=phi)) for o in source._found])
        for source, phi in ((late, pose.phi), (prompt, pose.phi - turned_by))
    )
    assert np.hypot(*(later.mean(axis=0) - sooner.mean(axis=0))) < 0.005


def test_the_same_reading_counts_once() -> None:
    source = Sonar(SonarOptions(), context())
    for tick in range(8):
        now = 0.1 * tick
        source.update(estimate(START), [Range(0.0, 0.0, 0.0, 1.5, now)], now)
    assert not source._found
    assert not source.notes()
    assert Sonar(SonarOptions(), context()).notes()


def swept(world: SceneWorld, camera: Pose, angles: np.ndarray) -> EchoMap:
    """Return the map of a robot that turns on the spot through some angles."""
    grid = EchoMap(1.8, math.radians(24.0))
    for angle in angles.tolist():
        here = axle(camera._replace(phi=camera.phi + angle))
        readings = []
        assert ROBOT.sonar is not None
        for at in ROBOT.sonar.transducers.values():
            away = world.sonar(here, at)
            s, c = math.sin(here.phi), math.cos(here.phi)
            x = here.x - c * at.left_m - s * at.forward_m
            y = here.y - s * at.left_m + c * at.forward_m
            away = away if away < ROBOT.sonar.range_m else math.inf
            relative = relative_pose((x, y, here.phi + at.direction_rad), camera).tolist()
            readings.append(Reading(*relative, away))
        grid.take(readings)
    return grid


def test_turning_shows_how_wide_a_box_is() -> None:
    """From one place a cone tells an arc; turned to either side, cones agree on the box alone."""
    world = SceneWorld(scene_with("hall", [Box(x_m=0.0, y_m=-2.0)]), ROBOT)
    still = swept(world, START, np.zeros(20))
    turning = np.radians(np.concatenate([np.zeros(20), np.arange(14), np.arange(14, -14, -1)]))
    looked = swept(world, START, turning)

    def width(grid: EchoMap) -> float:
        ahead = grid.occupied()
        ahead = ahead[(np.hypot(*ahead.T) < 1.6) & (ahead[:, 1] > 0.0)]
        return float(np.ptp(ahead[:, 0]))

    assert width(still) > 0.9
    assert 0.35 < width(looked) < 0.65


@given(st.integers(0, 2**32))
@settings(max_examples=15, deadline=None)
def test_what_is_in_view_is_never_missed(seed: int) -> None:
    """A box anywhere within reach: after a look, its nearest side is occupied."""
    rng = np.random.default_rng(seed)
    away, bearing = rng.uniform(0.9, 1.6), rng.uniform(-1.0, 1.0)
    x, y = START.x + away * math.sin(bearing), START.y - AHEAD + away * math.cos(bearing)
    box = Box(x_m=x, y_m=y, yaw_deg=rng.uniform(0.0, 90.0), width_m=0.3, depth_m=0.3)
    solid = scene_with("hall", [box])
    looked = swept(
        SceneWorld(solid, ROBOT),
        START,
        np.radians(np.concatenate([np.arange(14), np.arange(14, -14, -1)])),
    )
    corners = solid.items[-1].outline()
    edge = np.concatenate(
        [np.linspace(a, b, 20) for a, b in zip(corners, np.roll(corners, 1, 0), strict=True)]
    )
    nearest = edge[np.hypot(*(edge - [START.x, START.y - AHEAD]).T).argmin()] - [START.x, START.y]
    assert np.hypot(*(looked.occupied() - nearest).T).min() < 2.5 * CELL_M


def test_what_has_gone_is_forgotten_and_what_comes_is_noticed() -> None:
    grid = EchoMap(1.8, math.radians(24.0))
    there, gone = Reading(0.0, 0.0, 0.0, 1.2), Reading(0.0, 0.0, 0.0, math.inf)
    # A 10 Hz sonar: within half a second, and within one where it was known to be free.
    for expected, reading, count in ((True, there, 5), (False, gone, 5), (True, there, 10)):
        for _ in range(count):
            grid.take([reading])
        assert (np.abs(grid.occupied()[:, 0]) < 0.15).any() == expected


def test_the_map_follows_the_robot() -> None:
    grid = EchoMap(1.8, math.radians(24.0))
    for _ in range(3):
        grid.take([Reading(0.0, 0.0, 0.0, 1.2)])
    before = grid.occupied()
    grid.follow(0.0, 1.0)
    np.testing.assert_allclose(grid.occupied(), before)
    for y in range(1, 8):
        grid.follow(0.0, float(y))
    assert not len(grid.occupied())


@pytest.mark.parametrize(
    ("start", "boxes"),
    [
        ((-0.3, -3.6, 0.0), [(-0.05, -1.8)]),
        ((-0.8, -3.2, -20.0), [(-0.3, -1.7)]),
        ((0.9, -3.0, 15.0), [(0.4, -1.5)]),
        ((0.0, -3.5, 0.0), [(-0.3, -2.0), (0.3, -2.0)]),
        # Only the hall's walls and furniture.
        ((-0.55, -1.35, -35.0), []),
    ],
)
def test_sonar_alone_leads_round_boxes_in_the_hall(
    start: tuple[float, float, float], boxes: list[tuple[float, float]]
) -> None:
    placed = [{"x_m": x, "y_m": y} for x, y in boxes]
    solid = SceneWorld(scene_with("hall", [Box.model_validate(box) for box in placed]), ROBOT)
    watch = Watch(solid=solid)
    chosen = {
        **{f"start.{k}": v for k, v in zip(("x_m", "y_m", "phi_deg"), start, strict=True)},
        **{"solid.boxes": placed, "controller.tau_s": 30.0, "duration_s": 150.0},
        "obstacles": [{"name": "sonar"}],
    }
    outcome = run(chosen, watch, "solid")
    assert not watch.touched
    assert outcome.summary["status"] == "reached", outcome.summary["reason"]
    assert ("look" in watch.phases) is bool(boxes)


def test_a_first_leg_that_is_blocked_is_not_driven() -> None:
    solid = SceneWorld(scene_with("hall", [Box(x_m=0.0, y_m=-2.75)]), ROBOT)
    watch = Watch(solid=solid)
    chosen = {
        **{"start.x_m": 0.0, "start.y_m": -3.5, "start.phi_deg": 0.0, "duration_s": 10.0},
        **{"solid.boxes": [{"x_m": 0.0, "y_m": -2.75}], "obstacles": [{"name": "sonar"}]},
    }
    outcome = run(chosen, watch, "solid")
    assert not watch.touched
    assert watch.phases[-1] == "blocked"
    assert outcome.summary["status"] == "missed"
