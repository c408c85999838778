"""The command `agents.report`: one page of a run that needs nothing else, and one sentence for what is no run."""

import json
import re
import sys
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.forecast_errors import CONSTANT_ERROR, FORECAST_ERROR
from agents.report import ReportConfig, main, write_report
from agents.results import Evaluation, read_evaluation
from agents.run_page import drawn
from agents.vec_envs import EpisodeResult
from envs.video.files import write_video
from predictor.reports.document import PNG
from predictor.reports.figures import files_of
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import write_json
from tests.hostile.samples import RUN

MADE = {"command": "python train_policy.py", "commit": "abc", "machine": "m", "time": "now", "versions": {"torch": "2"}}
POINTS = [
    {"steps": 10 * i, "return": 3.0 * i, "episodes": 4, "seconds": 1.0, FORECAST_ERROR: 1.25 * i, CONSTANT_ERROR: 7.5}
    for i in (1, 2, 3)
]


def episodes(base: float, action: str, first: int = 100) -> list[EpisodeResult]:
    return [EpisodeResult(first + i, base + i, 30 - i, i == 0, 22.0, {}, {action: 30 - i}) for i in range(7)]


def evaluation() -> Evaluation:
    mixed = [EpisodeResult(e.seed, e.episode_return, e.length, e.crashed, 25.0) for e in episodes(20.0, "")]
    return Evaluation("highway-fast-v0", 100, {"ppo (forecast)": mixed, "slower": episodes(11.0, "slower")})


def a_run(folder: Path, **config: Any) -> Path:
    run = folder / "run"
    run.mkdir()
    write_json(run / "config.json", {"config": RUN | config, "provenance": [MADE]})
    write_json(run / "curve.json", POINTS)
    evaluation().write(run, algorithm="ppo")
    return run


def page_of(run: Path, **options: Any) -> str:
    return write_report(ReportConfig(run, **options)).read_text()


class Addresses(HTMLParser):
    """Collects what a page loads and links."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in ("src", "href", "poster", "xlink:href") and value]


@pytest.mark.slow
def test_the_page_shows_the_run_and_loads_nothing(tmp_path: Path):
    run = a_run(tmp_path)
    pictures = (np.full((48, 64, 3), 40 + i, np.uint8) for i in range(90))
    write_video(run / "video.mp4", pictures, 30)
    page = page_of(run)
    for shown in (
        "<h1>ppo on highway-fast-v0, sees forecasts</h1>", "mean return 23.00 over 7 episodes, 14 % of them with",
        "slower, the strongest driver that always does the same, has 14.00", "<h2>Learning curve</h2>", "<svg",
        "<td>ppo (forecast)</td><td>23.00 ± 0.82</td>", "+9.00 (+9.00 to +9.00)", "<h2>Worst episodes</h2>",
        "<td>100</td><td>20.00</td><td>30</td><td>yes</td><td>25.0</td>", "<h2>Forecast errors in the loop</h2>",
        "<td>30</td><td>3.75</td><td>7.50</td>", "python train_policy.py; commit abc; m; now.", "Versions: torch 2",
        "<td>env_id</td><td>highway-fast-v0</td>",
    ):  # fmt: skip
        assert shown in page, shown
    assert str(tmp_path) not in page, "no paths"
    loaded = Addresses()
    loaded.feed(page)
    inside = [address.partition(";")[0] for address in loaded.found if address.startswith("data:")]
    assert inside == ["data:image/jpeg", "data:video/mp4"], "a still, and the film"
    assert [address for address in loaded.found if not address.startswith(("data:", "#"))] == ["video.mp4"]
    assert not re.search(r"https?://(?!www\.w3\.org|purl\.org|creativecommons\.org|matplotlib\.org)", page)
    assert (run / "curves.png").read_bytes().startswith(PNG)


def test_large_films_are_linked_and_what_is_no_film_has_no_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = a_run(tmp_path)
    (run / "worst.mp4").write_bytes(b"no film at all")
    monkeypatch.setattr("agents.run_page.INSIDE_BYTES", 3)
    page = page_of(run)
    assert '<video controls preload="none" src="worst.mp4">' in page
    assert "The worst episode of an evaluation whose results are no longer beside it." in page and "poster" not in page


def test_films_beyond_the_most_are_counted_and_those_of_the_evaluation_come_first(tmp_path: Path):
    run = a_run(tmp_path)
    (run / "evaluation").mkdir()
    names = ["evaluation/best.mp4", "evaluation/worst.mp4", *(f"watch-{i}.mp4" for i in range(6))]
    for name in names[:6]:
        (run / name).write_bytes(b"no film at all")
    assert "more films" not in page_of(run)
    for name in names[6:]:
        (run / name).write_bytes(b"no film at all")
    page = page_of(run)
    captions = re.findall(r"The (best|worst) episode|An (episode) of the policy", page)
    assert [first or second for first, second in captions] == ["best", "worst", *4 * ["episode"]]
    assert "2 more films are in the folder." in page


@pytest.mark.slow
def test_a_film_is_captioned_with_the_episode_of_the_evaluation_beside_it(tmp_path: Path):
    """The run's table may be of another evaluation."""
    run = a_run(tmp_path)
    folder = run / "evaluation"
    folder.mkdir()
    for name in ("best", "median"):
        (folder / f"{name}.mp4").write_bytes(b"no film at all")
    write_json(folder / "summary.json", {"films": {"best": {"seed": 77, "return": 12.346, "file": "best.mp4"}}})
    page = page_of(run)
    assert "The best episode of an evaluation: seed 77, return 12.35." in page
    assert "The median episode of an evaluation whose results are no longer beside it." in page
    write_json(folder / "summary.json", {"films": {"best": ["<b>"], "median": {"return": "much"}}})
    assert page_of(run).count("whose results are no longer beside it") == 2


