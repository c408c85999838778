"""Forecasts in `env.render()`, in highway-env's pictures and in those of an environment of one's own."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

from envs import FilmForecasts, ForecastObservation, FunctionReader, View, register_view
from envs.readers import EntityRowsReader, outcomes
from envs.readers.outcomes import OutcomeKeys
from envs.video import film_forecasts, window
from envs.video.drawing import OverlayStyle
from envs.video.film_forecasts import record_pictures
from envs.video.highway import record_episode
from predictor import Scene, SceneSpec, UserError

STYLE = OverlayStyle(forecast_color=(255, 0, 0), edge_alpha=0)
SPEC = SceneSpec(0.5, ("world", "world"), max_agents=3, perception_m=50.0, feature_scales=(10.0, 10.0, 10.0, 10.0))
WHITE = np.full((401, 600, 3), 255, np.uint8)


class Yard(gym.Env[np.ndarray, int]):
    """Environment of one's own: another agent runs 2 m/s to the right, 5 m above the ego, which stands at (0, 0)."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}
    observation_space, action_space = gym.spaces.Box(-1, 1, (1,), np.float32), gym.spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        hit = self.steps == 3
        return np.zeros(1, np.float32), 0.5, hit, False, {"outcome": {"hit": hit}, "crashed": not hit}

    def render(self) -> Any:
        return WHITE if self.render_mode == "rgb_array" else None


def read(env: gym.Env) -> Scene:
    steps: int = env.get_wrapper_attr("steps")
    states = np.array([[0, 0, 0, 0], [steps, 5, 2, 0], [0, 0, 0, 0]], np.float64)
    return Scene(states, np.array([1, 2, 0]), np.array([True, True, False]))


def view(env: gym.Env) -> View:
    """600 × 400 px show 30 m × 20 m, y up, the ego in the middle of the left side."""
    return View(origin_m=(0.0, 10.0), scaling=20.0, y_up=True)


def filmed(draw: Any = view, mode: str | None = "rgb_array", **options: Any) -> FilmForecasts:
    env = ForecastObservation(Yard(mode), "constant-velocity", reader=FunctionReader(read, SPEC))
    return FilmForecasts(env, draw, style=STYLE, **options)


