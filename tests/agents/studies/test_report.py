import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.forecast_errors import CONSTANT_ERROR, FORECAST_ERROR
from agents.studies.findings import Findings, Line
from agents.studies.pictures import learning_curves
from agents.studies.plan import Scenario, Study, StudyArm
from agents.studies.report import interval, write_headroom, write_report
from agents.studies.results import Result
from predictor.evaluation.standard_errors import Estimate
from tests.agents.studies.helpers import result

MADE = {"command": "python -m agents.study", "commit": "abc", "machine": "m", "time": "now", "versions": {"numpy": "2"}}
ZEROS, SEEN, ORACLE = Line("zeros", "ppo"), Line("forecast", "ppo"), Line("oracle", "ppo")


def found_in(study: Study, results: list[Result]) -> Findings:
    return Findings.of(study, results, resamples=100)


def study(scenarios: tuple[str, ...] = ("one",), **changes: Any) -> Study:
    arms = tuple(StudyArm(name, "none", {}) for name in ("zeros", "forecast", "oracle"))
    made = tuple(Scenario(name, "toy-v0", {}, 10, 1, ()) for name in scenarios)
    return Study("made-up", made, arms, **({"rivals": ("zeros",), "episodes": 2} | changes))


def results(scenario: str = "one", lift: float = 0.0) -> list[Result]:
    """Three runs of each arm; means of zeros, forecast, oracle are 2, 5, 10; the best constant action has 4."""
    found = [result("idle", [1.0, 3.0], scenario=scenario), result("slower", [3.0, 5.0], scenario=scenario)]
    found += [result("random", [9.0, 9.0], scenario=scenario), result("planner", [6.0, 8.0], scenario=scenario)]
    for arm, base in (("zeros", 2.0), ("forecast", 5.0 + lift), ("oracle", 10.0)):
        found += [result(arm, [base + d - 1, base + d + 1], seed, scenario) for seed, d in enumerate((-0.5, 0.0, 0.5))]
    return found


def test_runs_are_scored_by_their_means():
    findings = found_in(study(), results())
    assert findings.runs("one", SEEN).tolist() == [4.5, 5.0, 5.5]
    found = findings.mean_return("one", SEEN)
    half = 4.302652729911275 * 0.5 / np.sqrt(3)
    assert (found.value, found.interval) == (5.0, pytest.approx((5 - half, 5 + half)))
    assert findings.middle_return("one", SEEN).value == 5.0
    crashes = findings.crash_rate("one", SEEN)
    assert crashes is not None and crashes.value == 0.5, "the first of two episodes"


def test_a_crash_that_is_reported_only_when_it_happens_is_a_share_of_all_episodes():
    def runs(*crashed: bool | None) -> list[Result]:
        return [replace(r, episodes=tuple(e | {"crashed": c} for e, c in zip(r.episodes, crashed, strict=True)))
                for r in results() if r.arm == "forecast"]  # fmt: skip

    found = found_in(study(), runs(True, None)).crash_rate("one", SEEN)
    assert found is not None and found.value == 0.5
    assert found_in(study(), runs(None, None)).crash_rate("one", SEEN) is None
    crash, silent = (
        replace(r, episodes=tuple(e | {"crashed": each} for e in r.episodes), arm=arm)
        for r, arm, each in ((runs(True, None)[0], "bold", True), (runs(None, None)[0], SEEN.arm, None))
    )
    careful = found_in(study(), [crash, silent]).crash_rate("one", SEEN)
    assert careful is not None and careful.value == 0.0, "another line tells that crashes are reported"


def test_a_driver_without_a_crash_may_still_crash():
    """Wilson's interval: a bootstrap of no crashes has none."""
    safe = result("slower", [1.0] * 10)
    safe = replace(safe, episodes=tuple(e | {"crashed": False} for e in safe.episodes))
    found = found_in(study(), [safe]).crash_rate("one", Line("slower", None))
    assert found is not None and found.interval == pytest.approx((0.0, 0.2775), abs=1e-4) and found.value == 0.0


def test_a_driver_of_ones_own_is_no_constant_action():
    findings = found_in(study(), [*results(), result("own:mine:drive", [8.0, 9.0])])
    assert findings.best_constant("one") == Line("slower", None)


def test_headroom_is_shared_where_there_is_some():
    findings = found_in(study(), results())
    headroom, used = findings.headroom("one", "ppo"), findings.headroom_used("one", SEEN)
    half = 2.7764451051977987 * np.sqrt(2 * 0.25 / 3)  # Student's, four degrees of freedom
    assert (headroom.value, headroom.interval) == (8.0, pytest.approx((8 - half, 8 + half)))
    assert used is not None and used.value == pytest.approx(3 / 8) and used.interval[0] < 3 / 8 < used.interval[1]
    level = [r for r in results() if r.arm != "oracle"]
    level += [result("oracle", [2 + d, 2 - d], seed) for seed, d in enumerate((3.0, 0.0, 1.0))]
    assert found_in(study(), level).headroom_used("one", SEEN) is None, "the same mean as zeros"
    assert found_in(study(), results()[:-3]).headroom("one", "ppo") is None, "no oracle"


