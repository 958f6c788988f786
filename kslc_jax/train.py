"""Train a robot to walk and run: python -m kslc_jax.train [--preset NAME] [--any.nested.field V]

The config is a preset, and options override its fields. The run folder gets the config, versions,
metrics (JSONL and TensorBoard) and checkpoints. Ctrl-C saves and exits; --resume continues, on a
CPU bit for bit. The defaults below are those of the laptop preset. Name another --preset before
--help to see its defaults.

Examples:
  python -m kslc_jax.train                          # the laptop preset, on a GPU if there is one
  python -m kslc_jax.train --preset debug           # takes seconds: does everything work?
  python -m kslc_jax.train --robot unitree_g1       # another shipped robot, or my/robot.toml
  python -m kslc_jax.train --preset laptop --without arms --seed 1
  python -m kslc_jax.train --ppo.epochs 4 --env.num-envs 1024
  python -m kslc_jax.train --resume --run-dir runs/laptop-seed0
  python -m kslc_jax.train --seeds 5                # five seeds in one program, side by side
  python -m kslc_jax.train --profile 3              # trace the time of three train steps
  srun python -m kslc_jax.train --coordinator auto  # one training of all of Slurm's tasks
"""

import argparse
import contextlib
import dataclasses
import re
import sys
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from kslc_jax import cli, files, runtime
from kslc_jax import config as config_lib
from kslc_jax.config import COUNTER, XBOT_L, Config, ConfigError
from kslc_jax.errors import UserError

if TYPE_CHECKING:
    from jax.sharding import Mesh

DEFAULT = "laptop"
"""The preset of a training without --preset."""


@dataclass(frozen=True)
class Args:
    """Command line of a training."""

    preset: str = DEFAULT
    """paper, laptop, debug, baseline or baseline-laptop."""
    robot: str = XBOT_L
    """xbot_l, unitree_g1, unitree_h1, booster_t1, berkeley_humanoid, or the path of a description
    (docs/own_robot.md). The preset is scaled to the robot's size. The run folder keeps a copy of
    the robot."""
    without: tuple[str, ...] = ()
    """Parts of the method to leave out, for ablations: arms, angular-momentum, velocity-rewards,
    velocity-curriculum, cycle-curriculum."""
    run_dir: Path | None = None
    """Run folder. The default is runs/PRESET-seedN, with --seeds runs/PRESET-seedsM-N; another
    robot than xbot_l puts its name in front of PRESET, and each ablation adds -no-PART to it."""
    steps: int | None = None
    """Total environment steps, counted from the beginning of the run. You can write 60e6. Short for
    --run.steps."""
    resume: bool = False
    """Continue from the run folder's latest checkpoint."""
    start_from: Path | None = None
    """Begin a new training with the networks and the curriculum of this policy: a run folder, a
    checkpoint folder, or the name of a shipped policy. With a lower --ppo.learning-rate the policy
    keeps more of its skill."""
    seeds: int = 1
    """Number of trainings in one program, side by side on one device: of the seeds --seed,
    --seed + 1, ... Each has an ordinary run folder, RUN_DIR/seed-0 and so on. --resume --run-dir
    RUN_DIR goes on with all of them, --resume --run-dir RUN_DIR/seed-0 with one. A seed whose
    numbers go bad stops and is named; the others go on."""
    profile: int = 0
    """Trace this many train steps with the profiler, after the first one, into the run folder."""
    wandb: bool = False
    """Also send the records to Weights & Biases: pip install 'kslc_jax[wandb]'. Without an account,
    set the environment variable WANDB_MODE=offline."""
    devices: Literal["auto"] | int = "auto"
    """Number of devices of this process to train on. auto: as many accelerators as can share the
    environments evenly, or one CPU."""
    coordinator: str | None = None
    """Train with several processes: host:port at which process 0 can be reached. auto: Slurm, Open
    MPI, Kubernetes or a TPU pod gives it. All processes get the same command line, except for
    --process-index."""
    processes: int | None = None
    """Number of processes, with --coordinator host:port."""
    process_index: int | None = None
    """Index of this process, from 0. Process 0 writes the run folder and shows progress."""
    config: Annotated[Config, tyro.conf.arg(name="")] = config_lib.PRESETS[DEFAULT]
    """All other numbers of the training. The preset gives the defaults."""


