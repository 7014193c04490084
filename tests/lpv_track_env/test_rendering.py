"""Frames: their shape, what changes them and what does not, with and without a display."""

import pickle
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from numpy.typing import NDArray

from lpv_track_env import PATH_TRACKING, kernels
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.rendering import COLOURINGS, HEIGHT, WIDTH, Renderer, Scenery, canvas
from lpv_track_env.rendering.canvas import SCENE_HEIGHT, View, clipped
from lpv_track_env.rendering.charts import signals_of
from lpv_track_env.rendering.renderer import MIDDLE, ROOM, Camera
from lpv_track_env.rendering.vehicles import ackermann, axle_forces
from lpv_track_env.vehicle import VEHICLES

Frame = NDArray[np.uint8]
ACTION = np.array([0.8, 0.03], dtype=np.float32)


def make(render_mode: str | None = "rgb_array", **settings: Any) -> PathTrackingEnv:
    env = gymnasium.make(PATH_TRACKING, render_mode=render_mode, **settings).unwrapped
    assert isinstance(env, PathTrackingEnv)
    return env


def frame_of(env: PathTrackingEnv) -> Frame:
    frame = env.render()
    assert frame is not None
    return frame


def frames(seed: int, steps: int = 20, **settings: Any) -> list[Frame]:
    env = make(initial_error_range=(0.5, 0.1, 1.0), **settings)
    env.reset(seed=seed)
    shots = [frame_of(env)]
    for _ in range(steps):
        env.step(ACTION)
        shots.append(frame_of(env))
    env.close()
    return shots


def scene(frame: Frame) -> Frame:
    """The part without the charts."""
    return frame[:SCENE_HEIGHT]


def charts(frame: Frame) -> Frame:
    return frame[SCENE_HEIGHT:]


def count(frame: Frame, colour: tuple[int, int, int]) -> int:
    """Pixels of a colour."""
    return int((frame == colour).all(axis=2).sum())


def places(frame: Frame, colour: tuple[int, int, int]) -> NDArray[np.intp]:
    """Pixels (n, 2), x and y, of a colour."""
    rows, columns = np.nonzero((frame == colour).all(axis=2))
    return np.column_stack([columns, rows])


@pytest.mark.parametrize("trajectory", ["T1", "T3-raw", "circle", "figure-eight", "straight"])
@pytest.mark.parametrize("vehicle", ["m2-minibus", "course-car"])
def test_a_frame_is_a_picture(trajectory: str, vehicle: str) -> None:
    env = make(trajectory=trajectory, vehicle=vehicle)
    env.reset(seed=0)
    frame = frame_of(env)
    assert frame.shape == (600, 900, 3)
    assert frame.dtype == np.uint8
    assert frame.flags.writeable
    assert frame.flags.c_contiguous
    # A light scene with something in it.
    assert 200.0 < frame.mean() < 250.0
    assert len(np.unique(frame.astype(np.uint32) @ np.uint32([65536, 256, 1]))) > 50
    assert count(scene(frame), canvas.BODY) > 300
    assert count(charts(frame), canvas.TRACE) > 0 or env._record[kernels.STEPS] == 0


def test_frames_change_over_time() -> None:
    shots = frames(0)
    assert all(not np.array_equal(a, b) for a, b in pairwise(shots))


def test_equal_seeds_give_equal_frames_and_others_do_not() -> None:
    one, same, other = frames(4, trajectory="T2"), frames(4, trajectory="T2"), frames(5, 0)
    for a, b in zip(one, same, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one[0], other[0])


def test_drawing_again_changes_nothing() -> None:
    env = make(trajectory="u-turn")
    env.reset(seed=0)
    first = frame_of(env)
    kept = first.copy()
    np.testing.assert_array_equal(frame_of(env), kept)
    first[:] = 0
    np.testing.assert_array_equal(frame_of(env), kept)


def test_drawing_does_not_touch_the_episode() -> None:
    drawn, plain = make(trajectory="u-turn"), make(None, trajectory="u-turn")
    drawn.reset(seed=0)
    plain.reset(seed=0)
    for _ in range(10):
        frame_of(drawn)
        np.testing.assert_array_equal(drawn.step(ACTION)[0], plain.step(ACTION)[0])


