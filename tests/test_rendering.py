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

from lpv_track_env import kernels
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.registration import PATH_TRACKING
from lpv_track_env.rendering import HEIGHT, WIDTH, Renderer, Scenery, style
from lpv_track_env.rendering import renderer as rendering

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


def near_vehicle(frame: Frame) -> Frame:
    return frame[HEIGHT // 2 - 60 : HEIGHT // 2 + 60, WIDTH // 2 - 60 : WIDTH // 2 + 60]


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
    assert (near_vehicle(frame) == rendering.BODY).all(axis=2).sum() > 300


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


def test_camera_follows_and_the_trail_stays() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    before = frame_of(env)
    for _ in range(80):
        env.step(np.array([0.8, 0.0], dtype=np.float32))
        after = frame_of(env)
    assert env.state[4] > 10.0
    # The vehicle stays in the middle; behind it, on the left, the trail of 15 pixels a metre.
    np.testing.assert_array_equal(
        (near_vehicle(before) == rendering.BODY).all(axis=2),
        (near_vehicle(after) == rendering.BODY).all(axis=2),
    )
    columns = (after == rendering.TRAIL).all(axis=2)[HEIGHT // 2 - 5 : HEIGHT // 2 + 5].any(axis=0)
    length = int(columns[: WIDTH // 2].sum())
    driven = min(env.state[4] * WIDTH / rendering.VIEW_WIDTH, WIDTH / 2)
    body = 0.5 * env.vehicle.length * WIDTH / rendering.VIEW_WIDTH
    assert length == pytest.approx(driven - body, abs=12)


def test_steered_wheels_and_numbers_are_drawn() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    renderer = Renderer("rgb_array", 20)
    renderer.begin(env.task)
    memory = env._memory.copy()
    straight = renderer.draw(memory)
    memory[kernels.STEERING] = 0.4
    steered = renderer.draw(memory)
    assert straight is not None
    assert steered is not None
    changed = (straight != steered).any(axis=2)
    rows, columns = np.nonzero(changed)
    # Only the front wheels, right of the middle on this path to the east, and the panel's number.
    panel = columns < rendering.MARGIN + rendering.TEXT_WIDTH
    assert panel.any()
    wheels = ~panel
    assert wheels.any()
    assert columns[wheels].min() > WIDTH // 2
    assert columns[wheels].max() < WIDTH // 2 + 40
    assert np.abs(rows[wheels] - HEIGHT // 2).max() < 25


def test_plan_is_drawn_until_it_is_taken_away() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    plan = np.column_stack([np.linspace(5.0, 20.0, 20), np.linspace(0.0, 3.0, 20)])
    env.show_plan(plan)  # before the first frame: it must not be lost
    with_plan = frame_of(env)
    assert (with_plan == rendering.PLAN).all(axis=2).sum() > 100
    env.show_plan(None)
    without = frame_of(env)
    assert not (without == rendering.PLAN).all(axis=2).any()
    for odd in (np.empty((0, 2)), np.full((3, 2), np.nan), np.full((2, 2), 1e12)):
        env.show_plan(odd)
        np.testing.assert_array_equal(frame_of(env), without)
    env.show_plan(plan)
    env.reset(seed=0)
    np.testing.assert_array_equal(frame_of(env), without)


def test_end_is_written() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0, options={"lateral_error": 6.0})
    env.step(ACTION)
    assert (frame_of(env) == rendering.ALERT).all(axis=2).any()


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
    env.show_plan(np.zeros((3, 2)))
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
    frame = renderer.draw(env._memory)
    assert frame is not None
    return frame


def count(frame: Frame, colour: tuple[int, int, int]) -> int:
    return int((frame == colour).all(axis=2).sum())


def test_scenery_takes_the_corridors_place() -> None:
    bare, road = drawn(Scenery([], [])), drawn(Scenery([SQUARE], []))
    assert count(bare, style.ROAD) == 0
    wide = count(road, style.ROAD)
    assert wide > 1000
    line = np.array([(-8.0, 10.0), (8.0, 10.0)])
    solid, dashed = (count(drawn(Scenery([SQUARE], [(line, d)])), style.ROAD) for d in (0, 1))
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
    assert count(drawn(others=near), style.OTHER) > 300
    far, broken = near + 1000.0, near * np.nan
    for unseen in (far, broken, np.empty((0, 5))):
        np.testing.assert_array_equal(drawn(others=unseen), alone)
    # Turned by a quarter it is as large, elsewhere.
    turned = drawn(others=np.array([[6.0, 4.0, 0.3 + np.pi / 2, 4.6, 1.9]]))
    assert abs(count(turned, style.OTHER) - count(drawn(others=near), style.OTHER)) < 200
    with pytest.raises(ValueError, match=r"others must be \(m, 5\)"):
        drawn(others=np.zeros((2, 4)))