def red_in(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns where a forecast is drawn, without the legend."""
    picture = picture[:250]
    red = (picture[..., 0] > 200) & (picture[..., 1] < 120) & (picture[..., 2] < 120)
    return np.nonzero(red)


def test_forecasts_lie_where_the_view_says():
    env = filmed()
    env.reset(seed=0)
    env.step(0)
    picture = env.render()
    assert picture.shape == (400, 600, 3), "H.264 needs even sizes"
    rows, columns = red_in(picture)
    assert len(rows) and abs(np.median(rows) - 100) <= 2, "5 m up, 5 m below the upper border"
    assert 16 <= columns.min() <= 24 and columns.max() > 80, "from 1 m on, to the right"


def test_a_picture_of_ones_own_serves_where_the_environment_draws_none():
    env = filmed(lambda env: (WHITE[:400], view(env)), mode=None)
    env.reset(seed=0)
    assert len(red_in(env.render())[0])
    for draw, sentence in ((view, "got nothing; make the env with render_mode='rgb_array'"),
                           (lambda env: (WHITE[..., 0], view(env)), r"got shape \(401, 600\) of uint8")):  # fmt: skip
        env = filmed(draw, mode=None)
        env.reset(seed=0)
        with pytest.raises(UserError, match=sentence):
            env.render()


def test_what_cannot_be_filmed_is_named():
    with pytest.raises(UserError, match="nothing says where the world is in pictures of Yard; pass draw=, a function"):
        filmed(None)
    with pytest.raises(UserError, match="draws the forecasts of a ForecastObservation; wrap the env in one first"):
        FilmForecasts(Yard(), view)
    with pytest.raises(UserError, match="films need an env made with render_mode='rgb_array', got None"):
        FilmForecasts(ForecastObservation(gym.make("highway-fast-v0"), "constant-velocity"))


@pytest.fixture
def registered() -> Iterator[None]:
    register_view(Yard, view)
    yield
    del film_forecasts._REGISTERED[Yard]


def test_a_crash_is_told_under_the_key_that_the_environment_names(monkeypatch: pytest.MonkeyPatch):
    assert not any("crashed" in caption for caption in captions()), "no key is guessed"
    monkeypatch.setitem(outcomes._NAMED, Yard, OutcomeKeys(("outcome.hit",)))
    assert ["crashed" in caption for caption in captions()] == [False, False, True]


def captions(**options: Any) -> list[str]:
    env = filmed(**options)
    env.reset(seed=0)
    return [(env.step(0), env._caption())[1] for _ in range(3)]


def test_a_crash_is_told_under_the_key_that_is_asked_for():
    assert ["crashed" in caption for caption in captions(crash_key="outcome.hit")] == [False, False, True]


@pytest.mark.usefixtures("registered")
def test_a_registered_view_needs_no_argument():
    recording = record_pictures(filmed(None), lambda observation: 0, seed=0)
    assert (len(recording), recording.fps, recording.total_reward) == (4, 2, 1.5)
    first, last = (red_in(recording.draw(i))[1].min() for i in (0, 3))
    assert last - first == pytest.approx(60, abs=4), "it runs 1 m a step"


def test_record_video_films_highway_env_with_its_forecasts(tmp_path: Path):
    env = gym.make("highway-fast-v0", render_mode="rgb_array", config={"vehicles_count": 5, "duration": 3})
    filming = FilmForecasts(ForecastObservation(env, "highway"), num_samples=6, style=STYLE)
    video = RecordVideo(filming, str(tmp_path), disable_logger=True) if _has_moviepy() else filming
    video.reset(seed=0)
    first = video.render() if video is filming else filming.render()
    assert first.shape == (300, 1200, 3) and len(red_in(first)[0]) > 20
    for _ in range(2):
        video.step(1)
    assert (filming.render() != first).mean() > 0.01
    video.close()
    if video is not filming:
        (film,) = tmp_path.glob("*.mp4")
        assert film.read_bytes()[4:8] == b"ftyp"


def test_a_reader_that_counts_from_elsewhere_is_drawn_where_the_cars_are():
    env = gym.make("highway-v0", render_mode="rgb_array", config={"vehicles_count": 5, "duration": 3})
    kinematics = EntityRowsReader(
        ("presence", "x", "y", "vx", "vy"), SceneSpec(dt_s=1.0, frame=("ego", "world")),
        scales=(1.0, 200.0, 16.0, 80.0, 80.0), relative=True, dead_reckoning=True,
    )  # fmt: skip
    seen = ForecastObservation(env, "constant-velocity", reader=kinematics)
    filming = FilmForecasts(seen, style=STYLE)
    filming.reset(seed=0)
    filming.step(1)
    vehicle: Any = env.unwrapped.vehicle  # type: ignore[attr-defined]
    assert abs(vehicle.position[0] - seen.scene.states[0, 0]) > 50
    _, view = filming._picture()
    surface: Any = env.unwrapped.viewer.sim_surface  # type: ignore[attr-defined]
    np.testing.assert_allclose(view.pixels(seen.scene.states[:1, :2])[0], surface.vec2pix(vehicle.position), atol=2)
    with pytest.raises(UserError, match="need highway-env's own reader, got _EntityRows; film with FilmForecasts"):
        record_episode(seen, lambda observation: 1)


def _has_moviepy() -> bool:
    import importlib.util

    return importlib.util.find_spec("moviepy") is not None


def test_a_window_shows_every_picture_until_it_is_closed(monkeypatch: pytest.MonkeyPatch):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    shown: list[tuple[int, int]] = []
    flip = pygame.display.flip
    monkeypatch.setattr(pygame.display, "flip", lambda: (shown.append(pygame.display.get_window_size()), flip()))
    assert window.play((WHITE for _ in range(3)), 1000.0, "yard") == 3
    assert shown == [(600, 401)] * 3

    def close(seconds: float) -> None:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))

    monkeypatch.setattr(window.time, "sleep", close)
    assert window.play((WHITE for _ in range(9)), 1000.0, "yard") == 2


def test_without_a_screen_one_sentence_says_what_to_do(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "no-such-driver")
    with pytest.raises(UserError, match="cannot open a window: .*; leave out --window to write a film"):
        window.play([WHITE], 10.0, "yard")


def test_a_copy_after_a_picture_goes_on_alike():
    env = FilmForecasts(ForecastObservation(gym.make("highway-fast-v0", render_mode="rgb_array"), "constant-velocity"))
    env.reset(seed=0)
    env.render()
    twin = copy.deepcopy(env)
    for each in (env, twin):
        each.step(1)
    np.testing.assert_array_equal(env.render(), twin.render())
