"""Runs trials at each commanded speed, and computes the metrics of each speed."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from kslc_jax import physics
from kslc_jax.evaluation import gait_metrics, trials
from kslc_jax.evaluation.tables import Row
from kslc_jax.evaluation.trials import Setting, Trace
from kslc_jax.policy import Policy
from kslc_jax.robot import Robot

MOST_SAMPLES = 2_000_000
"""Largest number of control steps, over all trials, in memory at once. Each takes about 300 bytes.
"""

Describe = Callable[[Trace, float, Robot, float], dict[str, float]]
"""(trace, command [m/s], robot, control step [s]) -> metrics by name."""


def measure(
    policy: Policy,
    setting: Setting,
    speeds: Sequence[float],
    seeds: int,
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
    describe: Describe | None = None,
    vy: float = 0.0,
    yaw_rate: float = 0.0,
) -> list[Row]:
    """One row of metrics per commanded forward speed [m/s], over `seeds` trials each.

    Args:
      policy: acts deterministically.
      setting: conditions.
      speeds: commanded forward speeds [m/s].
      seeds: trials per command.
      seed: seed of initial states and randomisation.
      progress: called with the share [] that is done.
      describe: computes the metrics of a trace; the default is `gait_metrics.summary`.
      vy, yaw_rate: commanded together with every speed, positive to the left [m/s, rad/s].
    """
    describe = describe or gait_metrics.summary
    robot, dt = physics.robot_for(setting.physics), setting.physics.control_dt
    at_once = max(1, MOST_SAMPLES // (seeds * round(setting.seconds / dt)))
    rows = []
    for start in range(0, len(speeds), at_once):
        group = speeds[start : start + at_once]
        velocities = np.array([(speed, vy, yaw_rate) for speed in group for _ in range(seeds)])
        pieces = []
        for piece in trials.run(policy, setting, velocities, seed):
            pieces.append(piece)
            done = len(pieces) / round(setting.seconds)
            progress((start + done * len(group)) / len(speeds))
        for i, speed in enumerate(group):
            mine = slice(i * seeds, (i + 1) * seeds)
            part = [jax.tree.map(lambda x, mine=mine: x[:, mine], piece) for piece in pieces]
            numbers = describe(trials.join(part), speed, robot, dt)
            rows.append({"command": speed} | numbers)
    return rows
