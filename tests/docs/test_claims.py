"""Claims of the pages that were wrong once, each held by what it is about."""

import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from envs.readers.mpe import MPE_IDS
from envs.registry import CHECKPOINTS, ENVS, MULTIAGENT_CHECKPOINTS, MULTIAGENT_IDS
from predictor.evaluation.paper_tables import NUM_SAMPLES
from predictor.models import configure
from predictor.suite import TABLES, SuiteConfig, line_config
from predictor.support.command_line import parse
from predictor.training.config import OF_THE_DGVAE, TrainConfig

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
README = (ROOT / "README.md").read_text()
LIMITS, OBSERVATIONS = ((ROOT / "docs" / f"{name}.md").read_text() for name in ("limits", "observations"))
RESULTS = (ROOT / "docs" / "results.md").read_text()
TRAINING = (ROOT / "docs" / "training.md").read_text()
CONTROL = "constant velocity + noise"
STOCHASTIC = ("dG-VAE", "dVAE", "dNRI", "plural", "nearest neighbours", CONTROL)
TITLES = {  # the run that a picture's title names
    "springs.png": "runs/springs-rl",
    "springs_trajectories.png": "runs/springs-rl",
    "mocap_trajectories.png": "runs/mocap-plural",
    "mocap_features.png": "runs/mocap-pm",
    "nba_trajectories.png": "runs/nba-plural",
    "sdd_trajectories.png": "runs/sdd-plural",
}


def tables(page: str) -> Iterator[list[list[str]]]:
    """Cells of each Markdown table of a page, heading first, without the rule below it."""
    for block in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE):
        yield [line.strip().strip("|").split("|") for line in block.splitlines() if not line.startswith("|---")]


def lines_with_k(page: str) -> list[list[dict[str, str]]]:
    """Lines of each table of models, by heading."""
    found = []
    for heading, *lines in tables(page):
        names = [cell.strip() for cell in heading]
        if names[0] in ("model", "row", "5-Spring"):
            found.append(
                [dict(zip(names, (c.strip() for c in line), strict=True)) | {"": line[0].strip()} for line in lines]
            )
    return found


@pytest.mark.parametrize("path", [p for p in PAGES if lines_with_k(p.read_text())], ids=lambda p: p.name)
def test_every_line_of_a_table_of_models_says_how_many_forecasts_it_chooses_from(path: Path):
    for lines in lines_with_k(path.read_text()):
        for line in lines:
            stochastic = line[""].replace("*", "").startswith(STOCHASTIC) or line[""].endswith(" + Gaussian")
            assert line.get("K") == str(NUM_SAMPLES if stochastic else 1), line


def test_every_table_of_results_has_the_stochastic_control():
    found = lines_with_k(RESULTS)
    errors = [lines for lines in found if any("minADE" in heading for heading in lines[0])]
    assert (len(found), len(errors)) == (16, 12)  # two views and the graph of four, three with two sets; three seeds
    assert all(CONTROL in {line[""] for line in lines} for lines in errors)


@pytest.mark.parametrize("title", ["NBA", "Stanford Drone Dataset", "5-Spring", "Motion capture"])
def test_the_text_names_the_leader_at_equal_k(title: str):
    """Which row is best in the horizon-only table, and what the bold first sentence below says of it."""
    section = next(part for part in RESULTS.split("\n## ") if part.startswith(title))
    horizon = lines_with_k(section)[0]
    error = {
        line[""].replace("*", ""): float(line["minADE"].split()[0])
        for line in horizon
        if line["K"] == str(NUM_SAMPLES) and "(limit)" not in line[""]  # least squares knows the law
    }
    leader = min(error, key=lambda name: error[name])
    claim = section.split("### What it says")[1].strip().split("**")[1].lower()
    assert "lead" in claim
    assert leader.lower() in claim
    assert (CONTROL in claim) == (leader == CONTROL), f"{leader} leads, but: {claim}"


def test_what_wraps_with_one_argument_is_what_has_a_checkpoint():
    lines = {
        cells[0].strip(): cells[1].strip()
        for cells in next(t for t in tables(OBSERVATIONS) if "environments" in t[0][0])
    }
    one_argument = " ".join(name for name, code in lines.items() if re.search(r"\(env\)`", code))
    assert len([e for e in CHECKPOINTS if "mixed" not in e]) == 13 and "thirteen ids" in one_argument
    assert len([e for e in ENVS if "mixed" in e]) == 5 and "five [mixed-driver" in one_argument
    assert len(set(MULTIAGENT_CHECKPOINTS) & set(MPE_IDS)) == 10 and "ten ids" in one_argument
    others = [e for e in MULTIAGENT_IDS if e not in MULTIAGENT_CHECKPOINTS]
    assert others == [
        "collect_treasure_v1", "pursuit_v5", "intersection-multi-agent-v1", "intersection-multi-agent-v0"
    ]  # fmt: skip
    named = next(name for name in lines if "pursuit" in name)
    assert all(e.removeprefix("intersection-multi-agent").removesuffix("_v5") in named for e in others)
    assert "checkpoint" in lines[named]


