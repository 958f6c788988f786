"""Figures from stored data."""

import json

import numpy as np
import pytest

from kslc_jax import plots


@pytest.fixture
def run_dir(tmp_path):
    rows = [
        {
            "step": i,
            "env_steps": 1000 * i,
            "seconds": 2.0 * i,
            "curriculum/v_max": 0.5 if i < 5 else 1.0,
            "curriculum/tracking": 0.1 * i,
            "episode_steps": 10.0 * i,
            "steps_per_second": 500.0,
        }
        for i in range(1, 10)
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    return tmp_path


def test_milestones(run_dir):
    assert plots.milestones(plots.read_metrics(run_dir)) == [(1.0, 5000, 10.0)]


def test_learning_curve_is_drawn(run_dir, tmp_path):
    out = tmp_path / "figures" / "curve.png"
    assert plots.main([str(run_dir), "--out", str(out)]) == 0
    import matplotlib.image

    image = matplotlib.image.imread(out)
    assert image.shape[0] > 500 and np.std(image) > 0.05


def test_missing_run(tmp_path, capsys):
    assert plots.main([str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.startswith("error: no metrics.jsonl")
