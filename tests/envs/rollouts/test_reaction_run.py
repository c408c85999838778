from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.rollouts import reaction_run, reactions
from envs.rollouts.branches import check_can_branch
from envs.rollouts.reaction_cells import BYSTANDER_CELL, ELSEWHERE, LEADER_CELL, NEAR_CELL, ON_LANES, STILL_CELL
from envs.rollouts.reaction_run import EnvReactions, ReactionRun, measure_reactions
from envs.rollouts.reactions import STRAIGHT, Perturbation, ReactionTask
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, forget, no_processes, save_tag
from tests.envs.helpers import HIGHWAY_SPEC, save_tiny

STILL = "constant-velocity"
HORIZON = 3


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    no_processes(monkeypatch)
    forget()
    yield
    forget()


def run(env_id: str = TAG, *checkpoints: str, **changes: Any) -> ReactionRun:
    settings: dict[str, Any] = {"perturbations": 3, "episodes": 4, "workers": 1, "max_steps": 10, "horizon_steps": 2}
    settings |= changes
    driver = "heuristic" if env_id == TAG else "idle"
    return ReactionRun(env_id=env_id, driver=driver, checkpoints=checkpoints or (STILL,), seed=900_000, **settings)


def given(monkeypatch: pytest.MonkeyPatch, *cells: str) -> list[ReactionTask]:
    """Lets episodes have these perturbations, the true shift of episode i being i + 1; returns the tasks asked for."""
    asked: list[ReactionTask] = []

    def play(task: ReactionTask) -> list[Perturbation]:
        asked.append(task)
        number = task.seed - 900_000
        true_m = np.full((HORIZON, 2), [number + 1.0, 0.0])
        ones = [Perturbation(cell, task.seed, 4, 1, 0, true_m, {"half": true_m / 2}) for cell in cells]
        return [one for one in ones if one.cell in task.cells]

    monkeypatch.setattr(reaction_run, "play_reactions", play)
    return asked


def test_the_first_perturbations_of_each_cell_count(monkeypatch: pytest.MonkeyPatch):
    asked = given(monkeypatch, NEAR_CELL.name, NEAR_CELL.name, STILL_CELL.name)
    found = measure_reactions(run(perturbations=3, episodes=9))
    near, still, gone = found.cells
    assert [cell.name for cell in found.cells] == [cell.name for cell in ELSEWHERE]
    assert [cell.pairs for cell in found.cells] == [3, 3, 0]
    assert near.reactions["half"].true_m == pytest.approx((1 + 1 + 2) / 3)
    assert near.reactions["half"].slope is not None and near.reactions["half"].slope.value == pytest.approx(0.5)
    assert still.reactions["half"].true_m == pytest.approx(2.0)
    assert still.reactions["half"].slope is None and gone.reactions == {}
    assert still.false_reactions["half"] is not None
    assert still.false_reactions["half"].value == pytest.approx(2.0 / (4 / 3))
    assert near.false_reactions == {}
    assert (found.asked, found.episodes) == (3, 9)  # one kind was not found at all
    assert [one.seed - 900_000 for one in found.perturbations] == [0, 0, 1, 0, 1, 2]
    wanted = {task.seed - 900_000: set(task.cells) for task in asked}
    assert wanted[0] == {cell.name for cell in ELSEWHERE}
    assert wanted[8] == {gone.name}


def test_crashes_do_not_count_and_swerves_have_no_place_in_one_slope(monkeypatch: pytest.MonkeyPatch):
    """Of each episode the first perturbation is a crash, the second a swerve, which is forecast well."""

    def play(task: ReactionTask) -> list[Perturbation]:
        true_m = np.full((HORIZON, 2), [2.0, 0.0])
        crash = Perturbation(NEAR_CELL.name, task.seed, 4, 1, 0, 50 * true_m, {"f": true_m}, True, False)
        swerve = Perturbation(NEAR_CELL.name, task.seed, 5, 1, 0, true_m, {"f": true_m}, False, True)
        keep = Perturbation(NEAR_CELL.name, task.seed, 6, 1, 0, true_m, {"f": 0 * true_m}, False, False)
        return [crash, swerve, keep]

    monkeypatch.setattr(reaction_run, "play_reactions", play)
    found = measure_reactions(run(perturbations=4, episodes=9)).cells[0]
    assert (found.pairs, found.crashed) == (4, 2)
    assert found.reactions["f"].true_m == pytest.approx(2.0)
    assert found.reactions["f"].slope is not None and found.reactions["f"].slope.value == pytest.approx(0.5)
    assert found.on_path["f"].slope is not None and found.on_path["f"].slope.value == 0.0
    assert (found.on_path["f"].pairs, found.on_path["f"].episodes) == (2, 2)


