"""Speed, measured: python -m benchmarks.NAME --help, from the repository's root.

| module | what it measures |
| --- | --- |
| `throughput` | a whole train step, and the physics ceiling above it |
| `comparison` | whole trainings: ours, Brax, PureJaxRL's loop, rsl_rl on torch |
| `parts` | where the time of a train step goes |
| `compile_time` | first start and later starts |
| `memory` | peak memory and speed over environments and frames |
| `gpu` | `throughput` of several sizes and precisions on an accelerator, in one go |
| `start_test`, `kill_test` | not speed: hundreds of starts, hundreds of kills |

Each prints a table, and the first five keep the numbers with `--json`.
"""

from kslc_jax import runtime

runtime.prepare(gl=False)
