"""The suite: lines are trained and measured once, failures say why, and the table says what was run."""

import json
import math
import multiprocessing
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from predictor import suite
from predictor.baselines.majority import MajorityGraph
from predictor.data import nri
from predictor.data.nri import NRIConfig, make_nri
from predictor.data.springs import SpringsConfig, make
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.data.windows import Windows
from predictor.evaluation import measure_line as measuring
from predictor.evaluation import paper_tables as tables
from predictor.evaluation.measure_line import _Features, protocol_indices
from predictor.evaluation.outcomes import Outcome
from predictor.evaluation.paper_tables import NUM_SAMPLES, Line
from predictor.models import configure
from predictor.reports.suite_tables import latex_table, markdown_report
from predictor.suite import TABLES, SuiteConfig, jobs_of, line_config, line_folder, run_line, run_suite
from predictor.support import jobs
from predictor.support.errors import UserError
from tests.predictor.helpers import spec


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    make(SpringsConfig(folder / "springs", train=20, val=6, test=12, ood=12))
    return folder


def config(data: Path, out: Path, **changes: Any) -> SuiteConfig:
    """Two steps of training, with one thread in each process."""
    return SuiteConfig("springs", data, out, "smoke", **({"steps": 2, "workers": os.cpu_count()} | changes))


def line(key: str) -> Line:
    return next(r for r in TABLES["springs"].lines if r.key == key)


def few_validations(monkeypatch: pytest.MonkeyPatch, table: str) -> None:
    """Models are selected by a few windows; not for lines that run in processes of their own."""
    budgets = TABLES[table].budgets
    monkeypatch.setitem(budgets, "smoke", replace(budgets["smoke"], val_windows=10))


# --- Lines --------------------------------------------------------------------------------------------------------


def test_least_squares_is_the_limit(data: Path, tmp_path: Path):
    """Known law, unknown constants: everything is recovered, in and out of distribution."""
    result = run_line(config(data, tmp_path), line("least-squares"))
    for kind in ("test", "ood"):
        measured = result["tests"][kind]
        assert measured["horizon_only"]["min_ade_m"] < 1e-3
        assert measured["graph"]["accuracy"] == 1.0
        assert measured["features"]["direct_r2"] > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("key", ["dgvae-rl", "dvae", "dnri", "lstm-joint"])
def test_every_kind_of_line_is_trained_and_measured(
    data: Path, tmp_path: Path, key: str, monkeypatch: pytest.MonkeyPatch
):
    few_validations(monkeypatch, "springs")
    result = run_line(config(data, tmp_path), line(key))
    measured = result["tests"]["test"]
    assert result["parameters"] > 0
    assert measured["windows"] == 12
    horizon, whole = measured["horizon_only"], measured["whole_sequence"]
    assert len(horizon["by_step_m"]) == 10 and len(whole["by_step_m"]) == 49
    assert whole["by_step_m"][-1] == pytest.approx(horizon["by_step_m"][-1], rel=0.3)  # best by another mean
    assert set(horizon["statistics"]) >= {"min_ade_m", "min_fde_m", "overall_rmse_m"}
    assert (measured["features"] is None) == (key != "dgvae-rl")
    saved = json.loads((line_folder(config(data, tmp_path), line(key)) / "result.json").read_text())
    assert saved["tests"]["test"]["horizon_only"]["min_ade_m"] == horizon["min_ade_m"]


def test_least_squares_runs_on_the_cpu_whatever_the_device(data: Path, monkeypatch: pytest.MonkeyPatch):
    devices = []
    monkeypatch.setattr(measuring, "_measure_store", lambda made, *_: devices.append(made.device))
    for key in ("least-squares", "constant-velocity-noise"):
        suite.measure_line(TABLES["springs"], line(key), data, TABLES["springs"].budgets["smoke"], None, 0, "cuda")
    assert devices == ["cpu", "cpu", "cuda", "cuda"]


@pytest.fixture
def without_sklearn(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "sklearn"]:
        monkeypatch.setitem(sys.modules, name, None)


def test_a_line_whose_features_are_not_scored_needs_no_scikit_learn(without_sklearn: None, data: Path, tmp_path: Path):
    assert run_line(config(data, tmp_path), line("constant-velocity"))["tests"]["test"]["features"] is None


