"""Does a policy survive another simulator? python -m kslc_jax.sim2sim POLICY [--perturb all]

Sweeps commanded forward speeds x seeds with the deterministic policy in full C MuJoCo (1 ms, PD
torque at every step, elliptic cones, converged solver, self-collision, joint friction) or, with
--engine drake, in Drake, whose contact model and solver are its own. Prints the table of
kslc_jax.evaluate; --perturb repeats the sweep on a changed robot or ground. How to read it:
docs/sim2sim.md.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.

Examples:
  python -m kslc_jax.sim2sim runs/laptop-seed0
  python -m kslc_jax.sim2sim runs/laptop-seed0 --noise --latency --perturb all --json out.json
  python -m kslc_jax.sim2sim runs/laptop-seed0 --perturb friction=0.2 payload=8 --speeds 1 2
  python -m kslc_jax.sim2sim runs/laptop-seed0 --speeds -0.3 0 0.5 --turn 1
  python -m kslc_jax.sim2sim runs/laptop-seed0 --engine drake --seconds 20 --seeds 2
"""

import dataclasses
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro
from rich.progress import Progress
from rich.table import Table

from kslc_jax import cli, evaluate, files
from kslc_jax.config import ConfigError, HighFidelity, RandomizeConfig, require_seed
from kslc_jax.errors import MissingPackage
from kslc_jax.evaluation import tables
from kslc_jax.evaluation.tables import Row

if TYPE_CHECKING:
    from kslc_jax.evaluation.trials import Setting
    from kslc_jax.policy import Policy

Engine = Literal["mujoco", "drake"]

PUSH_SECONDS = 4.0
"""Time between pushes."""

PERTURBATIONS: dict[str, Callable[[float], dict[str, Any]]] = {
    "friction": lambda mu: {"friction": (mu, mu), "ground_friction": mu},
    "payload": lambda kg: {"base_mass": (kg, kg)},
    "com": lambda metres: {"base_com": (metres, metres)},
    "push": lambda speed: {
        "push_seconds": PUSH_SECONDS,
        "push_velocity": speed,
        "push_angular": 0.0,
    },
    "gains": lambda factor: {"kp": (factor, factor), "kd": (factor, factor)},
    "strength": lambda factor: {"motor_strength": (factor, factor)},
    "imu": lambda angle: {"imu_offset": (angle, angle)},
}
"""Name -> changes of RandomizeConfig or trials.Setting for a value."""

ALL = (
    *("friction=0.3", "friction=0.6", "friction=1.5"),
    *("payload=-5", "payload=5", "com=-0.02", "com=0.02", "push=0.5"),
    *("gains=0.85", "gains=1.15", "strength=0.9", "imu=0.03"),
)
"""What `--perturb all` runs."""