def test_trail_and_vehicle_stay_in_the_picture() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    trails = []
    for k in range(160):
        env.step(np.array([0.8, 0.0], dtype=np.float32))
        if k % 40 == 39:
            frame = scene(frame_of(env))
            trails.append(np.ptp(places(frame, canvas.TRAIL)[:, 0]))
            body = places(frame, canvas.BODY)
            assert np.abs(body.mean(axis=0) - MIDDLE)[0] < ROOM[0] + 10.0
            assert np.abs(body.mean(axis=0) - MIDDLE)[1] < 5.0
    assert trails[0] < trails[1]


def test_camera_moves_smoothly_and_looks_ahead() -> None:
    """From frame to frame neither place nor scale jumps, also where the path does."""
    env = make(trajectory="T3-raw")
    env.reset(seed=0)
    camera = Camera()
    before: tuple[NDArray[np.float64], float] | None = None
    for k in range(400):
        s = 0.35 * k
        x, y = (float(np.interp(s, env.path.arc_length, axis)) for axis in (env.path.x, env.path.y))
        camera.follow(0.05 * k, 7.0, x, y, s, env.path)
        view = camera.view(x, y)
        vehicle = view.pixels(np.array([x, y])) / canvas.SUPERSAMPLING
        offset = (vehicle - MIDDLE) / ROOM
        assert np.hypot(*offset) <= 1.0 + 1e-9
        if before is not None:
            assert np.abs(vehicle - before[0]).max() < 6.0
            assert view.scale == pytest.approx(before[1], rel=0.01)
        before = vehicle, view.scale
        if k == 0:
            ahead = np.interp(s + 10.0, env.path.arc_length, env.path.x)
            assert (vehicle[0] < MIDDLE[0]) == (ahead > x)


def test_camera_is_further_away_at_speed() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    slow, fast = Camera(), Camera()
    slow.follow(0.0, 1.0, 0.0, 0.0, 0.0, env.path)
    fast.follow(0.0, 15.0, 0.0, 0.0, 0.0, env.path)
    assert fast.view(0.0, 0.0).scale < 0.7 * slow.view(0.0, 0.0).scale


def test_steered_wheels_and_forces_are_drawn() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    renderer = Renderer("rgb_array", 20)
    renderer.begin(env.task)
    record = env._record.copy()
    straight = renderer.draw(record)
    record[kernels.STEERING] = 0.4
    steered = renderer.draw(record)
    assert straight is not None
    assert steered is not None
    assert count(scene(straight), canvas.FORCE) == count(scene(steered), canvas.FORCE) - (
        count(scene(steered)[: SCENE_HEIGHT - 60], canvas.FORCE)
    )
    # To the left of a path that leads east, at the front axle.
    arrow = places(scene(steered)[: SCENE_HEIGHT - 60], canvas.FORCE)
    body = places(scene(steered), canvas.BODY).mean(axis=0)
    assert arrow[:, 0].max() > body[0] + 15.0
    assert arrow[:, 1].min() < body[1] - 20.0
    tyres = [count(scene(frame)[100:350, 300:700], canvas.TYRE) for frame in (straight, steered)]
    assert tyres[0] != tyres[1]


def test_the_wheels_axes_meet_on_the_rear_axles_line() -> None:
    left, right = ackermann(0.3, 2.9, 1.5)
    assert left > 0.3 > right
    assert 2.9 / np.tan(left) + 0.75 == pytest.approx(2.9 / np.tan(right) - 0.75)
    assert ackermann(0.0, 2.9, 1.5) == (0.0, 0.0)
    assert ackermann(-0.3, 2.9, 1.5) == pytest.approx((-right, -left))


@pytest.mark.parametrize("vehicle", ["m2-minibus", "course-car"])
def test_axle_forces_are_those_of_linear_tyres(vehicle: str) -> None:
    """The formulas of kumar2025lpv, which hold from 1 m/s upwards."""
    car = VEHICLES[vehicle]
    vx, vy, r, delta = 6.0, 0.2, 0.3, 0.15
    found = axle_forces(vx, vy, r, delta, car)
    front = delta - (vy + car.front_axle_distance * r) / vx
    rear = -(vy - car.rear_axle_distance * r) / vx
    assert found.front_slip == pytest.approx(front)
    assert found.rear_slip == pytest.approx(rear)
    assert found.front == pytest.approx(car.front_cornering_stiffness * front)
    assert found.rear == pytest.approx(car.rear_cornering_stiffness * rear)
    assert np.isfinite(axle_forces(0.0, 0.0, 0.0, 0.5, car)).all()