def test_pairs_are_those_with_the_rivals():
    (seen, oracle) = found_in(study(), results()).pairs(["one"])
    assert (seen.ours, seen.rival, oracle.ours) == (SEEN, ZEROS, ORACLE)
    assert seen.probability == Estimate(1.0, (1.0, 1.0)) and seen.gain.value == 3.0
    assert seen.gain.interval[0] == pytest.approx(3 - 2.7764451051977987 * np.sqrt(2 * 0.25 / 3))
    both = found_in(study(("one", "two")), results() + results("two", lift=2.0)).pairs(["one", "two"])[0]
    assert both.gain.value == pytest.approx(0.5) and both.gain.interval[0] > 0.3, (
        "rescaled, by a bootstrap within scenarios"
    )
    assert found_in(study(rivals=()), results()).pairs(["one"]) == []
    two = found_in(study(rivals=("zeros", "forecast")), results()).pairs(["one"])
    assert [(pair.ours, pair.rival) for pair in two] == [(SEEN, ZEROS), (ORACLE, ZEROS), (ORACLE, SEEN)]


@pytest.mark.slow
def test_references_are_told_apart():
    findings = found_in(study(), results())
    assert findings.best_constant("one") == Line("slower", None)
    assert findings.planner("one") == Line("planner", None)
    straight = result("planner:constant-velocity", [1.0, 1.0])
    assert found_in(study(), [straight, *results()]).planner("one") == Line("planner", None)
    assert found_in(study(), [straight]).planner("one") == Line("planner:constant-velocity", None)
    bold = [result(f"planner@0.3{of}", [2.0, 2.0]) for of in (":oracle", "")]
    assert found_in(study(), bold).planner("one") == Line("planner@0.3", None)
    assert found_in(study(), bold).planner("one", true_futures=True) == Line("planner@0.3:oracle", None)
    assert findings.heuristic("one") is None
    many = found_in(study(), [*results()[4:], result("heuristic", [6.0, 8.0]), result("random", [0.0, 2.0])])
    assert (many.best_constant("one"), many.planner("one")) == (None, None)
    drawn = learning_curves(many)
    assert "heuristic" in drawn and "best constant" not in drawn and "heuristic" not in learning_curves(findings)


@pytest.mark.slow
def test_a_legend_has_each_arm_once_where_scenarios_have_unequal_numbers_of_runs():
    fewer = [r for r in results("two") if r.seed not in (1, 2) or r.arm == "oracle"]
    drawn = learning_curves(found_in(study(("one", "two")), results() + fewer))
    texts = re.findall(r"<!-- (.*?) -->", drawn)
    assert [texts.count(name) for name in ("zeros", "forecast", "oracle")] == [1, 1, 1]
    assert {"one, n = 3", "two, n = 1 to 3"} <= set(texts)
    assert texts.count("policies that are kept, test seeds") == 1


def test_scores_of_several_scenarios_are_rescaled():
    findings = found_in(study(("one", "two")), results() + results("two", lift=2.0))
    scaled = findings.scaled_runs(SEEN, ["one", "two"])
    assert [float(np.mean(runs)) for runs in scaled] == pytest.approx([3 / 8, 5 / 8]), "2 is the lowest, 10 the highest"


def test_scenarios_weigh_the_same_where_their_runs_are_pooled(tmp_path: Path):
    """One more seed in one of them with the mean of its others moved the interquartile mean over both."""
    more = [result("forecast", [6.0, 8.0], seed, "two") for seed in (3, 4)]
    findings = found_in(study(("one", "two")), results() + results("two", lift=2.0) + more)
    assert [len(runs) for runs in findings.scaled_runs(SEEN, ["one", "two"])] == [3, 5]
    fewer = found_in(study(("one", "two")), results() + results("two", lift=2.0))
    even, before = findings.even_runs(SEEN), fewer.even_runs(SEEN)
    assert [len(runs) for runs in even] == [3, 3]
    np.testing.assert_allclose(even[0], before[0])
    text, _ = written(tmp_path, results() + results("two", lift=2.0) + more)
    assert "Of each arm as many runs of each scenario count, the first ones." in text
    assert "| forecast | 6 |" in text.split("## All scenarios")[1]


def test_a_run_that_takes_one_action_is_called_constant():
    episodes = tuple({**e, "action_counts": {"slower": 19, "idle": 1}} for e in result("zeros", [1.0], 0).episodes)
    made = [result("zeros", [1.0], 0, episodes=episodes), result("zeros", [1.0], 1)]
    assert found_in(study(), made).constant_runs("one", ZEROS) == {"slower": 1}


