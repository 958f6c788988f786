"""A training becomes a shipped policy: python -m docs.ship."""

import json
import shutil
from pathlib import Path

import chex
import numpy as np
import pytest

from docs import ship
from kslc_jax import export, files, records
from kslc_jax.policy import POLICIES, load_policy

TRAINING = Path(__file__).parents[1] / "docs" / "training"


@pytest.fixture
def run(tmp_path) -> Path:
    """A folder with a policy and the records of its training."""
    folder = tmp_path / "run"
    shutil.copytree(POLICIES / "xbot_l_run", folder)
    shutil.copy(TRAINING / "xbot_l_run.jsonl", folder / files.METRICS)
    (folder / files.VERSIONS).write_text('{"git": "0123abc"}')
    return folder


def test_a_training_becomes_a_policy(run, tmp_path, monkeypatch):
    """The card of the policy before stays; everything else of it goes."""
    monkeypatch.setattr(ship, "POLICIES", tmp_path / "policies")
    monkeypatch.setattr(ship, "TRAINING", tmp_path / "training")
    monkeypatch.setattr(export, "compare", lambda *_: "compared in test_export.py")
    before = tmp_path / "policies" / "mine"
    for folder in (before, tmp_path / "training"):
        folder.mkdir(parents=True)
    (before / ship.CARD).write_text("a card")
    (before / files.EVALUATION).write_text("{}")
    assert ship.main([str(run), "mine"]) == 0

    shipped, trained = load_policy(before), load_policy(run)
    chex.assert_trees_all_equal(shipped.params, trained.params)
    assert shipped.config == trained.config
    assert (before / ship.CARD).read_text() == "a card"
    assert not (before / files.EVALUATION).exists()

    kept = records.read_metrics(tmp_path / "training" / "mine.jsonl")
    whole = records.read_metrics(run)
    np.testing.assert_allclose(records.milestones(kept), records.milestones(whole), rtol=1e-4)
    steps = json.loads((before / files.MILESTONES).read_text())
    assert steps == {f"{v:g}": after for v, after, _ in records.milestones(kept)}
    assert np.array_equal(kept["step"], [s for s in whole["step"] if s in kept["step"]])
    assert {*whole["step"][:: ship.EVERY], whole["step"][-1]} <= {*kept["step"]}
    assert len(kept["step"]) < len(whole["step"]) / 2
    assert (tmp_path / "training" / "mine.png").stat().st_size > 10_000
    assert "0123abc" in (tmp_path / "training" / "mine.versions.json").read_text()


def test_a_run_that_cannot_be_read_replaces_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ship, "POLICIES", tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / ship.CARD).write_text("a card")
    with pytest.raises(SystemExit):
        ship.main([str(tmp_path / "none"), "mine"])
    assert "error: " in capsys.readouterr().err
    assert (tmp_path / "mine" / ship.CARD).read_text() == "a card"