@dataclass(frozen=True)
class Args:
    """What to try, and under what conditions."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    engine: Engine = "mujoco"
    """mujoco: C MuJoCo on all cores. drake: one robot at a time, slow, and needs the package drake
    (pip install 'kslc_jax[drake]')."""
    speeds: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    """Commanded forward speeds [m/s]."""
    sideways: float = 0.0
    """Side step commanded with every speed [m/s], to the left."""
    turn: float = 0.0
    """Yaw rate commanded with every speed [rad/s], to the left; 0 keeps the heading."""
    seeds: int = 32
    """Trials per speed."""
    seconds: float = 60.0
    """Length of a trial."""
    noise: bool = False
    """Sensor noise, action delay and action noise, the most that training has."""
    latency: bool = False
    """Every action comes one control step late."""
    perturb: tuple[str, ...] = ()
    """Repeat the sweep with each of these: friction=MU, payload=KG on the base, com=M (the base's
    centre of mass forwards, to the left and up), push=M/S (largest push along x and y, every 4 s),
    gains=FACTOR on kp and kd, strength=FACTOR on the motors' torque, imu=RAD (constant error of
    roll and pitch); all: a list of twelve."""
    seed: int = 0
    """Of initial states."""
    json: Path | None = None
    """Where to keep the numbers."""

    def __post_init__(self):
        evaluate.check(self.speeds, self.seeds, self.seconds)
        require_seed(self.seed)
        if not all(map(math.isfinite, (self.sideways, self.turn))):
            raise ConfigError("sideways and turn must be finite")
        for name in self.conditions:
            changes(name)

    @property
    def conditions(self) -> tuple[str, ...]:
        """What to run, the unperturbed robot first."""
        asked = (c for name in self.perturb for c in (ALL if name == "all" else (name,)))
        return tuple(dict.fromkeys(("nominal", *asked)))


def changes(condition: str) -> dict[str, Any]:
    """What 'nominal' or a perturbation such as 'payload=5' changes; ConfigError if unknown."""
    if condition == "nominal":
        return {}
    name, _, value = condition.partition("=")
    try:
        if not math.isfinite(float(value)):
            raise ValueError
        made = PERTURBATIONS[name](float(value))
        RandomizeConfig(**{k: v for k, v in made.items() if k in _ROBOT})
    except (KeyError, ValueError):
        known = ", ".join(f"{name}=X" for name in PERTURBATIONS)
        raise ConfigError(f"perturb: cannot read {condition!r} (known: {known}, all)") from None
    return made


_ROBOT = {f.name for f in dataclasses.fields(RandomizeConfig)}


def simulator(engine: Engine):
    """What steps `trials.Setting`s in that engine: None for MuJoCo, which is what their physics
    config says; MissingPackage where it is not installed."""
    if engine == "mujoco":
        return None
    try:
        from kslc_jax.evaluation import drake
    except ImportError as error:
        raise MissingPackage(f"{error}; try: pip install 'kslc_jax[drake]'") from error
    return drake.step


def setting(args: Args, condition: str) -> "Setting":
    """The conditions of one sweep."""
    from kslc_jax.evaluation import trials

    made = changes(condition)
    robot = {name: value for name, value in made.items() if name in _ROBOT}
    rest = {name: value for name, value in made.items() if name not in _ROBOT}
    return trials.Setting(
        HighFidelity(),
        randomize=dataclasses.replace(trials.NOMINAL, **robot),
        seconds=args.seconds,
        noise=args.noise,
        latency=args.latency,
        simulate=simulator(args.engine),
        **rest,
    )


Results = dict[str, list[Row]]


def sweeps(
    args: Args,
    policy: "Policy",
    progress: Callable[[str, float], None] = lambda condition, share: None,
) -> Results:
    """Rows of `measure` for every condition; `progress` is told where it is."""
    from kslc_jax.evaluation.measure import measure

    return {
        condition: measure(
            policy,
            setting(args, condition),
            args.speeds,
            args.seeds,
            args.seed,
            lambda share, condition=condition: progress(condition, share),
            vy=args.sideways,
            yaw_rate=args.turn,
        )
        for condition in args.conditions
    }


def summary(results: Results, title: str) -> Table:
    """Survival and mean speed of every condition and commanded speed."""
    out = Table(title=title, title_justify="left")
    out.add_column("survived, mean vx [m/s]")
    for row in results["nominal"]:
        out.add_column(f"{row['command']:.1f}", justify="right")
    for condition, rows in results.items():
        cells = [f"{row['survival']:.0%} {row['forward_mean']:.2f}" for row in rows]
        out.add_row(condition, *cells)
    return out


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _report(cli.parse("sim2sim", Args, argv, __doc__)))


def _report(args: Args) -> None:
    """Tries the policy under all conditions, prints the tables, keeps the numbers."""
    simulator(args.engine)  # what is not installed is told before anything is loaded
    from kslc_jax.policy import load_policy, policy_name

    files.require_writable(args.json)
    policy = load_policy(args.policy)
    screen = tables.console()
    # Reports come once a simulated second: the estimate of the time left needs a long memory.
    with Progress(console=screen, transient=True, speed_estimate_period=600) as bar:
        tasks = {name: bar.add_task(name, total=1.0, start=False) for name in args.conditions}

        def progress(condition: str, share: float) -> None:
            bar.start_task(tasks[condition])
            bar.update(tasks[condition], completed=share)

        results = sweeps(args, policy, progress)
    title = f"{args.policy}, train step {policy.step}, {args.engine}"
    columns = tables.HEADLINE
    if args.sideways or args.turn:
        title += f", with {args.sideways:g} m/s sideways and {args.turn:g} rad/s"
        columns = tables.SIDEWAYS_COLUMNS
    for condition, rows in results.items():
        screen.print(tables.table(rows, f"{title}, {condition}", columns))
    if len(results) > 1:
        screen.print(summary(results, title))
    if args.json is not None:
        what = {"policy": policy_name(args.policy), "step": policy.step}
        names = ("engine", "sideways", "turn", "seeds", "seconds", "noise", "latency", "seed")
        how = {name: getattr(args, name) for name in names}
        files.write_json(args.json, {**what, **how, "conditions": results})


if __name__ == "__main__":
    sys.exit(main())
