"""Train XBot-L to walk and run: python -m kslc_jax.train [--preset NAME] [--any.nested.field V]

Picks a preset, lets every field of it be overridden, and trains into a run folder that holds the
config, versions, metrics (JSONL and TensorBoard) and checkpoints. Ctrl-C saves and leaves;
--resume goes on bit for bit.

Examples:
  python -m kslc_jax.train                          # paper preset on a GPU, laptop preset without
  python -m kslc_jax.train --preset debug           # seconds, to see that everything works
  python -m kslc_jax.train --preset laptop --without arms --seed 1
  python -m kslc_jax.train --ppo.epochs 4 --env.num-envs 1024
  python -m kslc_jax.train --resume --run-dir runs/laptop-seed0
"""

import argparse
import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from kslc_jax import config as config_lib
from kslc_jax import runtime
from kslc_jax.config import Config, ConfigError


@dataclass(frozen=True)
class Args:
    """Command line of a training."""

    preset: str = "auto"
    """auto, paper, laptop, debug, baseline or baseline-laptop. auto is paper on an accelerator,
    laptop without one."""
    without: tuple[str, ...] = ()
    """What to leave out, for ablations: arms, angular-momentum, velocity-rewards,
    velocity-curriculum, cycle-curriculum."""
    run_dir: Path | None = None
    """Where everything goes; runs/PRESET-seedN if not given, with -no-PART for each ablation."""
    steps: int | None = None
    """Environment steps in all; short for --run.steps."""
    resume: bool = False
    """Go on from the run folder's latest checkpoint."""
    start_from: Path | None = None
    """Begin a new training with this policy's networks and curriculum: a run folder, a checkpoint
    folder, or the name of a shipped policy. A lower --ppo.learning-rate keeps what it can do."""
    config: Annotated[Config, tyro.conf.arg(name="")] = config_lib.PRESETS["laptop"]
    """Every number of the training, as the preset has it."""


def parse(argv: list[str]) -> Args:
    """Args, with `config` made of preset or stored config, ablations and overrides; ConfigError."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="auto")
    early.add_argument("--without", nargs="*", default=[])
    early.add_argument("--run-dir", "--run_dir", type=Path)
    early.add_argument("--resume", action="store_true")
    known, _ = early.parse_known_args(argv)
    helping = "-h" in argv or "--help" in argv
    if known.resume and known.run_dir is None and not helping:
        raise ConfigError("--resume needs --run-dir, the folder of the training to go on with")
    if known.resume and not helping and known.preset == "auto" and not known.without:
        from kslc_jax import runner

        base = runner.read_config(known.run_dir)
    else:  # also on resume: the runner names what the stored config has otherwise
        name = known.preset
        if name == "auto":
            name = "laptop" if helping else runtime.auto_preset()
        base = config_lib.preset(name, tuple(known.without))
    args = tyro.cli(Args, args=argv, default=Args(config=base), description=__doc__)
    if args.resume and args.start_from:
        raise ConfigError("--resume goes on with a run, --start-from begins one: take one of them")
    config = args.config
    if args.steps is not None:
        config = dataclasses.replace(config, run=dataclasses.replace(config.run, steps=args.steps))
    return dataclasses.replace(args, config=config)


def headline(args: Args) -> tuple[str, Path]:
    """What is about to run, in a few words, and its run folder."""
    if args.resume and args.run_dir is not None:
        return "resuming", args.run_dir
    name, why = args.preset, ""
    if name == "auto":
        name = runtime.auto_preset()
        why = f" (auto: {'an' if name == 'paper' else 'no'} accelerator)"
    name = "-no-".join([name, *args.without])
    folder = args.run_dir or Path("runs") / f"{name}-seed{args.config.seed}"
    return f"preset {name}{why}", folder


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    runtime.prepare()
    try:
        args = parse(argv)
        runtime.require_good_jax()
        from kslc_jax import runner
        from kslc_jax.checkpoint import CheckpointError
        from kslc_jax.logs import Progress
        from kslc_jax.recovery import NumbersError
    except (ConfigError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    title, run_dir = headline(args)
    progress = Progress(args.config)
    progress.say(f"{title}: {runner.describe(args.config, run_dir)}")
    try:
        runner.train(args.config, run_dir, args.resume, progress, args.start_from)
    except (ConfigError, runner.RunError, CheckpointError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except NumbersError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted before the state was saved", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
