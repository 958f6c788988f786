"""Benchmarks. Run python -m benchmarks.NAME --help in the root of the repository.

| module | measures |
| --- | --- |
| `throughput` | steps/s of a whole train step, of the rollout, and of physics alone |
| `comparison` | whole trainings: ours, Brax, PureJaxRL's loop, rsl_rl on torch |
| `parts` | time of each part of a train step |
| `compile_time` | time of a first start and of a later start |
| `memory` | peak memory and speed over environments and frames |
| `gpu` | `throughput` of several sizes and precisions on an accelerator, in one run |
| `gpu --all` | five seeds in one program, `paper`, larger batches, Brax, bit-exactness |
| `lent_gpu` | no measurement: it trains for a limited time and copies the runs into a few files |
| `start_test`, `kill_test` | reliability, not speed: many starts, many kills |

Each prints its results. The first five store the numbers with `--json`, and `gpu` with `--out`.
"""

from kslc_jax import runtime

runtime.prepare(gl=False)
