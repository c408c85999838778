"""Report of a study: tables, pictures and provenance, as Markdown and as one HTML page."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.forecast_errors import CONSTANT_ERROR, FORECAST_ERROR
from agents.results import NOT_REPORTED
from agents.studies.estimators import interquartile_mean
from agents.studies.findings import NEARLY_CONSTANT, Findings, Line
from agents.studies.pictures import learning_curves, profiles
from agents.summaries import percent_digits
from envs.drivers.planner import ORACLE, PLANNER
from predictor.evaluation.standard_errors import Estimate
from predictor.reports.document import PICTURES, Block, Code, Heading, Paragraph, Picture, Table, as_html, as_markdown
from predictor.support.files import write_text

REPORT, PAGE, HEADROOM = Path("report.md"), Path("report.html"), Path("headroom.md")
NOTHING = "–"


def write_report(
    folder: Path, findings: Findings, text: str, provenance: dict[str, Any], failed: Sequence[str], not_run: str = ""
) -> None:
    """Writes the report as Markdown, with its pictures beside it, and as one HTML page.

    Args:
        folder: folder of the study.
        findings: results.
        text: the study file.
        provenance: provenance of this start.
        failed: names of the cells that failed.
        not_run: how many cells were not asked for and have no result of before, as text; empty for none.
    """
    blocks = blocks_of(findings, text, provenance, failed, not_run)
    for block in blocks:
        if isinstance(block, Picture):
            write_text(folder / PICTURES / block.file, block.svg + "\n")
    write_text(folder / REPORT, as_markdown(blocks))
    write_text(folder / PAGE, as_html(title_of(findings), blocks))


def write_headroom(
    folder: Path, findings: Findings, provenance: dict[str, Any], failed: Sequence[str] = (), not_run: str = ""
) -> str:
    """Writes the headroom table with what it took, and returns it as Markdown; arguments as of `write_report`."""
    found = [*_standing(findings, failed, not_run), *_headroom(findings), *_times(findings)]
    title = Heading(f"Headroom: {title_of(findings)}", 1)
    write_text(folder / HEADROOM, as_markdown([title, *found, *_provenance(findings, provenance, "")]))
    return as_markdown(found)


def title_of(findings: Findings) -> str:
    """Returns the heading of the report."""
    return findings.study.title or f"Study {findings.study.name}"


def blocks_of(
    findings: Findings, text: str, provenance: dict[str, Any], failed: Sequence[str], not_run: str = ""
) -> list[Block]:
    """Returns the blocks of the report; what differs between two runs of one study stands at its end."""
    study = findings.study
    blocks: list[Block] = [Heading(title_of(findings), 1), *_standing(findings, failed, not_run)]
    for scenario in findings.scenarios:
        blocks += _scenario(findings, scenario)
    if study.compared_with and findings.lines(trained=True):
        blocks += _pairs(findings)
    blocks += _headroom(findings)
    if len(findings.scenarios) > 1 and findings.common_lines():
        blocks += _all_scenarios(findings)
    if findings.lines(trained=True):
        blocks += _pictures(findings)
    return [*blocks, *_loop_errors(findings), *_times(findings), *_provenance(findings, provenance, text)]


def interval(estimate: Estimate, digits: int = 2, scale: float = 1.0, unit: str = "") -> str:
    """Returns an estimate as text, with its interval behind it."""
    if np.isnan(estimate.value):
        return NOTHING
    value = f"{scale * estimate.value:.{digits}f}{unit}"
    if estimate.interval is not None:
        low, high = estimate.interval
        value += f" ({scale * low:.{digits}f} to {scale * high:.{digits}f})"
    return value.replace("-", "−")


def _standing(findings: Findings, failed: Sequence[str], not_run: str) -> list[Block]:
    """Returns what the numbers are made of, and which cells they lack."""
    blocks: list[Block] = [Paragraph(_summary(findings))]
    if failed:
        blocks.append(Paragraph(f"Without a result: {'; '.join(failed)}. The numbers below are of the others."))
    if not_run:
        blocks.append(Paragraph(f"Not run yet: {not_run} of the study. The numbers below are of the others."))
    return blocks


def _span(counts: Iterable[int]) -> str:
    """Returns the lowest and the highest of some numbers as text; one, if they are equal."""
    found = sorted(set(counts)) or [0]
    return " to ".join(map(str, dict.fromkeys((found[0], found[-1]))))


def _summary(findings: Findings) -> str:
    seeds = {len(runs) for (_, line), runs in findings.results.items() if line.algorithm is not None}
    episodes = _span(len(each.episodes) for runs in findings.results.values() for each in runs)
    return (
        f"{_span(seeds)} training {'seed' if seeds == {1} else 'seeds'} per arm; {episodes} test episodes per "
        "policy and driver, on seeds that are the same for all and that neither training nor selection uses. A run is "
        "one training; its score is its mean return over these episodes. Intervals are 95 %: Student's for means over "
        "runs, Welch's for differences of two of them in one scenario, percentiles of a bootstrap over runs for "
        "everything else; the latter are too narrow for few runs (that of a mean of five holds the truth in 83 % of "
        "cases). Where all runs score the same, an interval has no width, which says nothing of further runs. Drivers "
        "are not trained: their intervals are over episodes (of crash rates Wilson's) and cannot be compared with "
        f"those over runs. {NOTHING} stands for what there is not, as the runs of a driver." + _unequal(findings)
    )


def _unequal(findings: Findings) -> str:
    """Returns a sentence on trainings of one scenario and algorithm that differ in length, as when `steps` changed."""
    ends: dict[tuple[str, str | None], set[int]] = {}
    for (scenario, line), runs in findings.results.items():
        own = {each.curve[-1]["steps"] for each in runs if each.curve}
        ends[scenario, line.algorithm] = ends.get((scenario, line.algorithm), set()) | own
    unequal = {key: _span(steps) for key, steps in ends.items() if len(steps) > 1}
    named = "; ".join(f"{scenario} ({algorithm}) {steps}" for (scenario, algorithm), steps in unequal.items())
    return f" Trainings of different lengths [environment steps]: {named}." if named else ""


def _scenario(findings: Findings, scenario: str) -> list[Block]:
    """Returns the table of a scenario, arms first, and what is nearly constant."""
    headings = ["policy", "runs", "mean return", "interquartile mean", "crash rate", "length [steps]", "speed [m/s]"]
    lines, notes = [], []
    for line in (*findings.lines(scenario, trained=True), *findings.lines(scenario, trained=False)):
        trained = line.algorithm is not None
        crashes = findings.crash_rate(scenario, line)
        runs = findings.results[scenario, line]
        lines.append(
            [
                findings.label(line),
                str(len(runs)) if trained else NOTHING,
                interval(findings.mean_return(scenario, line)),
                interval(findings.middle_return(scenario, line)) if trained else NOTHING,
                NOT_REPORTED if crashes is None else interval(crashes, percent_digits(crashes.value), 100.0, " %"),
                _number(findings.mean_of(scenario, line, "length")),
                _number(findings.mean_of(scenario, line, "mean_speed_mps")),
            ]
        )
        if trained and (constant := findings.constant_runs(scenario, line)):
            taken = ", ".join(f"{count} × {action}" for action, count in constant.items())
            notes.append(f"{findings.label(line)} {constant.total()} of {len(runs)} ({taken})")
    env_id = next(iter(findings.results[scenario, findings.lines(scenario)[0]])).env_id
    blocks: list[Block] = [Heading(f"{scenario} ({env_id})"), Table(headings, lines)]
    if notes:
        share = f"{100 * NEARLY_CONSTANT:.0f} %"
        blocks.append(Paragraph(f"Runs that take one action in at least {share} of their steps: {'; '.join(notes)}."))
    return blocks


def _pairs(findings: Findings) -> list[Block]:
    """Returns the table of probabilities of improvement."""
    headings = ["comparison", "scenario", "probability of improvement", "difference of means"]
    groups = [([scenario], scenario) for scenario in findings.scenarios]
    if len(groups) > 1:
        groups.append((list(findings.scenarios), "all, rescaled scores"))
    lines = [
        [
            f"{findings.label(pair.ours)} > {findings.label(pair.rival)}",
            name,
            interval(pair.probability),
            interval(pair.gain),
        ]
        for scenarios, name in groups
        for pair in findings.pairs(scenarios)
    ]
    if not lines:
        return []
    told = (
        "How probable it is that a run of the first arm has a higher score than a run of the second one in the same "
        "scenario; 0.5 is a draw. With few runs an interval that excludes 0.5 is weak evidence."
    )
    return [Heading("Probability of improvement"), Paragraph(told), Table(headings, lines)]


def _headroom(findings: Findings) -> list[Block]:
    """Returns the table of headroom; none where the study has no floor or no ceiling."""
    study = findings.study
    lines: list[list[str]] = []
    others = [x for x in findings.lines(trained=True) if x.arm not in (study.floor, study.ceiling)]
    arms = tuple(dict.fromkeys(x.arm for x in others))
    for scenario in findings.scenarios:
        for algorithm in study.algorithms:
            headroom = findings.headroom(scenario, algorithm)
            if headroom is None:
                continue
            named = [findings.best_constant(scenario), findings.planner(scenario), findings.planner(scenario, True)]
            named += [Line(study.floor, algorithm), Line(study.ceiling, algorithm)]
            shares = [_share(findings, scenario, Line(arm, algorithm)) for arm in arms]
            several = f" ({algorithm})" if len(study.algorithms) > 1 else ""
            cells = [f"{scenario}{several}", *(_return_of(findings, scenario, x) for x in named)]
            lines.append([*cells, interval(headroom), *shares])
    if not lines:
        return []
    headings = ["scenario", "best constant action", "planner", "planner:oracle", study.floor, study.ceiling, "headroom"]
    told = (
        f"Headroom is the mean return of {study.ceiling} above that of {study.floor}. The share of it that an arm uses "
        "is given where the interval of the headroom lies above 0; elsewhere there is nothing that could be shared."
    )
    return [Heading("Headroom"), Paragraph(told), Table([*headings, *(f"{arm} uses" for arm in arms)], lines)]


def _share(findings: Findings, scenario: str, line: Line) -> str:
    used = findings.headroom_used(scenario, line) if (scenario, line) in findings.results else None
    return NOTHING if used is None else interval(used, 0, 100.0, " %")


def _return_of(findings: Findings, scenario: str, line: Line | None) -> str:
    if line is None:
        return NOTHING
    value = interval(findings.mean_return(scenario, line))
    named = line.algorithm is None and line.arm not in (PLANNER, f"{PLANNER}:{ORACLE}")  # the headings say these
    return f"{line.arm}: {value}" if named else value


def _all_scenarios(findings: Findings) -> list[Block]:
    lines = []
    for line in findings.common_lines():
        runs = findings.even_runs(line)
        middle = findings.estimate(interquartile_mean, runs, about=("all", *line))
        lines.append([findings.label(line), str(sum(len(found) for found in runs)), interval(middle)])
    told = (
        "Rescaled scores: 0 is the lowest and 1 the highest mean return of any line of the scenario's table. Of each "
        "arm as many runs of each scenario count, the first ones."
    )
    table = Table(["policy", "runs", "interquartile mean of rescaled scores"], lines)
    return [Heading("All scenarios"), Paragraph(told), table]


def _pictures(findings: Findings) -> list[Block]:
    points = [point for runs in findings.results.values() for each in runs for point in each.curve]
    episodes = _span(point.get("episodes", findings.study.selection_episodes) for point in points)
    curves = (
        f"Mean return on the {episodes} selection seeds during training; bands: 95 % interval over runs. "
        "Diamonds: the policies that are kept, on the test seeds, with 95 % intervals; grey lines: drivers there. "
        "Selection seeds may be easier or harder than test seeds."
    )
    shares = "Share of runs whose score is above τ; bands: 95 % bootstrap over runs."
    return [
        Heading("Learning curves"),
        Picture("learning_curves.svg", learning_curves(findings), curves),
        Heading("Performance profiles"),
        Picture("profiles.svg", profiles(findings), shares),
    ]


def _loop_errors(findings: Findings) -> list[Block]:
    """Returns the table of the errors of the forecasts that policies acted on; nothing where no arm has forecasts."""
    lines = []
    for (scenario, line), results in findings.results.items():
        curves = [r.curve for r in results if r.curve and all(FORECAST_ERROR in point for point in r.curve)]
        if curves:
            first, last, constant = (
                float(np.mean([curve[place][key] for curve in curves]))
                for place, key in ((0, FORECAST_ERROR), (-1, FORECAST_ERROR), (-1, CONSTANT_ERROR))
            )
            returns = float(np.mean([curve[-1]["return"] for curve in curves]))
            lines.append(
                [findings.label(line), scenario, f"{first:.2f}", f"{last:.2f}", f"{constant:.2f}", f"{returns:.2f}"]
            )
    if not lines:
        return []
    headings = ["policy", "scenario", "before the first measurement [m]", "before the last [m]"]
    headings += ["constant velocity before the last [m]", "return at the last"]
    told = (
        "Mean error of the forecasts behind the observations while the policy learned, up to the end of each episode. "
        "Arms that show something else (zeros, oracle) have the same forecaster behind them."
    )
    return [Heading("Forecast errors in the loop"), Paragraph(told), Table(headings, lines)]


def _times(findings: Findings) -> list[Block]:
    """Returns the table of what trainings and measurements took."""
    lines = []
    for (scenario, line), results in findings.results.items():
        trained = [r for r in results if r.curve]
        steps = sum(r.curve[-1]["steps"] for r in trained)
        seconds = sum(r.train_seconds for r in trained)
        test_steps = sum(episode["length"] for r in results for episode in r.episodes)
        lines.append(
            [
                findings.label(line),
                scenario,
                f"{seconds / len(trained) / 60:.1f}" if trained else NOTHING,
                f"{1000 * seconds / steps:.1f}" if steps else NOTHING,
                f"{np.mean([r.measure_seconds for r in results]) / 60:.1f}",
                f"{1000 * sum(r.measure_seconds for r in results) / test_steps:.1f}" if test_steps else NOTHING,
            ]
        )
    headings = ["policy", "scenario", "minutes of a training", "ms per environment step"]
    headings += ["minutes of test episodes", "ms per test step"]
    told = (
        "Times of one process with one thread, beside others; a training's are without its measurements. A test step "
        "is simulator, forecast and decision, without learning."
    )
    return [Heading("Time"), Paragraph(told), Table(headings, lines)]


def _provenance(findings: Findings, provenance: dict[str, Any], text: str) -> list[Block]:
    versions = ", ".join(f"{name} {version}" for name, version in provenance["versions"].items())
    told = f"{provenance['command']}; commit {provenance['commit']}; {provenance['machine']}; {provenance['time']}."
    commits = Counter(str(each.provenance.get("commit")) for runs in findings.results.values() for each in runs)
    counted = ", ".join(f"{count} of {commit}" for commit, count in commits.items())
    blocks: list[Block] = [Heading("Provenance"), Paragraph(told), Paragraph(f"Versions: {versions}.")]
    blocks.append(Paragraph(f"Commits of the results: {counted}."))
    return [*blocks, Code(text, "toml")] if text else blocks


def _number(value: float) -> str:
    return NOTHING if np.isnan(value) else f"{value:.1f}"
