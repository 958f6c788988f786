"""Does a start ever hang? Starts many processes, one after the other, and counts those that do.

Each compiles and runs a short rollout, policy and physics of 256 robots for 100 control steps, with
the mujoco engine on one thread and on two, and with mjx. What has hung on some JAX versions, two
batched Cholesky factorisations waiting for each other and a callback waiting for the program that
waits for it, needs no more than that. Exit code 1 if one hangs or fails.

  python -m benchmarks.start_test [--starts 200]
"""

import faulthandler
import subprocess
import sys
import time
from collections import Counter
from typing import Literal

import tyro

Engine = Literal["mujoco", "mjx"]

KINDS: tuple[tuple[Engine, int], ...] = (("mujoco", 1), ("mujoco", 2), ("mjx", 1), ("mjx", 2))
"""Engine, and how many threads: of C MuJoCo's batch, or of all that XLA runs on."""

LIMIT = 300.0
"""Seconds after which a start counts as hung; the longest compile here is a tenth of that."""

ROBOTS, STEPS = 256, 100


def rollout(engine: Engine, threads: int) -> None:
    """What one start does."""
    from kslc_jax import runtime

    runtime.prepare()
    faulthandler.dump_traceback_later(0.9 * LIMIT)
    import jax
    import jax.numpy as jnp

    from kslc_jax import config, curriculum, env, networks, physics

    cfg = config.preset("debug")
    simulator = config.PhysicsConfig(engine=engine, threads=threads)

    @jax.jit
    def run(key: jax.Array) -> jax.Array:
        params = networks.init(cfg, key)
        keys = jax.random.split(key, ROBOTS)
        robots = jax.vmap(env.reset, (None, 0, None))(cfg, keys, curriculum.init(cfg))
        target = cfg.env.action_scale * networks.policy(cfg, params, robots.history).mean
        step = jax.vmap(physics.step, (None, 0, 0, 0, None))

        def one(state: physics.PhysicsState, _: None) -> tuple[physics.PhysicsState, None]:
            return step(simulator, state, target, robots.dynamics, 0.6), None

        return jax.lax.scan(one, robots.physics, length=STEPS)[0].qpos

    if not bool(jnp.all(jnp.isfinite(run(jax.random.key(0))))):
        sys.exit("numbers that are not finite")


def start(engine: Engine, threads: int) -> str:
    """Starts one process; 'ok', 'hung' or 'failed'."""
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
    """Prints how the starts ended; 1 if any did not end well.

    Args:
      starts: how many processes, a quarter of each kind.
      once: engine and threads: be one of those processes.
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