def test_a_line_on_labelled_data_needs_scikit_learn_before_it_is_trained(
    without_sklearn: None, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(suite, "train", lambda _: pytest.fail("trained"))
    with pytest.raises(UserError, match=r"need scikit-learn: pip install 'dgvae-rl\[scores\]'"):
        run_line(config(data, tmp_path), line("dgvae-rl"))


def test_all_lines_of_a_table_share_data_steps_and_protocol(data: Path, tmp_path: Path):
    trained = [r for r in TABLES["springs"].lines if r.is_trained]
    configs = [line_config(config(data, tmp_path), r, tmp_path / r.key) for r in trained]
    shared = ("data", "val_data", "steps", "batch_size", "max_episodes", "history_steps", "horizon_steps", "lr", "seed")
    for name in shared:
        assert len({getattr(c, name) for c in configs}) == 1, name


@pytest.mark.parametrize(("threads", "workers", "of_each"), [(4, 1, 4), (4, 2, 2), (1, 1, 1), (1, 4, 1)])
def test_processes_share_the_threads_that_torch_has(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int, workers: int, of_each: int
):
    """So OMP_NUM_THREADS=1 leaves cores to other work; two commands of all cores each would wait for each other."""
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    made = line_config(config(data, tmp_path, workers=workers), line("plural"), tmp_path)
    assert made.threads == of_each


# --- Tables beside NRI's ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def nri_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nri")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nri, "SUBSTEPS", 8)  # of 100: in seconds
        make_nri(NRIConfig(folder / "nri-springs", train=24, val=6, test=8, test_frames=70))
        make_nri(NRIConfig(folder / "nri-charged", "charged", train=12, val=6, test=4, test_frames=69))
    return folder


def nri_line(table: str, key: str) -> Line:
    return next(r for r in TABLES[table].lines if r.key == key)


def test_graphs_of_nris_rollouts_are_read_once_after_49_frames(nri_data: Path, tmp_path: Path):
    """Rollouts of 70 frames have two windows of 49 + 20 frames; NRI's encoder sees the first 49."""
    settings = SuiteConfig("nri-springs", nri_data, tmp_path, "smoke")
    measured = run_line(settings, nri_line("nri-springs", "least-squares"))["tests"]["test"]
    assert measured["windows"] == 8 and measured["graph"]["pairs"] == 8 * 20
    assert len(measured["horizon_only"]["by_step_m"]) == 20
    assert measured["graph"]["accuracy"] == 1.0
    assert measured["horizon_only"]["min_ade_m"] < 1e-4


@pytest.mark.parametrize("table", ["nri-springs", "nri-charged"])
def test_the_majority_class_is_right_for_its_share(nri_data: Path, tmp_path: Path, table: Any):
    settings = SuiteConfig(table, nri_data, tmp_path, "smoke")
    graph = run_line(settings, nri_line(table, "majority"))["tests"]["test"]["graph"]
    shares = np.array(graph["confusion"]).sum(1) / graph["pairs"]
    assert graph["accuracy"] == pytest.approx(shares.max())  # with the best permutation
    assert shares[0] == 0 if table == "nri-charged" else 0.3 < shares[0] < 0.7


def test_types_without_labels_are_renamed_and_types_with_labels_are_not(
    nri_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A majority forecaster of type 0, which charges never have, is right by another name only."""
    table, settings = TABLES["nri-charged"], SuiteConfig("nri-charged", nri_data, tmp_path, "smoke")
    empty = MajorityGraph(spec(has_ego=False, dt_s=0.1), 20, 0, 2)  # one type fewer than the labels
    monkeypatch.setattr(MajorityGraph, "fit", lambda *_: empty)
    free = nri_line("nri-charged", "majority")
    labelled = replace(free, train={"type_label_weight": 1.0})
    found = [suite.measure_line(table, r, nri_data, settings.sizes, None, 0, "cpu") for r in (free, labelled)]
    renamed, kept = (r["tests"]["test"]["graph"] for r in found)
    assert renamed["accuracy"] >= 0.4 and renamed["permutation"][0] != 0
    assert kept["accuracy"] == 0 and list(kept["permutation"]) == [0, 1, 2]


@pytest.mark.slow
def test_a_model_is_trained_within_49_frames_and_measured_beside_nris_figures(
    nri_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    few_validations(monkeypatch, "nri-springs")
    in_this_process(monkeypatch)
    settings = SuiteConfig(
        "nri-springs", nri_data, tmp_path, "smoke", ("dvae", "majority"), steps=2, workers=os.cpu_count() or 1
    )
    made = line_config(settings, nri_line("nri-springs", "dvae"), tmp_path)
    assert made.history_steps + made.horizon_steps == 49 and made.val_history_steps == 39
    content = run_suite(settings)
    assert not content["failed"]
    text = markdown_report(content)
    assert "Errors on the 20 future steps after a burn-in of 49" in text
    (published,) = [line for line in text.splitlines() if line.startswith("| NRI (learned) (published) |")]
    assert published.split("|")[2:4] == [" – ", " 0.999 "]
    ours = [line for line in text.splitlines() if line.startswith("| dVAE+ (types alone) |")]
    assert len(ours) == 3 and float(ours[2].split("|")[3]) >= 0.4  # two views, then the graph


# --- Caching ------------------------------------------------------------------------------------------------------


def test_a_line_has_a_folder_of_its_own_for_each_config_and_data(data: Path, tmp_path: Path):
    base = config(data, tmp_path)
    folders = {
        line_folder(base, line("dgvae")),
        line_folder(base, line("dnri")),
        line_folder(replace(base, steps=3), line("dgvae")),
        line_folder(replace(base, seed=1), line("dgvae")),
        line_folder(base, replace(line("dgvae"), set=("edge_feature_dim=4",))),
    }
    assert len(folders) == 5
    assert line_folder(replace(base, workers=2), line("dgvae")) in folders  # nothing that changes no number


def test_lines_keep_their_folders_when_training_gets_options_or_other_defaults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Names of before `--causal-edges` existed; a new option goes into `ADDED` with the value that changes nothing."""
    monkeypatch.setattr(suite, "content_id", lambda path: path.name)
    settings = SuiteConfig("sdd", tmp_path, tmp_path)
    expected = {
        "nearest-neighbours": "c7c43f95ad", "dnri": "b5b3fb1167", "dgvae-paper": "2edad84780", "plural": "c064e2d1ed",
    }  # fmt: skip
    for each in TABLES["sdd"].lines:
        if each.key in expected:
            assert line_folder(settings, each).name == f"{each.key}-{expected.pop(each.key)}"
    assert not expected


def test_results_in_which_the_ball_was_a_player_are_measured_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(suite, "content_id", lambda path: path.name)
    settings, (first, *_) = SuiteConfig("nba", tmp_path, tmp_path), TABLES["nba"].lines
    of_players = line_folder(settings, first)
    monkeypatch.setitem(TABLES, "nba", replace(TABLES["nba"], overlap_of="agents"))
    assert line_folder(settings, first) != of_players


@pytest.mark.parametrize("option", ["causal_edges", "reaction_weight"])
def test_an_added_option_that_is_used_gives_another_folder(data: Path, tmp_path: Path, option: str):
    """Both stand together: a weight of reactions needs causal edges."""
    used = {"causal_edges": True} | ({"reaction_weight": 2.0} if option == "reaction_weight" else {})
    base, plain = config(data, tmp_path), line("dgvae")
    more = replace(plain, train=plain.train | used)
    less = replace(plain, train=plain.train | {k: v for k, v in used.items() if k != option})
    assert line_folder(base, more) != line_folder(base, less)


def headlines_of(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Returns the list in which the figures that are drawn from now on leave their headlines."""
    drawn, draw = [], suite.figure_by_step

    def remember(results: Sequence[dict[str, Any]], kinds: Sequence[str], dt_s: float, headline: str) -> Figure:
        drawn.append(headline)
        return draw(results, kinds, dt_s, headline)

    monkeypatch.setattr(suite, "figure_by_step", remember)
    return drawn


def test_the_line_with_a_dearer_edge_differs_in_its_price_alone():
    usual, dear = line("dgvae"), line("dgvae-sparse")
    assert dear.set == usual.set and dear.train == usual.train | {"edge_cost": 20.0} != usual.train


@pytest.mark.slow
def test_suite_runs_what_is_missing_and_nothing_else(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Only the line that is trained is started, in a process of its own."""
    drawn = headlines_of(monkeypatch)
    settings = config(data, tmp_path, lines=("constant-velocity", "mlp"), workers=2)
    before = run_line(settings, line("constant-velocity"))
    content = run_suite(settings)
    assert [r["key"] for r in content["rows"]] == ["constant-velocity", "mlp"]
    assert content["rows"][0]["train_seconds"] == before["train_seconds"]
    assert not content["failed"]
    for name in ("table.md", "table.tex", "table.json", "by_step.png"):
        assert (settings.folder / name).exists()
    assert ", one seed;" in drawn[0]
    monkeypatch.setattr(jobs, "_started", lambda *_: pytest.fail("a finished line was started again"))
    again = run_suite(settings)
    assert again["rows"] == content["rows"]


def test_what_was_not_measured_is_null_in_the_table(data: Path, tmp_path: Path):
    """JSON has no NaN; most readers of other languages refuse it."""
    settings = config(data, tmp_path, lines=("constant-velocity",))
    run_line(settings, line("constant-velocity"))
    file = line_folder(settings, line("constant-velocity")) / "result.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"unmeasured_m": math.nan}))
    run_suite(settings)
    text = (settings.folder / "table.json").read_text()
    assert json.loads(text)["rows"][0]["unmeasured_m"] is None and "NaN" not in text


@pytest.mark.slow
def test_a_line_that_fails_says_why_and_leaves_the_others(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    broken = config(data, tmp_path, lines=("constant-velocity", "mlp"), workers=2)
    folder = line_folder(broken, line("mlp")) / "run"
    folder.mkdir(parents=True)
    (folder / "unknown.txt").write_text("not a run")
    content = run_suite(broken)
    assert [r["key"] for r in content["rows"]] == ["constant-velocity"]
    assert "not empty and not a training run" in content["failed"]["mlp, seed 0"]
    assert "Failed lines: mlp, seed 0" in (broken.folder / "table.md").read_text()


def test_seeds_are_jobs_of_their_own_and_trained_lines_alone_have_several(data: Path, tmp_path: Path):
    several = config(data, tmp_path, lines=("constant-velocity", "mlp", "dgvae-gaussian"), seed=5, seeds=3)
    jobs = jobs_of(several)
    assert [(j.line.key, j.config.seed) for j in jobs] == [
        ("constant-velocity", 5), *(("mlp", s) for s in (5, 6, 7)), *(("dgvae-gaussian", s) for s in (5, 6, 7))
    ]  # fmt: skip
    assert len({j.folder for j in jobs}) == 7
    alone = jobs_of(config(data, tmp_path, lines=("mlp",), seed=6))
    assert [j.folder for j in alone] == [jobs[2].folder]  # the same result, however it is asked for


@pytest.mark.slow
def test_several_seeds_are_shown_by_mean_and_range_and_resumed(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    few_validations(monkeypatch, "springs")
    in_this_process(monkeypatch)
    settings = config(data, tmp_path, lines=("constant-velocity", "mlp"), seeds=2)
    for job in jobs_of(settings)[:2]:
        run_line(job.config, job.line)
    started, drawn = in_this_process(monkeypatch), headlines_of(monkeypatch)
    content = run_suite(settings)
    assert started == ["mlp, seed 1"] and ", mean over 2 seeds;" in drawn[0]
    straight, mlp = content["rows"]
    assert (straight["seeds"], mlp["seeds"]) == ([0], [0, 1])
    errors = [r["tests"]["test"]["horizon_only"]["ade_m"] for r in mlp["runs"]]
    assert errors[0] != errors[1]
    assert mlp["tests"]["test"]["horizon_only"]["ade_m"] == pytest.approx(np.mean(errors))
    shown = next(line for line in markdown_report(content).splitlines() if line.startswith("| Linear (MLP)"))
    assert f"{np.mean(errors):.3f} ({min(errors):.3f} to {max(errors):.3f})" in shown
    windows = {tuple(r["tests"]["test"][key] for key in ("windows",)) for r in mlp["runs"]}
    assert windows == {(12,)}


@pytest.mark.slow
def test_a_single_forecast_with_noise_is_measured_after_its_model_and_of_the_same_weights(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    few_validations(monkeypatch, "springs")
    started = in_this_process(monkeypatch)
    content = run_suite(config(data, tmp_path, lines=("dgvae-gaussian", "dgvae"), workers=2))
    assert started == ["dgvae, seed 0", "dgvae-gaussian, seed 0"] and not content["failed"]
    model, control = content["rows"]
    for view in ("horizon_only", "whole_sequence"):
        ours, noisy = (r["tests"]["test"][view] for r in (model, control))
        assert ours["ade_m"] == pytest.approx(noisy["ade_m"], rel=1e-5)
        assert ours["min_ade_m"] != noisy["min_ade_m"]
    assert control["parameters"] == model["parameters"]
    assert control["tests"]["test"]["graph"] is None and model["tests"]["test"]["graph"] is not None
    runs = list((tmp_path / "springs-smoke" / "rows").glob("*/run"))
    assert len(runs) == 1  # one training


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Lets the suite run its jobs here instead of in processes of their own; returns their names in order."""
    started: list[str] = []

    def start(job: Any, folder: Path, imports: Any) -> Any:
        started.append(job.name)
        folder.mkdir(parents=True, exist_ok=True)
        run_line(job.config, job.line)
        sentinel, other_end = multiprocessing.Pipe(duplex=False)
        other_end.close()  # as of a process that ended
        return SimpleNamespace(exitcode=0, sentinel=sentinel)

    monkeypatch.setattr(jobs, "_started", start)
    return started


# --- Tables -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_reports_have_a_line_for_each_model_and_the_papers_figures(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    in_this_process(monkeypatch)
    settings = config(data, tmp_path, lines=("constant-velocity", "least-squares"), workers=2)
    content = run_suite(settings)
    content["paper"] = {"least-squares": {"rmse": 0.125, "ade": 0.25, "fde": 0.5}}
    text, latex = markdown_report(content), latex_table(content)
    assert text.count("| least squares (limit) + Gaussian |") == 4  # test, ood, whole sequence, graph
    assert "0.250 / 0.500 / 0.125" in text
    assert latex.count(r"\begin{tabular}") == 4 and latex.count(r"\\") == 4 + 3 * 2 + 1


@pytest.mark.slow
def test_every_line_has_k_samples_and_says_so(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Constant velocity gets them from a Gaussian: its single forecast is the same, its best of 20 is better."""
    in_this_process(monkeypatch)
    content = run_suite(config(data, tmp_path, lines=("constant-velocity", "constant-velocity-noise"), workers=2))
    drawn, noisy = (r["tests"]["test"]["horizon_only"] for r in content["rows"])
    assert drawn["num_samples"] == noisy["num_samples"] == NUM_SAMPLES
    assert drawn["ade_m"] == pytest.approx(noisy["ade_m"]) and drawn["fde_m"] == pytest.approx(noisy["fde_m"])
    for accuracy in (drawn, noisy):
        assert accuracy["min_ade_m"] < 0.8 * accuracy["ade_m"]
        for figure in ("coverage", "mixture_coverage"):
            assert 0.7 < accuracy["statistics"][figure]["mean"] <= 1
        assert accuracy["statistics"]["mixture_nll"]["mean"] == pytest.approx(np.mean(accuracy["mixture_nll"]), abs=0.1)
    lines = markdown_report(content).splitlines()
    for name in ("constant velocity + Gaussian", "constant velocity + noise"):
        found = [line.split("|")[2].strip() for line in lines if line.startswith(f"| {name} |")]
        assert len(found) == 3 and set(found) == {"20"}
    assert "σ = " in markdown_report(content) and len(content["rows"][0]["fitted"]["covariance_m2"]) == 20


@pytest.mark.parametrize("name", list(TABLES))
def test_every_table_has_the_controls_the_papers_model_and_modes(name: str):
    table = TABLES[name]
    lines = {r.key: r for r in table.lines}
    assert {"constant-velocity", "constant-velocity-noise", "nearest-neighbours"} <= set(lines)
    assert not any(lines[key].is_trained for key in ("constant-velocity-noise", "nearest-neighbours"))
    assert any(each.residual_of for each in table.lines)
    for each in table.lines:
        if each.residual_of:
            source = lines[each.residual_of]
            assert (each.set, each.train, each.model) == (source.set, source.train, source.model)
            assert not source.residual_of and each.name == f"{source.name}, single forecast + Gaussian"
        elif each.draws_residuals:
            assert each.name.endswith(" + Gaussian")
        else:
            assert "Gaussian" not in each.name.replace("teacher-forced, Gaussian", "").replace("… Gaussian", "")
    if not name.startswith(("recipe", "modes")):
        papers = lines["dgvae-paper"]
        assert papers.name == "dG-VAE (paper)" and papers.train == tables.TEACHER_FORCED
        assert [s.split("=")[0] for s in papers.set if not s.startswith("num_edge_types")] == ["edge_feature_dim"]
        assert {"num_modes=20", "rollout_graph=frozen"} <= set(lines["plural"].set)


@pytest.mark.parametrize("name", list(TABLES))
@pytest.mark.parametrize("budget", ["smoke", "cpu", "paper"])
def test_every_line_of_every_table_is_a_valid_config(name: Any, budget: Any, tmp_path: Path):
    settings = SuiteConfig(name, tmp_path, tmp_path, budget)
    keys = [r.key for r in TABLES[name].lines]
    assert len(set(keys)) == len(keys)
    for each in TABLES[name].lines:
        if each.is_trained:
            made = line_config(settings, each, tmp_path)
            configure(made.model, made.preset, made.set)


def test_windows_end_their_burn_in_at_every_stride():
    episodes = [Episode(np.zeros((n, 1, 4), np.float32), np.ones((n, 1), np.bool_), np.arange(1)) for n in (70, 55)]
    windows = Windows(episodes, spec(has_ego=False), 40, 10, min_future_steps=10, min_history_steps=40)
    ends = windows.index[protocol_indices(windows, 5, 0, 0)].tolist()
    assert ends == [[0, 39], [0, 44], [0, 49], [0, 54], [0, 59], [1, 39], [1, 44]]
    limited = protocol_indices(windows, 5, 3, 0)
    assert len(limited) == 3 and sorted(limited.tolist()) == limited.tolist()


# --- Bad input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"lines": ("dgvea",)},
            "table 'springs' has no line 'dgvea'; there are constant-velocity, constant-velocity-noise",
        ),
        ({"steps": -1}, "steps must not be negative, got -1"),
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"device": "cuda:7"}, "device 'cuda:7' was asked for but torch finds no CUDA device"),
    ],
)
def test_suite_refuses(data: Path, tmp_path: Path, changes: Mapping[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        config(data, tmp_path, **changes)


def test_a_missing_store_is_named_with_the_command_that_makes_it(tmp_path: Path):
    with pytest.raises(UserError, match=r"no store at .*springs/train; make the stores .* predictor\.data\.springs"):
        run_suite(SuiteConfig("springs", tmp_path))


def test_test_stores_too_short_for_the_protocol_are_refused(data: Path, tmp_path: Path):
    short = Episode(np.zeros((12, 2, 4), np.float32), np.ones((12, 2), np.bool_), np.arange(2))
    write_store(tmp_path / "short", StoreInfo(spec(has_ego=False), "short"), [short])
    long = Episode(np.zeros((70, 2, 4), np.float32), np.ones((70, 2), np.bool_), np.arange(2))
    write_store(tmp_path / "long", StoreInfo(spec(has_ego=False), "long"), [long])
    table = replace(tables.SPRINGS, train="long", tests={"test": "short"})
    with pytest.raises(UserError, match="test store of 'short' fits no window of the protocol"):
        suite.measure_line(table, line("constant-velocity"), tmp_path, table.budgets["smoke"], None, 0, "cpu")


def test_features_of_an_episode_are_in_one_half_of_the_regression():
    """An episode's own mark tells its attribute; windows of one episode in both halves would make it of use."""
    episodes = np.repeat(np.arange(12), 4)
    marks = torch.eye(12)[episodes][:, None, None].expand(-1, 2, 2, -1)
    truth = torch.randn(12, generator=torch.Generator().manual_seed(0))[episodes][:, None, None, None].expand(
        -1, 2, 2, -1
    )
    still = torch.zeros(48, 1, 2, 1, 2)
    outcome = Outcome(
        still, still[:, 0], torch.ones(48, 2, 1, dtype=torch.bool), edge_features=marks,
        present=torch.ones(48, 2, dtype=torch.bool), edge_attributes=truth,
    )  # fmt: skip
    found = []
    for groups in (episodes, np.arange(48)):
        features = _Features(groups)
        features.add(outcome)
        scores = features.scores()
        assert scores is not None
        found.append(scores["linear_r2"])
    assert found[0] < 0.1 and found[1] > 0.5