def test_what_the_agent_shows_is_drawn_until_the_next_episode() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    bare = frame_of(env)
    notes = {"agent": "mine", "Q": "1   2   3   4", "a very long label": "words " * 30}
    env.show_agent(notes=notes)
    told = frame_of(env)
    changed = np.argwhere((told != bare).any(axis=2))
    # A card on the left, and nothing else.
    assert len(changed) > 500
    assert changed[:, 1].max() < 250
    assert changed[:, 0].max() < SCENE_HEIGHT
    env.show_agent(notes={str(k): "v" for k in range(100)})
    assert frame_of(env).shape == bare.shape
    env.reset(seed=0)
    np.testing.assert_array_equal(frame_of(env), bare)


def test_path_is_coloured_by_speed_or_curvature() -> None:
    pictures = {}
    for colour in COLOURINGS:
        env = make(trajectory="T3", render_colour=colour)
        env.reset(seed=0)
        pictures[colour] = frame_of(env)
    assert (pictures["speed"] != pictures["curvature"]).any()
    shades = {colour: canvas.shades(colour, [0.0])[0] for colour in COLOURINGS}
    # A path begins straight and slow: the least of both, on the map.
    for colour, frame in pictures.items():
        assert count(frame, shades[colour]) > 5
        others = [shades[other] for other in COLOURINGS if other != colour]
        assert all(count(frame, other) == 0 for other in others)
    with pytest.raises(ValueError, match=r"unknown render_colour 'sped'.*nearest: speed"):
        make(render_colour="sped")


@pytest.mark.parametrize("vehicle", ["m2-minibus", "course-car", "ford-escort"])
def test_charts_hold_what_they_show(vehicle: str) -> None:
    env = make(trajectory="T2", vehicle=vehicle)
    for signal in signals_of(env.task):
        for largest in (0.0, 0.03, 4.0, 1e12):
            low, high = signal.axis(np.array([-largest, 0.3 * largest]))
            assert low < high
            if signal.ends is not None and largest <= signal.ends[-1]:
                assert low <= -largest
        if signal.ends is None or signal.title == "steering":
            low, high = signal.axis(np.array([max(signal.limits, default=0.0)]))
            assert all(low < limit < high for limit in signal.limits)


def test_frames_of_odd_episodes() -> None:
    """Far from the path, at standstill, in reverse, spinning: a frame all the same."""
    env = make(trajectory="T2")
    env.reset(seed=0)
    renderer = Renderer("rgb_array", 20)
    for changes in (
        {kernels.X: 1e5, kernels.Y: -1e5, kernels.LATERAL_ERROR: 1e5},
        {0: 0.0, 6: 0.0},
        {0: -8.0, 3: 5.0, kernels.HEADING_ERROR: 3.1},
        {0: 80.0, 1: 40.0, 3: -20.0, kernels.ARC_LENGTH: 1e4},
    ):
        renderer.begin(env.task)
        record = env._record.copy()
        for entry, value in changes.items():
            record[entry] = value
        frame = renderer.draw(record)
        assert frame is not None
        assert 100.0 < frame.mean() < 255.0
        record[kernels.STEPS] += 400.0
        again = renderer.draw(record)
        assert again is not None


def test_plan_is_drawn_until_it_is_taken_away() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    plan = np.column_stack([np.linspace(5.0, 20.0, 20), np.linspace(0.0, 3.0, 20)])
    env.show_agent(plan)  # before the first frame: it must not be lost
    with_plan = frame_of(env)
    assert count(scene(with_plan), canvas.PLAN) > 100
    env.show_agent()
    without = frame_of(env)
    assert not count(without, canvas.PLAN)
    for odd in (np.empty((0, 2)), np.full((3, 2), np.nan), np.full((2, 2), 1e12)):
        env.show_agent(odd)
        # But for the key, which says what a plan looks like.
        np.testing.assert_array_equal(
            frame_of(env)[: SCENE_HEIGHT - 50], without[: SCENE_HEIGHT - 50]
        )
    env.show_agent(plan)
    env.reset(seed=0)
    np.testing.assert_array_equal(frame_of(env), without)


def test_end_is_written() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0, options={"lateral_error": 6.0})
    env.step(ACTION)
    assert count(scene(frame_of(env)), canvas.ALERT) > 20


def test_close_twice_and_draw_again() -> None:
    env = make(trajectory="u-turn")
    env.reset(seed=0)
    frame = frame_of(env)
    env.close()
    env.close()
    np.testing.assert_array_equal(frame_of(env), frame)
    renderer = Renderer("rgb_array", 20)
    renderer.close()
    renderer.close()


