"""Starts many processes, one after the other, and counts those that hang.

Each process compiles and runs the physics of 256 robots for 100 control steps, with one action of a
policy. It uses the mujoco engine on one thread and on two, or mjx on one CPU core and on all. This
is enough to find two hangs of some JAX versions: two batched Cholesky factorisations that wait for
each other, and a callback that waits for the program that waits for it. The exit code is 1 if a
process hangs or fails.

  python -m benchmarks.start_test [--starts 200]
"""

import dataclasses
import faulthandler
import subprocess
import sys
import time
from collections import Counter
from typing import Literal

import tyro

Engine = Literal["mujoco", "mjx"]

KINDS: tuple[tuple[Engine, int], ...] = (("mujoco", 1), ("mujoco", 2), ("mjx", 1), ("mjx", 2))
"""Engine, and number of threads of C MuJoCo's batch. For mjx, 1 means one CPU core and 2 all."""

LIMIT = 300.0
"""Seconds after which a start counts as hung. The longest compilation takes a tenth of this."""

ROBOTS, STEPS = 256, 100


def rollout(engine: Engine, threads: int) -> None:
    """The work of one start; exits with an error if a number is not finite."""
    from kslc_jax import runtime

    runtime.prepare()
    faulthandler.dump_traceback_later(0.9 * LIMIT)
    import jax
    import jax.numpy as jnp

    from kslc_jax import config, curriculum, env, motors, networks, physics

    cfg = config.preset("debug")
    simulator = dataclasses.replace(cfg.physics, engine=engine, threads=threads)

    @jax.jit
    def run(key: jax.Array) -> jax.Array:
        params = networks.init(cfg, key)
        keys = jax.random.split(key, ROBOTS)
        robots = jax.vmap(env.reset, (None, 0, None))(cfg, keys, curriculum.init(cfg))
        scale = motors.action_scale(cfg.env, physics.robot_for(simulator))
        target = networks.policy(cfg, params, robots.history).mean * scale
        step = jax.vmap(physics.step, (None, 0, 0, 0, None))

        def one(state: physics.PhysicsState, _: None) -> tuple[physics.PhysicsState, None]:
            return step(simulator, state, target, robots.dynamics, 0.6), None

        return jax.lax.scan(one, robots.physics, length=STEPS)[0].qpos

    if not bool(jnp.all(jnp.isfinite(run(jax.random.key(0))))):
        sys.exit("numbers that are not finite")


def start(engine: Engine, threads: int) -> str:
    """Starts one process; returns 'ok', 'hung' or 'failed'."""
    command = [sys.executable, "-m", "benchmarks.start_test", "--once", engine, str(threads)]
    if engine == "mjx" and threads == 1:
        command = ["taskset", "--cpu-list", "0", *command]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired as error:
        print(error.stderr, file=sys.stderr)
        return "hung"
    if done.returncode:
        print(done.stderr[-2000:], file=sys.stderr)
    return "failed" if done.returncode else "ok"


def main(starts: int = 200, once: tuple[Engine, int] | None = None) -> int:
    """Prints how the starts ended; returns 1 if any hung or failed.

    Args:
      starts: number of processes, a quarter of each kind.
      once: engine and threads; do the work of one such process here.
    """
    if once is not None:
        rollout(*once)
        return 0
    began, ends = time.monotonic(), Counter()
    for i in range(starts):
        kind = KINDS[i % len(KINDS)]
        ends[kind, start(*kind)] += 1
        if (i + 1) % 20 == 0:
            print(f"{i + 1} starts, {time.monotonic() - began:.0f} s", flush=True)
    for ((engine, threads), end), count in sorted(ends.items()):
        print(f"{engine}, {threads} thread{'s' * (threads > 1)}: {count} {end}")
    return int(any(end != "ok" for _, end in ends))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
