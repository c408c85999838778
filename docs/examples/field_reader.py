"""All that the field needs to be read: every runner in one scene. Importing this registers it."""

import numpy as np
from field_env import DT_S, RUNNERS, FieldEnv

from envs.readers import MultiagentScene, pad_multiagent_scene, register_reader
from predictor.scene import Scene, SceneSpec


class FieldReader:
    """The runners in the order of their names; each looks where it runs."""

    def __init__(self, env):
        """Say what a scene holds."""
        self.spec = SceneSpec(
            dt_s=DT_S, feature_scales=(10.0, 10.0, 2.0, 2.0), has_ego=False, perception_m=20.0, max_agents=RUNNERS
        )

    def reset(self):
        """Forget nothing: runners have names."""

    def read(self, env) -> MultiagentScene:
        """Return all runners, and at which index each one is."""
        bodies = env.unwrapped.bodies
        states = np.array(list(bodies.values()))  # x, y, vx, vy
        scene = Scene(states, np.arange(len(states)), np.ones(len(states), dtype=bool))
        index_of = {name: i for i, name in enumerate(bodies)}
        return pad_multiagent_scene(scene, index_of, np.arctan2(states[:, 3], states[:, 2]), self.spec)


register_reader(FieldEnv, FieldReader)


def make_field(**kwargs) -> FieldEnv:
    """Makes the environment, for commands: --env-id field_reader:make_field."""
    return FieldEnv(**kwargs)