def join(argv: list[str]) -> None:
    """Makes this process one of several if the command line says so; ConfigError if that fails.

    Call it before JAX does anything.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("coordinator", "processes", "process-index"):
        early.add_argument(f"--{name}", f"--{name.replace('-', '_')}", nargs="?", dest=name)
    known, _ = early.parse_known_args(argv)
    given = tuple(vars(known).values())
    if any(given) and not {"-h", "--help"} & set(argv):
        who = cluster(*given)
        from kslc_jax.training import devices

        devices.join(*who)


def cluster(
    coordinator: str | None, processes: str | None, index: str | None
) -> tuple[str | None, int | None, int | None]:
    """The arguments of `devices.join` from three options; ConfigError if these do not match."""
    if (coordinator, processes, index) == ("auto", None, None):
        return None, None, None
    counts = []
    for text in filter(None, (processes, index)):
        with contextlib.suppress(ValueError):
            counts.append(cli.whole_number(text))
    who = len(counts) == 2 and min(counts) >= 0
    if not (who and re.fullmatch(r"\S+:\d{1,5}", coordinator or "")):
        raise ConfigError(
            "several processes need --coordinator host:port, --processes N and --process-index I, "
            "or --coordinator auto alone"
        )
    if not counts[1] < counts[0]:
        last = counts[0] - 1
        raise ConfigError(f"--process-index: {counts[1]} is too large, it counts from 0 to {last}")
    return coordinator, counts[0], counts[1]


def preset_for(name: str, robot: str, without: tuple[str, ...] = ()) -> Config:
    """`similar.preset`. It loads MuJoCo only for another robot than XBot-L, so --help is quick."""
    if robot == XBOT_L:
        return config_lib.preset(name, without)
    from kslc_jax import similar

    return similar.preset(name, robot, without)


def parse(argv: list[str]) -> Args:
    """Reads the command line.

    `Args.config` is the preset with its ablations, or on a resume the stored config. Options
    override its fields.

    Raises:
      ConfigError: an option is wrong, or options exclude each other.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    # An option without its value is None here; `cli.parse` refuses it.
    early.add_argument("--preset", nargs="?")
    early.add_argument("--robot", nargs="?")
    early.add_argument("--without", nargs="*", default=[])
    early.add_argument("--run-dir", "--run_dir", nargs="?", type=Path)
    early.add_argument("--resume", action="store_true")
    known, _ = early.parse_known_args(argv)
    helping = "-h" in argv or "--help" in argv
    if known.resume and known.run_dir is None and not helping:
        raise ConfigError("--resume needs --run-dir, the folder of the training to go on with")
    fresh = known.preset is not None or known.robot is not None or known.without
    if known.resume and not helping and not fresh:
        from kslc_jax.training import run_folder

        there = files.seeds_in(known.run_dir)
        folder = files.seed_folder(known.run_dir, there[0]) if there else known.run_dir
        base = run_folder.read_config(folder)
    else:  # also on a resume with a preset: run_folder names the first field that differs
        name, robot = known.preset or DEFAULT, known.robot or XBOT_L
        base = preset_for(name, robot, tuple(known.without))
    args = cli.parse("train", Args, argv, __doc__, default=Args(config=base))
    if args.resume and args.start_from:
        raise ConfigError("--resume goes on with a run, --start-from begins one: take one of them")
    if args.profile < 0:
        raise ConfigError(f"--profile: {args.profile} train steps; 0 writes no trace")
    if args.resume and args.run_dir:
        args = dataclasses.replace(args, seeds=_seeds_there(args, args.run_dir))
    if args.seeds != 1:
        _require_alone(args)
    config = args.config
    if config.physics.robot != base.physics.robot:
        raise ConfigError(
            f"--physics.robot would keep numbers that are made for {base.physics.robot}: use "
            f"--robot {config.physics.robot}, which scales the preset to the robot"
        )
    if args.steps is not None:
        config = dataclasses.replace(config, run=dataclasses.replace(config.run, steps=args.steps))
    return dataclasses.replace(args, config=config)


