"""Puts a training into the package as a policy: python -m docs.ship RUN NAME

Writes the policy to kslc_jax/policies/NAME, and its training beside the pages: every third record
of its metrics, its curve, its versions. A policy with this name is replaced; its card stays, and
its old evaluation goes. Then `make results` tries the policy and writes the tables, and somebody
reads what the pages and the card say in words.

The median of the trained seeds ships, not the best: python -m kslc_jax.judge names it.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from kslc_jax import export, files, plots, records
from kslc_jax.policy import POLICIES
from kslc_jax.records import Records

TRAINING = Path(__file__).parent / "training"

EVERY = 3
"""One of so many records of the metrics is kept."""

CARD = "CARD.md"


def put_policy(run: Path, metrics: Records, folder: Path) -> None:
    """Replaces the policy in `folder` by the newest one of the run. The card stays."""
    with tempfile.TemporaryDirectory() as temporary:
        new = Path(temporary) / folder.name
        if export.main([str(run), str(new), "--format", "orbax"]):
            raise SystemExit(1)
        files.write_json(new / files.MILESTONES, records.milestone_steps(metrics))
        if (folder / CARD).exists():
            shutil.copy(folder / CARD, new)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(new, folder)


def put_training(run: Path, metrics: Records, stem: Path) -> None:
    """Writes the thinned metrics, the versions and the curve of a run beside `stem`."""
    out = stem.with_suffix(".jsonl")
    out.write_text(records.thinned(metrics, EVERY, metrics))
    shutil.copy(run / files.VERSIONS, stem.with_suffix(".versions.json"))
    plots.main(["training", str(out), "--out", str(stem.with_suffix(".png"))])


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("run", type=Path, help="run folder of a finished training")
    parser.add_argument("name", help="name of the policy, as xbot_l_run")
    args = parser.parse_args(argv)
    try:
        metrics = records.read_metrics(args.run)
    except ValueError as error:
        parser.error(str(error))
    put_policy(args.run, metrics, POLICIES / args.name)
    put_training(args.run, metrics, TRAINING / args.name)
    print(f"{args.name} is in the package; next: make results")
    return 0


if __name__ == "__main__":
    sys.exit(main())
