"""Settings of the physics: which robot, engine and ground, and how exactly they are simulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from kslc_jax.config.checks import require

Fidelity = Literal["train", "high"]
Cone = Literal["pyramidal", "elliptic"]

XBOT_L = "xbot_l"
"""The robot of the paper. Presets are made for it."""


@dataclass(frozen=True)
class TerrainConfig:
    """Uneven ground. All sizes 0, the default: the flat floor.

    Every episode draws one kind among those whose size is not 0, its size, and its direction
    (kslc_jax/ground.py)."""

    rough: float = 0.0
    """Largest height of random waves [m], up and down."""
    slope: float = 0.0
    """Largest inclination of a plane [degrees]."""
    stairs: float = 0.0
    """Largest height of a stair's step [m]."""
    flat: float = 0.2
    """Share of episodes on flat ground."""
    least: float = 0.0
    """Smallest size that an episode draws, as a share of the largest one. 1: always the largest."""
    full_from: float = 0.0
    """Sizes grow with the curriculum's v_max, and have their full range from this v_max [m/s] on.
    0: from the start."""
    critic_sees: bool = True
    """True: the critic's frame has the ground below the feet and its slope. The actor's frame never
    has them. False: both networks have the shapes of a training on the flat floor
    (--start-from)."""

    def __post_init__(self):
        require(0 <= self.rough <= 0.5, "physics.terrain.rough must lie in [0, 0.5] m")
        require(0 <= self.slope <= 30, "physics.terrain.slope must lie in [0, 30] degrees")
        require(0 <= self.stairs <= 0.3, "physics.terrain.stairs must lie in [0, 0.3] m")
        require(0 <= self.flat < 1, "physics.terrain.flat must lie in [0, 1)")
        require(0 <= self.least <= 1, "physics.terrain.least must lie in [0, 1]")
        require(self.full_from >= 0, "physics.terrain.full_from must not be negative")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the kinds of uneven ground whose size is not 0."""
        return tuple(kind for kind in GROUNDS if getattr(self, kind))

    @property
    def fixed(self) -> bool:
        """True if all episodes have ground of one kind and one size."""
        return len(self.kinds) == 1 and self.flat == 0 and self.least == 1 and not self.full_from


GROUNDS = ("rough", "slope", "stairs")
"""Kinds of uneven ground: fields of `TerrainConfig`."""


@dataclass(frozen=True)
class PhysicsConfig:
    """Simulation of one control step."""

    fidelity: ClassVar[Fidelity] = "train"

    robot: str = XBOT_L
    """Name of a shipped robot, or path of the description of another one (docs/own_robot.md)."""
    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """mjx: pure XLA, any device. mujoco: C MuJoCo on the CPU cores, called back from JAX; faster on
    a CPU (docs/performance.md). auto: mjx if JAX has an accelerator, else mujoco."""
    timestep: float = 0.005
    """Physics step [s]. The PD torque is recomputed at each one."""
    decimation: int = 2
    """Physics steps per control step."""
    iterations: int = 4
    """Newton iterations of the contact solver. With fewer than 4, joints of XBot-L without rotor
    inertia blow up (docs/fidelity_physics.md)."""
    ls_iterations: int = 5
    """Line-search iterations of the contact solver. In elliptic cones mjx takes a quarter of them,
    but at least 5."""
    cone: Cone = "pyramidal"
    """Shape of the friction cone. An elliptic cone has the same friction in all directions. A
    pyramid has only 0.71 of it at 45 degrees, so robots slip sooner (docs/fidelity_physics.md).
    Elliptic cones need about 20 line-search iterations."""
    threads: int = 0
    """CPU threads of the mujoco engine; 0: all CPUs that this process may use. Does not change
    results."""
    terrain: TerrainConfig = TerrainConfig()

    def __post_init__(self):
        require(self.timestep > 0, "physics.timestep must be positive")
        require(self.decimation >= 1, "physics.decimation must be at least 1")
        require(self.iterations >= 1, "physics.iterations must be at least 1")
        require(self.ls_iterations >= 1, "physics.ls_iterations must be at least 1")
        require(0 <= self.threads <= 1024, "physics.threads must lie in [0, 1024]; 0: all cores")

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.timestep * self.decimation

    @property
    def uneven(self) -> TerrainConfig | None:
        """The terrain; None if it is the flat floor."""
        return self.terrain if self.terrain.kinds else None


@dataclass(frozen=True)
class HighFidelity(PhysicsConfig):
    """Physics of evaluation: C MuJoCo, 1 ms, converged solver, model of robot.load("high")."""

    fidelity: ClassVar[Fidelity] = "high"

    engine: Literal["auto", "mjx", "mujoco"] = "mujoco"
    timestep: float = 0.001
    decimation: int = 10
    iterations: int = 100
    ls_iterations: int = 50
    cone: Cone = "elliptic"

    def __post_init__(self):
        super().__post_init__()
        require(self.engine == "mujoco", "high fidelity needs physics.engine mujoco")
        require(
            self.terrain.fixed or not self.terrain.kinds,
            "high fidelity has one height field: physics.terrain needs one kind, flat 0, least 1, "
            "full_from 0",
        )
