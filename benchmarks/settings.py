"""Settings of a run of the benchmarks, and the list of sections."""

from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym

from envs.registry import checkpoint_for, envpool_task_of, make_env
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError
from predictor.support.files import check_out_file

SECTIONS: dict[str, str] = {
    "machine": "benchmarks.machine",
    "forecast": "benchmarks.forecast",
    "streaming": "benchmarks.streaming",
    "training": "benchmarks.training",
    "wrappers": "benchmarks.environments",
    "ppo": "benchmarks.ppo",
    "agents": "benchmarks.many_agents",
    "data": "benchmarks.reading",
    "reference": "benchmarks.reference",
}
"""Name of a section → its module, in the order in which they run."""


@dataclass(frozen=True)
class Settings:
    """Measures speed, prints one table, writes it as JSON and, if asked to, compares it with a baseline."""

    only: tuple[str, ...] = ()
    """Sections to run; none given runs all of them (machine, forecast, streaming, training, wrappers, ppo, agents,
    data, reference)."""
    quick: bool = False
    """Measure fewer shapes and repetitions: a minute or two instead of half an hour."""
    threads: int = 2
    """Number of CPU threads of torch."""
    reference: Path | None = None
    """Checkout of github.com/cgraber/cvpr_dNRI, whose model is timed beside ours."""
    env_id: str = "highway-fast-v0"
    """Environment for the wrappers and PPO; needs a shipped checkpoint and a copy in EnvPool."""
    out: Path = Path("runs/benchmarks.json")
    """JSON file for machine, versions and all lines."""
    baseline: Path | None = None
    """Baseline file to compare with; the exit status is 1 if anything got slower."""
    write_baseline: Path | None = None
    """Baseline file to write, with which later runs are compared."""

    @property
    def mode(self) -> str:
        """Mode of the run: "quick" or "full"."""
        return "quick" if self.quick else "full"

    @property
    def sections(self) -> tuple[str, ...]:
        """Names of the sections to run, in order; the reference only if its path is given."""
        chosen = self.only or tuple(SECTIONS)
        return tuple(s for s in SECTIONS if s in chosen and (s != "reference" or self.reference is not None))

    def __post_init__(self) -> None:
        """Checks names of sections and ranges.

        Raises:
            UserError: a value is out of range, or a section is unknown or lacks its option.
        """
        check_at_least(self, 1, "threads")
        unknown = [name for name in self.only if name not in SECTIONS]
        if unknown:
            raise UserError(f"there is no section {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
        if "reference" in self.only and self.reference is None:
            raise UserError("section reference needs --reference PATH, a checkout of github.com/cgraber/cvpr_dNRI")
        if self.only and self.write_baseline is not None:
            raise UserError("a baseline holds every section; leave --only out")

    def check_env(self) -> None:
        """Checks that the environment can be timed, if a section does.

        Raises:
            UserError: an unknown environment, or one without a checkpoint, a copy in EnvPool or discrete actions.
        """
        if not {"wrappers", "ppo"} & set(self.sections):
            return
        checkpoint_for(self.env_id)
        envpool_task_of(self.env_id)
        env = make_env(self.env_id)
        if not isinstance(env.action_space, gym.spaces.Discrete):
            raise UserError(f"blocks are of discrete actions, {self.env_id} has {env.action_space}; time another")
        env.close()

    def check_files(self) -> None:
        """Checks that the paths to write are no folders.

        Raises:
            UserError: one of them is a folder, or cannot be written.
        """
        for path in (self.out, self.write_baseline):
            check_out_file(path)