def _seeds_there(args: Args, run_dir: Path) -> int:
    """Number of seeds in the folder of a resume; ConfigError if --seeds says another number."""
    there, first = files.seeds_in(run_dir), args.config.seed
    count = max(len(there), 1)
    if args.seeds not in (1, count):
        held = f"{len(there)} seeds" if there else "a training of one seed"
        raise ConfigError(f"--seeds: {run_dir} holds {held}, not {args.seeds} seeds")
    if there and there != [*range(first, first + count)]:
        raise ConfigError(
            f"{run_dir} holds the seeds {', '.join(map(str, there))}, not {count} in a row from "
            f"{first}: go on with each alone, --run-dir {files.seed_folder(run_dir, there[0])}"
        )
    return count


def _require_alone(args: Args) -> None:
    """ConfigError if an option cannot be combined with --seeds."""
    if args.seeds < 1 or args.config.seed + args.seeds > COUNTER:
        raise ConfigError("--seeds must be at least 1, and --seed + --seeds at most 2^31")
    excluded = {
        "--start-from": args.start_from is not None,
        "--profile": args.profile > 0,
        "--wandb": args.wandb,
        "--devices": args.devices not in ("auto", 1),
        "--coordinator": args.coordinator is not None,
    }
    for name, given in excluded.items():
        if given:
            raise ConfigError(f"--seeds trains on one device and excludes {name}: leave one out")


def headline(args: Args) -> tuple[str, Path]:
    """(title of the training, its run folder)."""
    if args.resume and args.run_dir is not None:
        return "resuming", args.run_dir
    name = "-no-".join([args.preset, *args.without])
    if args.robot != XBOT_L:
        name = f"{Path(args.robot).stem}-{name}"
    first = args.config.seed
    numbers = f"seed{first}" if args.seeds == 1 else f"seeds{first}-{first + args.seeds - 1}"
    folder = args.run_dir or Path("runs") / f"{name}-{numbers}"
    return f"preset {name}", folder


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code. Lost output is no failure: the run folder has it all."""
    return cli.run(lambda: _main(sys.argv[1:] if argv is None else argv), needs_output=False)


def _main(argv: list[str]) -> int:
    join(argv)
    args = parse(argv)
    if not threading.main_thread().is_alive():
        raise UserError("the program has ended: let it wait for the training, with thread.join()")
    runtime.require_good_jax()
    from kslc_jax.training import devices

    wanted = 1 if args.seeds > 1 else None if args.devices == "auto" else args.devices
    try:
        mesh = devices.pick(args.config, wanted)
    except RuntimeError as error:  # a backend that does not start
        raise UserError(str(error)) from error
    return _train(args, mesh)


def _train(args: Args, mesh: "Mesh | None") -> int:
    """Trains; returns the exit code. If one of several processes fails alone, it exits at once."""
    from rich.console import Console

    from kslc_jax.training import devices, loop, run_folder
    from kslc_jax.training.logs import Progress
    from kslc_jax.training.recovery import NumbersError
    from kslc_jax.training.seeds import SeedsProgress

    title, run_dir = headline(args)
    if args.resume:
        here = run_folder.circumstances(args.config, 1 if mesh is None else mesh.size, args.seeds)
        seeds = [files.seed_folder(run_dir, seed) for seed in files.seeds_in(run_dir)]
        news = (run_folder.what_changed(folder, here) for folder in seeds or [run_dir])
        title = " ".join([title, *dict.fromkeys(filter(None, news))])
    shown = SeedsProgress if args.seeds > 1 else Progress
    progress = shown(args.config, None if devices.is_first() else Console(quiet=True))
    progress.say(f"{title}: {loop.describe(args.config, run_dir, mesh, args.seeds)}")
    if idle := runtime.idle_gpu():
        progress.warn(idle)
    how = args.start_from, mesh, args.profile, args.wandb, args.seeds
    try:
        loop.train(args.config, run_dir, args.resume, progress, *how)
    except NumbersError as error:  # all processes raise it
        if devices.is_first():
            raise
        return error.exit_code
    except UserError:
        raise
    except (Exception, KeyboardInterrupt) as error:
        if not devices.several():
            raise
        traceback.print_exc()
        return devices.leave(130 if isinstance(error, KeyboardInterrupt) else 1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
