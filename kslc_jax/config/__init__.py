"""All settings that a user may change: frozen, checked dataclasses, and the named presets.

It imports no JAX, so a program can read, check and print a config before JAX starts.
`rewards.weights` has one field per reward term of `kslc_jax.rewards.TERMS`.

Sources: "paper" is Zhang et al., KSLC (Tables I and II, Eq. 2 to 10). "HG" is Humanoid-Gym: the
paper builds on it, and it decides what the paper leaves open. docs/fidelity.md,
docs/fidelity_physics.md and docs/laptop_recipe.md explain each departure from them.
"""

from kslc_jax.config.checks import COUNTER, ConfigError, Range, require_seed
from kslc_jax.config.env import (
    MOST_INSET,
    CommandConfig,
    EnvConfig,
    GaitConfig,
    RandomizeConfig,
)
from kslc_jax.config.learning import CurriculumConfig, NetworkConfig, PPOConfig, RunConfig
from kslc_jax.config.options import options
from kslc_jax.config.physics import (
    GROUNDS,
    XBOT_L,
    Cone,
    Fidelity,
    HighFidelity,
    PhysicsConfig,
    TerrainConfig,
)
from kslc_jax.config.presets import ABLATIONS, PRESETS, preset
from kslc_jax.config.rewards import RewardConfig, RewardWeights
from kslc_jax.config.schema import Config
from kslc_jax.config.storage import (
    ROBOT_FOLDER,
    SCHEMA_VERSION,
    find_robot,
    from_dict,
    is_description,
    to_dict,
)

__all__ = [
    "ABLATIONS",
    "COUNTER",
    "GROUNDS",
    "MOST_INSET",
    "PRESETS",
    "ROBOT_FOLDER",
    "SCHEMA_VERSION",
    "XBOT_L",
    "CommandConfig",
    "Cone",
    "Config",
    "ConfigError",
    "CurriculumConfig",
    "EnvConfig",
    "Fidelity",
    "GaitConfig",
    "HighFidelity",
    "NetworkConfig",
    "PPOConfig",
    "PhysicsConfig",
    "RandomizeConfig",
    "Range",
    "RewardConfig",
    "RewardWeights",
    "RunConfig",
    "TerrainConfig",
    "find_robot",
    "from_dict",
    "is_description",
    "options",
    "preset",
    "require_seed",
    "to_dict",
]