def test_an_environment_with_a_renderer_can_be_pickled() -> None:
    env = make(trajectory="u-turn")
    env.reset(seed=0)
    frame = frame_of(env)
    clone = pickle.loads(pickle.dumps(env))  # noqa: S301
    np.testing.assert_array_equal(frame_of(clone), frame)


def test_no_render_mode_draws_nothing() -> None:
    env = make(None, trajectory="u-turn")
    env.reset(seed=0)
    env.show_agent(np.zeros((3, 2)))
    with pytest.warns(UserWarning, match="needs render_mode"):
        assert env.render() is None


def test_arrays_need_no_display(tmp_path: Path) -> None:
    code = (
        "import gymnasium, pygame, lpv_track_env\n"
        "env = gymnasium.make('lpv_track_env/PathTracking-v0', trajectory='straight',\n"
        "                     render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "print(env.render().mean() > 200.0, pygame.display.get_init())\n"
    )
    environment = {"PATH": "", "SDL_VIDEODRIVER": "x11", "DISPLAY": ":77", "HOME": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "True False"


# Windows, on SDL's driver without a screen -----------------------------------------------------


@pytest.fixture
def _offscreen(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    yield
    pygame.display.quit()


@pytest.mark.usefixtures("_offscreen")
def test_window_opens_and_closes() -> None:
    env = make("human", trajectory="u-turn")
    env.reset(seed=0)
    window = pygame.display.get_surface()
    assert window is not None
    assert window.get_size() == (WIDTH, HEIGHT)
    assert env.render() is None
    shown = pygame.surfarray.array3d(window).swapaxes(0, 1)
    other = make(trajectory="u-turn")
    other.reset(seed=0)
    np.testing.assert_array_equal(shown, frame_of(other))
    env.step(ACTION)
    env.close()
    env.close()
    assert not pygame.display.get_init()


@pytest.mark.usefixtures("_offscreen")
@pytest.mark.parametrize(
    "event", [(pygame.QUIT, {}), (pygame.KEYDOWN, {"key": pygame.K_ESCAPE})], ids=["quit", "escape"]
)
def test_closing_the_window_ends_the_drawing_not_the_run(event: tuple[int, dict[str, Any]]) -> None:
    env = make("human", trajectory="u-turn")
    env.reset(seed=0)
    pygame.event.post(pygame.event.Event(*event))
    env.step(ACTION)
    assert not pygame.display.get_init()
    env.step(ACTION)
    env.reset(seed=0)
    env.step(ACTION)
    assert not pygame.display.get_init()
    env.close()


@pytest.mark.usefixtures("_offscreen")
def test_space_pauses_and_a_resized_window_keeps_the_frames_shape() -> None:
    env = make("human", trajectory="u-turn")
    env.reset(seed=0)
    space = pygame.event.Event(pygame.KEYDOWN, {"key": pygame.K_SPACE})
    pygame.event.post(space)
    pygame.event.post(space)  # else it would wait for it
    env.step(ACTION)
    assert pygame.display.get_caption()[0] == "lpv-track-env"
    window = pygame.display.set_mode((500, 600), pygame.RESIZABLE)
    env.step(ACTION)
    shown = pygame.surfarray.array3d(window).swapaxes(0, 1)
    assert (shown[:100] == 255).all()
    assert (shown[150:400] != 255).any()
    env.close()


@pytest.mark.usefixtures("_offscreen")
@pytest.mark.filterwarnings("error")
def test_window_without_a_display_is_warned_of_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # What SDL chooses by itself where there is no display, made sure of here.
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    pygame.display.init()
    monkeypatch.delenv("SDL_VIDEODRIVER")
    env = make("human", trajectory="u-turn")
    with pytest.warns(UserWarning, match="no display found") as caught:
        env.reset(seed=0)
    assert len(caught) == 1
    env.step(ACTION)  # a second warning would be an error
    env.close()


@pytest.mark.usefixtures("_offscreen")
def test_no_video_driver_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise pygame.error("No available video device")

    monkeypatch.setattr(pygame.display, "set_mode", refuse)
    env = make("human", trajectory="u-turn")
    with pytest.raises(RuntimeError, match=r"needs a display .*: use render_mode='rgb_array'$"):
        env.reset(seed=0)
    env.close()


def test_trail_holds_the_steps_between_frames() -> None:
    """A run that draws every tenth step shows the same trail as one that draws them all."""
    frames = []
    for every in (1, 10):
        env = gymnasium.make(
            "lpv_track_env/PathTracking-v0", trajectory="circle", render_mode="rgb_array"
        )
        env.reset(seed=0)
        env.render()
        for k in range(1, 41):
            env.step(np.array([0.2, 0.12], dtype=np.float32))
            if k % every == 0:
                frame = env.render()
        frames.append(frame)
        env.close()
    np.testing.assert_array_equal(frames[0], frames[1])


# Roads and other vehicles ----------------------------------------------------------------------

SQUARE = np.array([(-8.0, 6.0), (8.0, 6.0), (8.0, 14.0), (-8.0, 14.0)])


def drawn(scenery: Scenery | None = None, others: NDArray[np.float64] | None = None) -> Frame:
    """The start of the straight path, which leads east from the origin."""
    env = make(trajectory="straight")
    env.reset(seed=0)
    renderer = Renderer("rgb_array", 20)
    renderer.begin(env.task, scenery)
    renderer.others = others
    frame = renderer.draw(env._record)
    assert frame is not None
    return frame


def test_scenery_takes_the_corridors_place() -> None:
    bare, road = drawn(Scenery([], [])), drawn(Scenery([SQUARE], []))
    assert count(bare, canvas.ROAD) == 0
    wide = count(road, canvas.ROAD)
    assert wide > 1000
    line = np.array([(-8.0, 10.0), (8.0, 10.0)])
    solid, dashed = (count(drawn(Scenery([SQUARE], [(line, d)])), canvas.ROAD) for d in (0, 1))
    assert solid < dashed < wide


def test_scenery_out_of_sight_changes_nothing_and_much_of_it_is_left_out() -> None:
    bare = drawn(Scenery([], []))
    far = Scenery([SQUARE + 500.0], [(SQUARE + 500.0, False), (SQUARE - 500.0, True)])
    np.testing.assert_array_equal(drawn(far), bare)
    # Lines that pass through the picture from far away are cut, not dropped.
    through = np.column_stack([np.linspace(-2000.0, 2000.0, 400), np.full(400, 9.0)])
    assert (drawn(Scenery([], [(through, False)])) != bare).any()


def test_scenery_that_cannot_be_drawn_is_one_line() -> None:
    for bad in (SQUARE[:2], np.zeros((4, 3)), np.full((4, 2), np.nan)):
        with pytest.raises(ValueError, match="a surface must be"):
            drawn(Scenery([bad], []))
    with pytest.raises(ValueError, match="a line must be"):
        drawn(Scenery([], [(SQUARE[:1], False)]))


def test_other_vehicles_are_drawn_while_set() -> None:
    alone = drawn()
    near = np.array([[6.0, 4.0, 0.3, 4.6, 1.9]])
    assert count(drawn(others=near), canvas.OTHER) > 300
    far, broken = near + 1000.0, near * np.nan
    for unseen in (far, broken, np.empty((0, 5))):
        np.testing.assert_array_equal(drawn(others=unseen), alone)
    # Turned by a quarter it is as large, elsewhere.
    turned = drawn(others=np.array([[6.0, 4.0, 0.3 + np.pi / 2, 4.6, 1.9]]))
    assert abs(count(turned, canvas.OTHER) - count(drawn(others=near), canvas.OTHER)) < 200
    with pytest.raises(ValueError, match=r"others must be \(m, 5\)"):
        drawn(others=np.zeros((2, 4)))


def test_a_polygon_is_cut_to_the_box() -> None:
    low, high = np.array([0.0, 0.0]), np.array([10.0, 5.0])
    everything = clipped(np.array([(-1e6, -1e6), (1e6, -1e6), (1e6, 1e6), (-1e6, 1e6)]), low, high)
    assert area(everything) == pytest.approx(50.0)
    inside = np.array([(1.0, 1.0), (3.0, 1.0), (2.0, 4.0)])
    np.testing.assert_array_equal(clipped(inside, low, high), inside)
    assert len(clipped(inside + 100.0, low, high)) == 0
    half = clipped(inside - (2.0, 0.0), low, high)
    assert area(half) == pytest.approx(0.5 * area(inside))


def area(polygon: NDArray[np.float64]) -> float:
    """Of a polygon (n, 2), by the shoelace formula."""
    x, y = polygon.T
    return abs(float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))))


def test_a_large_road_costs_nothing_out_of_sight() -> None:
    """Polygons given to pygame stay near the picture, however long the road is."""
    view = View((0.0, 0.0), 20.0, (900.0, 456.0))
    low, high = view.window()
    road = np.array([(-1e5, -4.0), (1e5, -4.0), (1e5, 4.0), (-1e5, 4.0)])
    assert np.abs(view.pixels(clipped(road, low - 5.0, high + 5.0))).max() < 4000.0