def test_an_interval_does_not_depend_on_other_arms():
    alone = [r for r in results() if r.arm == "forecast"]
    assert found_in(study(), alone).middle_return("one", SEEN) == found_in(study(), results()).middle_return(
        "one", SEEN
    )


def written(folder: Path, found: list[Result], **changes: Any) -> tuple[str, str]:
    scenarios = tuple(dict.fromkeys(r.scenario for r in found))
    write_report(folder, found_in(study(scenarios, **changes), found), 'arms = ["zeros"]\n', MADE, [])
    return (folder / "report.md").read_text(), (folder / "report.html").read_text()


@pytest.mark.slow
def test_the_report_says_what_was_found(tmp_path: Path):
    text, page = written(tmp_path, results())
    assert "| forecast | 3 | 5.00 (3.76 to 6.24) | 5.00 (4.67 to 5.33) | 50 % (50 to 50) | 10.0 | 20.0 |" in text
    assert "| slower | – | 4.00 (−8.71 to 16.71) | – |" in text
    assert "| forecast > zeros | one | 1.00 (1.00 to 1.00) | 3.00" in text
    assert re.search(r"\| one \| slower: 4.00 .* \| 7.00 .* \| 2.00 .* \| 10.00 .* \| 8.00 .* \| 38 % \(", text)
    assert "| forecast | one | 0.2 | 60.0 | 0.1 |" in text, "12 s for 200 steps"
    assert text.rstrip().endswith('arms = ["zeros"]\n```')
    for cell in re.findall(r"\| (\S+ > \S+|[\d.]+ \([^)]*\)) ", text):
        assert cell.replace(">", "&gt;") in page, "both forms have the same cells"


def test_one_crash_in_200_episodes_does_not_read_0_percent(tmp_path: Path):
    safe = result("slower", [1.0] * 200)
    once = replace(safe, episodes=tuple(e | {"crashed": not place} for place, e in enumerate(safe.episodes)))
    others = [each for each in results() if each.arm != "slower"]
    assert "| 0.5 % (0.1 to 2.8) |" in written(tmp_path, [*others, once])[0]


@pytest.mark.slow
def test_the_page_needs_nothing_else(tmp_path: Path):
    _, page = written(tmp_path, results())
    tags: list[tuple[str, dict[str, str | None]]] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            tags.append((tag, dict(attrs)))

    Reader().feed(page)
    names = [tag for tag, _ in tags]
    assert names.count("svg") == 2 and "script" not in names and "link" not in names and "img" not in names
    links = [value for _, found in tags for key, value in found.items() if key in ("src", "href", "xlink:href")]
    assert all(str(link).startswith("#") for link in links)
    assert (tmp_path / "pictures" / "learning_curves.svg").read_text().startswith("<svg")


@pytest.mark.slow
def test_reports_of_equal_results_are_equal(tmp_path: Path):
    both = results() + results("two", lift=1.0)
    first = written(tmp_path / "a", both)
    assert written(tmp_path / "b", both) == first
    assert "## All scenarios" in first[0] and "| forecast > zeros | all, rescaled scores | 1.00" in first[0]
    assert written(tmp_path / "c", results() + results("two", lift=1.1)) != first


@pytest.mark.slow
def test_the_report_counts_the_runs_that_there_are(tmp_path: Path):
    assert "3 training seeds per arm" in written(tmp_path / "all", results())[0]
    assert "2 to 3 training seeds per arm" in written(tmp_path / "fewer", results()[:-1])[0]
    one = [r for r in results() if r.seed in (None, 0)]
    assert "1 training seed per arm" in written(tmp_path / "one", one)[0]


@pytest.mark.slow
def test_the_report_says_what_the_results_hold(tmp_path: Path):
    """The study's file may have changed since."""
    point = {"return": 5.0, "seconds": 6.0, "episodes": 7}
    found = [
        r if r.algorithm is None else replace(r, curve=({"steps": 100 + 20 * bool(r.seed)} | point,)) for r in results()
    ]
    found[0] = replace(found[0], episodes=found[0].episodes[:1])
    text = written(tmp_path / "all", found)[0]
    assert "; 1 to 2 test episodes per policy and driver" in text and "Mean return on the 7 selection seeds" in text
    assert "Trainings of different lengths [environment steps]: one (ppo) 100 to 120." in text
    text = written(tmp_path / "alike", results())[0]
    assert "; 2 test episodes per policy and driver" in text and "different lengths" not in text


@pytest.mark.slow
def test_what_failed_is_named(tmp_path: Path):
    write_report(tmp_path, found_in(study(), results()[:-1]), "", MADE, ["one, oracle, ppo, seed 2"])
    text = (tmp_path / "report.md").read_text()
    assert "Without a result: one, oracle, ppo, seed 2." in text and "| oracle | 2 |" in text