def test_what_the_shipped_checkpoints_use_of_the_newer_parts_is_what_their_configs_say():
    configs = {
        p.parent.name: json.loads(p.read_text())["config"]
        for p in (ROOT / "predictor/pretrained").glob("*/config.json")
    }
    assert f"All {len(configs)} see changes" in LIMITS and "as all that ship are" in LIMITS
    for name, config in configs.items():
        assert config["change_scales"] and config["input_scales"] and config["num_modes"] == 20, name
    without = LIMITS.split("All have geometry on their edges")[1].split("\n* ")[0]
    named = {name for name in configs if f"`{name}`" in without}
    assert named == {name for name, config in configs.items() if not config.get("geometry_scales")}
    number = {3: "three", 4: "four"}[len(named)]
    assert f"but for {number} of the {len(configs)}" in " ".join(TRAINING.split())
    for config in configs.values():
        assert not config.get("innovation_rounds") and not config.get("gated_messages")
        assert config["residual"] == "constant_velocity"


@pytest.mark.parametrize("picture", TITLES)
def test_the_run_in_a_pictures_title_is_the_one_that_the_page_names(picture: str):
    pages = [page for page in PAGES if f"{picture})" in page.read_text() and page.name != "README.md"]
    assert pages
    for page in pages:
        assert TITLES[picture] in page.read_text(), page.name


@pytest.mark.parametrize(("name", "key"), [("dG-VAE (paper)", "dgvae-paper"), ("dG-VAE+", "dgvae")])
def test_the_options_that_stand_behind_a_name_make_the_suites_row(name: str, key: str):
    """Whatever the defaults are; sizes are the budget's, the number of features is the table's."""
    rows = {row[0].strip(): row[2] for row in next(tables(TRAINING.split("## Names")[1]))}
    words = shlex.split(" ".join(re.findall(r"`([^`]+)`", rows[name])))
    named = parse(TrainConfig, args=["--data", "store", "--out", "run", *words])
    suite = SuiteConfig("springs", budget="paper")
    line = next(line for line in TABLES["springs"].lines if line.key == key)
    made = line_config(suite, line, Path("run"))
    weights = [f.name for f in fields(TrainConfig) if f.name.endswith(("_weight", "_cost"))]
    for field in ("model", "preset", "likelihood", "variance", *OF_THE_DGVAE, *weights):
        assert getattr(named, field) == getattr(made, field), field
    features = [each for each in line.set if each.startswith("edge_feature_dim=")]
    assert configure("dgvae", named.preset, (*named.set, *features)) == configure("dgvae", made.preset, made.set)


@pytest.mark.parametrize("path", PAGES, ids=lambda p: p.name)
def test_benchmarks_are_run_as_modules(path: Path):
    assert not re.findall(r"python\d? benchmarks/\w+", path.read_text())


ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()


def test_tasks_lead_to_files_that_exist_and_hold_what_is_named():
    lines = next(tables(ARCHITECTURE.split("## Where does a line belong?")[1]))[1:]
    assert len(lines) == 16
    paths = {
        task: re.findall(r"`((?:predictor|envs|agents|benchmarks|tests)/[\w/.]*)`", f"{where} {also}")
        for task, where, also in lines
    }
    assert all(paths.values())
    every = {path for named in paths.values() for path in named}
    assert [path for path in every if not (ROOT / path).exists()] == []
    code = "".join((ROOT / path).read_text() for path in every if path.endswith((".py", ".json")))
    for task, where, also in lines:
        for name in re.findall(r"`(\w+)`", f"{where} {also}"):
            assert re.search(rf"\b{name}\b", code), f"{task}: no file that is named has {name}"


@pytest.mark.parametrize("package", ["predictor", "envs", "agents"])
def test_the_tables_of_rooms_have_the_order_of_the_import_contracts(package: str):
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c.get("containers") == [package])
    table = next(tables(ARCHITECTURE.split(f"### `{package}/`")[1]))[1:]
    rooms = [{name.rstrip("/") for name in re.findall(r"`([\w/]+)`", line[0])} for line in table]
    assert rooms == [{name.strip() for name in layer.split("|")} for layer in layers]


def test_every_link_to_a_file_leads_there():
    missing = [
        f"{page.relative_to(ROOT)}: {target}"
        for page in PAGES
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text())
        if "://" not in target and not (page.parent / target).exists()
    ]
    assert missing == []


def test_the_paper_is_named_linked_and_cited():
    for part in (
        "Disentangled Neural Relational Inference for Interpretable Motion Prediction",
        "arxiv.org/abs/2401.03599",
    ):
        assert part in README
    assert "@article{" in README and "Dax, Victoria M." in README


def test_each_card_says_how_it_reacts_by_figures_of_the_page_on_reactions():
    """Each figure stands on that page in what is said of the card's environment."""
    page = (ROOT / "docs" / "reactions.md").read_text().replace("**", "")
    scored = 0
    for card in sorted((ROOT / "predictor" / "pretrained").glob("*/README.md")):
        section = card.read_text().split("\n## Reactions and graph\n")[1].split("\n## ")[0]
        found = re.search(r" on ([\w-]+) \(", section)
        if found is None:
            assert section.strip().startswith("Not measured."), card
            continue
        env_id, checkpoint = found[1], card.parent.name
        told = [text for text in re.findall(r"\n\* .*?(?=\n\* |\n\n|\Z)", page, re.DOTALL) if env_id in text[:30]]
        # of highway-fast-v0, the lines of the checkpoint in the table of perturbations
        told += [line for line in page.splitlines() if f"| `{checkpoint}` |" in line]
        told += re.findall(rf"\n\| {env_id} \| `{checkpoint}`.*?(?=\n\| [^|\s]|\n\n)", page, re.DOTALL)
        assert told, card
        figures = re.findall(r"−?\d\.\d\d(?: \(−?\d\.\d\d to \d\.\d\d\))?", section)
        for figure in figures:
            assert figure in " ".join(" ".join(told).split()), (card, figure)
        scored += 1
    assert scored == 12
