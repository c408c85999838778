"""Writes the report of a training run as one HTML page: `python -m agents.report runs/highway`.

The run is one of train_policy.py or of predictor.train. The page needs no network: style and pictures are inside, and
small films, too. It is report.html in the run folder, and the learning curves are curves.png beside it.
"""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from agents.run_page import policy_blocks
from agents.runs import CONFIG_FILE
from predictor.reports.document import Heading, Picture, as_html
from predictor.reports.predictor_run import predictor_blocks
from predictor.reports.run_blocks import ACCURACY_FILE
from predictor.support.command_line import parse
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import write_bytes, write_text
from predictor.support.reading import NoSuchFile, as_object, read_object

PAGE = Path("report.html")


@dataclass(frozen=True)
class ReportConfig:
    """Writes the report of a training run as one HTML page."""

    run: Positional[Path]
    """Run folder of train_policy.py or of predictor.train."""
    accuracy: tuple[Path, ...] = ()
    """Folders of envs.evaluate or predictor.evaluate whose tables and worst forecasts are shown, too; accuracy/ in the
    run folder always is."""


def write_report(config: ReportConfig) -> Path:
    """Writes the page and the picture of the curves; returns the path of the page.

    Raises:
        UserError: the folder holds no run, or a file of it is damaged.
    """
    run = config.run
    if not run.is_dir():
        raise UserError(f"no run folder at {run}; give the --out of train_policy.py or of predictor.train")
    for folder in config.accuracy:
        if not (folder / ACCURACY_FILE).exists():
            takes = "--accuracy takes the --out of envs.evaluate or predictor.evaluate"
            raise UserError(f"no {ACCURACY_FILE} in {folder}; {takes}")
    blocks_of = policy_blocks if is_policy_run(run) else predictor_blocks
    once: dict[Path, Path] = {}
    for folder in (run, run / "accuracy", *config.accuracy):
        once.setdefault(folder.resolve(), folder)
    blocks = blocks_of(run, list(once.values()))
    for block in blocks:
        if isinstance(block, Picture):
            write_bytes(run / Path(block.file).with_suffix(".png"), block.png)
    title = next(block.text for block in blocks if isinstance(block, Heading))
    write_text(run / PAGE, as_html(title, blocks))
    return run / PAGE


def is_policy_run(run: Path) -> bool:
    """Returns whether a run folder is one of train_policy.py; the other kind is of predictor.train.

    Raises:
        UserError: it is neither.
    """
    try:
        content = read_object(run / CONFIG_FILE)
    except NoSuchFile as error:
        raise UserError(f"{run} holds no training run ({CONFIG_FILE} is missing)") from error
    config = as_object(content.get("config"), f"{run / CONFIG_FILE}: config")
    if "env_id" not in config and "data" not in config:
        raise UserError(f"{run / CONFIG_FILE} is the config of neither train_policy.py nor predictor.train")
    return "env_id" in config


def main() -> None:
    """Runs the command."""
    Console().print(f"report: {write_report(parse(ReportConfig, __doc__))}", soft_wrap=True)


if __name__ == "__main__":
    run_entry_point(main)