def test_false_reactions_are_beside_those_that_do_not_crash(monkeypatch: pytest.MonkeyPatch):
    def play(task: ReactionTask) -> list[Perturbation]:
        moved_m = np.full((HORIZON, 2), [2.0, 0.0])
        crash = Perturbation(NEAR_CELL.name, task.seed, 4, 1, 0, moved_m, {"f": 50 * moved_m}, True, False)
        near = Perturbation(NEAR_CELL.name, task.seed, 5, 1, 0, moved_m, {"f": moved_m}, False, False)
        still = Perturbation(STILL_CELL.name, task.seed, 6, 1, 0, 0 * moved_m, {"f": moved_m / 4}, False, False)
        return [crash, near, still]

    monkeypatch.setattr(reaction_run, "play_reactions", play)
    found = measure_reactions(run(perturbations=3, episodes=9)).cells[1].false_reactions["f"]
    assert found is not None and found.value == pytest.approx(0.25)


def test_it_ends_when_there_are_enough(monkeypatch: pytest.MonkeyPatch):
    asked = given(monkeypatch, *(cell.name for cell in ELSEWHERE))
    found = measure_reactions(run(perturbations=3, episodes=100, workers=1))
    assert found.episodes == 3 and len(asked) == 4  # two at a time


def test_bystanders_are_compared_with_followers_of_a_leader(monkeypatch: pytest.MonkeyPatch):
    given(monkeypatch, LEADER_CELL.name, BYSTANDER_CELL.name, ON_LANES[-1].name)
    cells = {cell.name: cell for cell in measure_reactions(run("two-way-v0")).cells}
    assert list(cells) == [cell.name for cell in ON_LANES]
    found = cells[BYSTANDER_CELL.name].false_reactions["half"]
    assert found is not None and found.value == pytest.approx(1.0)


def same(first: EnvReactions, second: EnvReactions) -> bool:
    plain = [replace(result, perturbations=[]) for result in (first, second)]
    both = zip(first.perturbations, second.perturbations, strict=True)
    return plain[0] == plain[1] and all(
        np.array_equal(a.true_m, b.true_m) and (a.seed, a.step, a.sender) == (b.seed, b.step, b.sender) for a, b in both
    )


@pytest.mark.slow
def test_the_number_of_workers_does_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reactions, "SHARE", 0.5)
    checkpoint = save_tag(tmp_path / "tag")
    settings = run(TAG, checkpoint, perturbations=2, max_steps=6)
    one, three = (measure_reactions(replace(settings, workers=workers)) for workers in (1, 3))
    assert same(one, three)
    assert all(cell.pairs == 2 and set(cell.reactions) == {"tag", STRAIGHT} for cell in one.cells)
    assert not same(one, replace(one, perturbations=one.perturbations[::-1]))


@pytest.mark.slow
def test_real_processes_give_what_one_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    checkpoint = save_tag(tmp_path / "tag")
    here = measure_reactions(run(TAG, checkpoint, perturbations=1))
    assert here.perturbations
    monkeypatch.undo()
    assert same(here, measure_reactions(run(TAG, checkpoint, perturbations=1, workers=2)))


def test_the_horizon_is_the_first_checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = given(monkeypatch, NEAR_CELL.name)
    measure_reactions(run(TAG, save_tag(tmp_path / "tag"), STILL, horizon_steps=None))
    assert {task.horizon_steps for task in asked} == {HORIZON}


def test_checkpoints_that_do_not_fit_are_named(
    highway_checkpoint: str, racetrack_checkpoint: str, monkeypatch: pytest.MonkeyPatch
):
    asked = given(monkeypatch, LEADER_CELL.name)
    found = measure_reactions(run("two-way-v0", racetrack_checkpoint, highway_checkpoint))
    assert list(found.misfits) == ["tiny-racetrack"] and "dt_s=0.2" in found.misfits["tiny-racetrack"]
    assert {task.checkpoints for task in asked} == {(highway_checkpoint,)}
    with pytest.raises(UserError, match="trained at dt_s=0.2 but env 'two-way-v0' steps at dt_s=1"):
        measure_reactions(run("two-way-v0", racetrack_checkpoint))
    with pytest.raises(UserError, match="no checkpoint fits two-way-v0: "):
        measure_reactions(run("two-way-v0", racetrack_checkpoint, save_tag(Path(racetrack_checkpoint).parent / "tag")))


def test_checkpoints_that_perceive_differently_are_measured_apart(highway_checkpoint: str, tmp_path: Path):
    other = save_tiny(tmp_path / "far", replace(HIGHWAY_SPEC, perception_m=90.0))
    with pytest.raises(UserError, match="must perceive alike, got '.*' 6 agents within 60 m, '.*' .* 90 m"):
        measure_reactions(run("two-way-v0", highway_checkpoint, other))


def test_what_cannot_be_perturbed_is_said():
    check_can_branch(TAG, "heuristic")
    with pytest.raises(UserError, match="cannot be perturbed; use an environment of highway-env, of this project, or"):
        check_can_branch("pursuit_v5", "random")
    pytest.importorskip("envpool")
    with pytest.raises(UserError, match="EnvPoolEnv cannot be perturbed: EnvPool's C.. simulator has no access"):
        check_can_branch("envpool/HighwayFast-v0", "idle")