def test_names_of_strangers_are_text(tmp_path: Path):
    run = a_run(tmp_path, env_id="<script>alert(1)</script>")
    (run / "a'\"><b>.mp4").write_bytes(b"x")
    page = page_of(run)
    assert "<script" not in page and "&lt;script&gt;" in page and "<b>" not in page


def test_settings_have_the_names_of_the_options(tmp_path: Path):
    """The config keeps older ones of two of them."""
    page = page_of(a_run(tmp_path, envs=6, partner="heuristic"))
    assert re.search(r"<td>num_envs</td>\s*<td>6</td>", page) and re.search(
        r"<td>driver</td>\s*<td>heuristic</td>", page
    )
    assert "partner" not in page


def test_a_name_with_dollars_is_no_formula(tmp_path: Path):
    """Matplotlib's formulas are a language of their own, which raises at what it does not know."""
    figure, axes = drawn([{"steps": 1, "return": 2.0}], {r"runs/$\old$": 1.0})
    picture, _ = files_of(figure, axes)
    assert "\\old" in picture


def test_a_film_that_is_being_written_is_not_shown(tmp_path: Path):
    run = a_run(tmp_path)
    (run / ".video.mp4.12ab34cd.partial.mp4").write_bytes(b"half a film")
    assert "partial" not in page_of(run)


def test_a_run_that_goes_on_is_shown_as_far_as_it_is(tmp_path: Path):
    run = a_run(tmp_path)
    for name in ("summary.json", "curve.json"):
        (run / name).unlink()
    page = page_of(run)
    assert "Not evaluated yet" in page and "<svg" not in page and not (run / "curves.png").exists()


def a_measurement(tmp_path: Path) -> Path:
    """Returns the folder of an accuracy.json with one result."""
    line = {"name": "dG-VAE", "num_samples": 6, "ade_m": 0.5, "fde_m": 1.0, "min_ade_m": 0.25, "agents": 1234}
    write_json(tmp_path / "accuracy" / "accuracy.json", {"results": [{
        "env_id": "merge-v1", "driver": "varied", "model": line, "model_samples": line, "constant_velocity": line,
    }]})  # fmt: skip
    return tmp_path / "accuracy"


