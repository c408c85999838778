"""MetaDrive 0.4.3 with one ego: its environment for these commands, and who is on the road.

pip install metadrive-simulator==0.4.3. MetaDrive fetches its models at the first start (docs/worked_examples.md).
"""

from typing import Any

import gymnasium as gym
import numpy as np
from metadrive import MetaDriveEnv

from dgvae_rl import FunctionReader, Scene, SceneSpec, agent_ids, register_reader

SCENARIOS = 9973  # with this number, seeds of collection, evaluation and test are different scenarios
STEPS_OF_PHYSICS = 10  # of 0.02 s each


class Road(MetaDriveEnv):
    """MetaDrive as Gymnasium asks for it: any seed is a scenario, and reset takes options."""

    def __init__(self, render_mode: str | None = None, **config: Any) -> None:
        """Set what differs from MetaDrive's own settings."""
        ours = {"num_scenarios": SCENARIOS, "store_map": False, "decision_repeat": STEPS_OF_PHYSICS, "horizon": 150}
        super().__init__({**ours, "traffic_mode": "respawn", "traffic_density": 0.2, "log_level": 50, **config})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin the scenario of a seed; without a seed, MetaDrive draws one."""
        return super().reset(seed=None if seed is None else seed % SCENARIOS)


def read_road(env: gym.Env) -> Scene:
    """The ego, then the other vehicles; MetaDrive gives them names."""
    road = env.unwrapped
    ego, others = road.agent, road.engine.traffic_manager.vehicles
    vehicles = [ego, *(vehicle for vehicle in others if vehicle is not ego)]
    states = np.array([[*vehicle.position, *vehicle.velocity] for vehicle in vehicles])
    names = agent_ids([vehicle.name for vehicle in vehicles])
    return Scene(states, names, np.ones(len(vehicles), dtype=bool), float(ego.heading_theta))


SPEC = SceneSpec(dt_s=0.02 * STEPS_OF_PHYSICS, frame=("ego", "ego"), perception_m=50.0, max_agents=10)
register_reader(Road, FunctionReader(read_road, SPEC), crash_key="crash", success_key="arrive_dest")
gym.register("MetaDriveRoad-v0", "metadrive_reader:Road")
