"""Makes a reader of a plain function, `FunctionReader(read, spec)`: for environments that number their agents."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from envs.readers.base import Reader, perceive, require_scene
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError
from predictor.support.signatures import takes


@dataclass(frozen=True)
class FunctionReader:
    """Makes readers of a function that reports all agents; the ego's perception is applied as for every reader.

        >>> import numpy as np
        >>> from envs import ForecastObservation, make_env
        >>> def read_cars(env) -> Scene:
        ...     cars = env.unwrapped.road.vehicles  # the ego is the first
        ...     states = np.array([[*car.position, *car.velocity] for car in cars])
        ...     return Scene(states, np.arange(len(cars)), np.ones(len(cars), dtype=bool))  # none enters or leaves
        >>> reader = FunctionReader(read_cars, SceneSpec(dt_s=1.0))
        >>> env = ForecastObservation(make_env("highway-fast-v0"), "highway", reader=reader)

    After `register_reader(MyEnv, reader)` no wrapper and no command needs `reader=` for environments of that class.

    It can be pickled, for environments in processes of their own, if the function can be: one defined at the top of a
    module.
    """

    read: Callable[[Any], Scene]
    """Function of the environment (wrapped; `env.unwrapped` is the simulator) that returns all its agents: ego first,
    any number of them, each with an id that does not change."""
    spec: SceneSpec
    """Layout of the scenes; `dt_s` has no default."""

    def __post_init__(self) -> None:
        """Checks that a function and a spec were given."""
        if not callable(self.read) or not isinstance(self.spec, SceneSpec):
            raise UserError(
                "FunctionReader needs a function read(env) -> Scene and a SceneSpec, got "
                f"{type(self.read).__name__} and {type(self.spec).__name__}"
            )
        if not takes(self.read, None):
            name = getattr(self.read, "__name__", type(self.read).__name__)
            raise UserError(f"{name} must take the environment and nothing else: define {name}(env) -> Scene")

    def __call__(self, env: Any) -> Reader:
        """Returns a reader for this environment."""
        return _Reading(self)


class _Reading(Reader):
    def __init__(self, config: FunctionReader) -> None:
        super().__init__(config.spec)
        self._read = config.read
        self._name = getattr(config.read, "__name__", type(config.read).__name__)

    def read_all(self, env: Any) -> Scene:
        return require_scene(self._read(env), self._name)

    def read(self, env: Any) -> Scene:
        return perceive(self.read_all(env), self.spec, self._name)