def test_drivers_alone_make_a_report(tmp_path: Path):
    text, _ = written(tmp_path, results()[:4])
    assert "| planner | – | 7.00" in text and "Learning curves" not in text and "## Headroom" not in text


def test_headroom_alone(tmp_path: Path):
    text = write_headroom(tmp_path, found_in(study(), results()), MADE)
    assert (
        "| scenario | best constant action | planner | planner:oracle | zeros | oracle | headroom | forecast uses |"
        in text
    )
    assert "minutes of a training" in text and "3 training seeds per arm" in text and "Without a result" not in text
    text = write_headroom(tmp_path, found_in(study(), results()[:-1]), MADE, ["one, oracle, ppo, seed 2"], "4 cells")
    for said in ("Without a result: one, oracle, ppo, seed 2.", "Not run yet: 4 cells of the study."):
        assert said in text and said in (tmp_path / "headroom.md").read_text()
    assert "## Provenance" in (tmp_path / "headroom.md").read_text()


def test_a_planner_that_is_not_what_its_column_says_is_named(tmp_path: Path):
    found = [replace(r, arm="planner:constant-velocity") if r.arm == "planner" else r for r in results()]
    found.append(result("planner@0.1:oracle", [9.0, 9.0]))
    text = write_headroom(tmp_path, found_in(study(), found), MADE)
    assert "| planner:constant-velocity: 7.00" in text and "| planner@0.1:oracle: 9.00" in text
    found[-1] = result("planner:oracle", [9.0, 9.0])
    assert "planner:oracle: " not in write_headroom(tmp_path, found_in(study(), found), MADE)


def test_intervals_as_text():
    assert interval(Estimate(0.25, (0.1, 0.4)), 0, 100.0, " %") == "25 % (10 to 40)"
    assert interval(Estimate(-1.0, (-2.0, 0.5)), 1) == "−1.0 (−2.0 to 0.5)"
    assert interval(Estimate(1.0, None)) == "1.00"
    assert interval(Estimate(float("nan"), (0.0, 0.0))) == "–"


@pytest.mark.slow
def test_errors_in_the_loop_stand_beside_returns(tmp_path: Path):
    errors = ((3.0, 9.0), (1.0, 8.0))
    curve = tuple(
        {"steps": 100 * (i + 1), "return": 5.0 + i, "seconds": 6.0, FORECAST_ERROR: ours, CONSTANT_ERROR: constant}
        for i, (ours, constant) in enumerate(errors)
    )
    found = [r if r.arm != "forecast" else replace(r, curve=curve) for r in results()]
    write_report(tmp_path, found_in(study(), found), "", MADE, [])
    lines = (tmp_path / "report.md").read_text().splitlines()
    start = lines.index("## Forecast errors in the loop")
    table = [line for line in lines[start : start + 10] if line.startswith("| ")]
    assert table[1:] == ["| forecast | one | 3.00 | 1.00 | 8.00 | 6.00 |"], "arms without errors have no line"
    write_report(tmp_path, found_in(study(), results()), "", MADE, [])
    assert "errors in the loop" not in (tmp_path / "report.md").read_text()


def test_the_time_of_a_test_step_is_that_of_all_steps_of_an_arm(tmp_path: Path):
    """Two episodes of five steps in each run, which take 6 s."""
    found = [replace(one, episodes=tuple(e | {"length": 5} for e in one.episodes)) for one in results()]
    write_report(tmp_path, found_in(study(), found), "", MADE, [])
    text = (tmp_path / "report.md").read_text().split("## Time")[1]
    [line] = [line for line in text.splitlines() if line.startswith("| forecast |")]
    assert line.split("|")[-2].strip() == "600.0"


def test_no_share_is_told_of_a_headroom_whose_interval_reaches_zero():
    """The oracle's mean is two above that of zeros, and its runs lie three apart."""
    found = [r for r in results() if r.arm != "oracle"]
    found += [result("oracle", [4 + d, 4 + d], seed) for seed, d in enumerate((-3.0, 0.0, 3.0))]
    findings = found_in(study(), found)
    headroom = findings.headroom("one", "ppo")
    assert headroom is not None and headroom.value == pytest.approx(2.0) and headroom.interval[0] < 0
    assert findings.headroom_used("one", SEEN) is None


def test_a_driver_that_is_best_ends_the_scale_of_rescaled_scores():
    driven = [result("heuristic", [18.0, 18.0], scenario=name) for name in ("one", "two")]
    findings = found_in(study(("one", "two")), [*results(), *results("two"), *driven])
    scaled = findings.scaled_runs(SEEN, ["one", "two"])
    assert [float(np.mean(runs)) for runs in scaled] == pytest.approx([3 / 16] * 2), "2 is the lowest, 18 the highest"