@pytest.mark.slow
def test_accuracy_is_shown_with_the_worst_forecasts(tmp_path: Path):
    run, measured = a_run(tmp_path), a_measurement(tmp_path)
    (measured / "merge-v1.merge.worst.png").write_bytes(PNG + b"rest")
    (measured / "other.png").write_bytes(PNG)
    page = page_of(run, accuracy=(measured,))
    assert page_of(run, accuracy=(measured, measured / ".." / "accuracy")) == page, "each folder once"
    assert "merge-v1, driven varied:" in page and page.count("The worst forecasts, at most one per episode") == 2
    assert "<td>dG-VAE</td><td>6</td><td>0.5</td><td>1</td><td>0.25</td><td>–</td><td>–</td><td>1,234</td>" in page
    assert page.count("data:image/png") == 1
    (measured / "merge-v1.merge.worst.png").write_bytes(b"GIF")
    with pytest.raises(UserError, match=r"worst\.png is no PNG picture; remove it or make it anew"):
        page_of(run, accuracy=(measured,))


def test_what_is_not_shown_is_counted(tmp_path: Path):
    run, measured = a_run(tmp_path), a_measurement(tmp_path)
    for number in range(20):
        (measured / f"a{number:02}.png").write_bytes(PNG)
    for number in range(14):
        (measured / f"id-{number:02}.worst.png").write_bytes(PNG)
    page = page_of(run, accuracy=(measured,))
    assert page.count("data:image/png") == 12 and "2 more pictures are in the folder." in page


BEGUN = {"env_id": "x", "first_seed": 0, "has_ego": True}
"""Beginning of a summary."""
PLAYED = {"p": [{"seed": 0, "episode_return": 1.0, "length": 3, "crashed": False, "mean_speed_mps": 20.0}]}
"""Episodes of a summary."""


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("summary.json", BEGUN, "key 'episodes' is missing"),
        ("summary.json", {**BEGUN, "episodes": {}}, "has no episodes"),
        ("summary.json", {**BEGUN, "episodes": {"p": []}}, "episodes.p has no episode"),
        ("summary.json", {**BEGUN, "env_id": 3, "episodes": {"p": [{"seed": 1}]}}, "key 'episode_return' is"),
        ("curve.json", [{"steps": 3}], "key 'return' is missing"),
        ("curve.json", [{"steps": 3, "return": -1e308}], "return must be at most 1e+30 in size, got -1e+308"),
        ("summary.json", {**BEGUN, "episodes": PLAYED, "env_kwargs": "[1]"},
         "summary.json: env_kwargs: env_kwargs must be a JSON object, got '[1]'"),
        ("config.json", {"config": {**RUN, "env_kwargs": "{"}}, "config.json: env_kwargs: env_kwargs must be a JSON"),
        ("config.json", {"config": {**RUN, "env_kwargs": 3}}, "config.json: env_kwargs: env_kwargs must be a text"),
        ("config.json", {"config": RUN, "provenance": {}}, "config.json: provenance must be an array, got {}"),
        ("config.json", {"config": {"steps": 3}}, "is the config of neither train_policy.py nor predictor.train"),
        ("config.json", {"config": RUN, "provenance": [3]}, "provenance must be a JSON object, got 3"),
    ],
)  # fmt: skip
def test_a_damaged_run_is_one_sentence(tmp_path: Path, name: str, content: Any, sentence: str):
    run = a_run(tmp_path)
    (run / name).write_text(json.dumps(content))
    with pytest.raises(UserError, match=re.escape(sentence)):
        page_of(run)
    assert not (run / "report.html").exists()


def test_too_many_episodes_are_refused_before_they_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = a_run(tmp_path)
    monkeypatch.setattr("agents.results.MOST_EPISODES", 6)
    with pytest.raises(UserError, match="a policy may have at most 6 episodes, got 7"):
        page_of(run)


def test_the_command_names_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    run = a_run(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", str(run)])
    run_entry_point(main)
    assert capsys.readouterr().out == f"report: {run / 'report.html'}\n"


def test_an_evaluation_is_read_as_it_was_written(tmp_path: Path):
    made = evaluation()
    made.results["ppo (forecast)"][2] = EpisodeResult(102, 3.0, 4, None, float("nan"), {"a": 1.0}, {"b": 0})
    made.write(tmp_path)
    found = read_evaluation(tmp_path / "summary.json")
    assert found.markdown() == made.markdown()
    assert [str(asdict(e)) for e in found.results["slower"]] == [str(asdict(e)) for e in made.results["slower"]]
