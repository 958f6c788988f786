"""Figures from stored data."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from kslc_jax import plots, records


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
    assert records.milestones(records.read_metrics(run_dir)) == [(1.0, 5000, 10.0)]


def test_learning_curve_is_drawn(run_dir, tmp_path):
    out = tmp_path / "figures" / "curve.png"
    assert plots.main(["training", str(run_dir), "--out", str(out)]) == 0
    import matplotlib.image

    image = matplotlib.image.imread(out)
    assert image.shape[0] > 500 and np.std(image) > 0.05


@pytest.fixture
def evaluations(tmp_path):
    paths = []
    for name, gain in (("kslc-seed0", 1.0), ("kslc-seed1", 0.9), ("baseline-seed0", 0.2)):
        metrics = [key for key, _ in plots.PERFORMANCE + plots.MOMENTUM]
        rows = [{"command": v, **dict.fromkeys(metrics, gain * v)} for v in (1.0, 2.0, 3.0)]
        (tmp_path / name).mkdir()
        paths.append(tmp_path / name / "evaluation.json")
        paths[-1].write_text(json.dumps({"rows": rows}))
    return paths


def test_seeds_of_a_method_belong_together(evaluations):
    found = records.read_evaluations(evaluations)
    assert {name: len(seeds) for name, seeds in found.items()} == {"kslc": 2, "baseline": 1}


@pytest.mark.parametrize("figure", ["performance", "momentum"])
def test_figures_of_evaluations_are_drawn(figure, evaluations, tmp_path):
    out = tmp_path / f"{figure}.png"
    assert plots.main([figure, *map(str, evaluations), "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000


def test_learning_curves_are_drawn(tmp_path, capsys):
    """The seeds of one method may have different lengths. Different steps or speeds are errors."""
    for name, count in (("kslc-seed0", 5), ("kslc-seed1", 3), ("baseline-seed0", 4)):
        points = [
            {
                "env_steps": 1e6 * i,
                "rows": [{"command": v, "forward_mean": 0.2 * i * v} for v in range(5)],
            }
            for i in range(count)
        ]
        (tmp_path / name).mkdir()
        (tmp_path / name / "learning.json").write_text(json.dumps({"run": name, "points": points}))
    runs = sorted(map(str, tmp_path.iterdir()))
    assert {k: len(v) for k, v in records.read_learning(list(tmp_path.iterdir())).items()} == {
        "kslc": 2,
        "baseline": 1,
    }
    kslc = records.read_learning([*map(Path, runs)])["kslc"]
    assert [len(curve.env_steps) for curve in kslc] == [3, 3]
    np.testing.assert_allclose(kslc[0].reached[2], 0.4 * np.arange(5))
    out = tmp_path / "out.png"
    assert plots.main(["learning", *runs, "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000
    assert plots.main(["learning", str(tmp_path)]) == 2
    assert "is no learning curve" in capsys.readouterr().err
    other = tmp_path / "kslc-seed1" / "learning.json"
    other.write_text(other.read_text().replace("1000000.0", "999999.0"))
    assert plots.main(["learning", *runs]) == 2
    assert "the seeds of kslc kept their policies at different steps" in capsys.readouterr().err
    other.write_text(other.read_text().replace('"command": 4', '"command": 5'))
    assert plots.main(["learning", *runs]) == 2
    assert "tried at different speeds" in capsys.readouterr().err


def test_what_nobody_survived_leaves_a_gap(evaluations, tmp_path):
    """A seed may lack a metric, or all seeds may lack it at a speed. The rest is still drawn."""
    for path, speeds in zip(evaluations, ((1, 2), (1,), (1, 2)), strict=True):
        content = json.loads(path.read_text())
        content["rows"] = [
            row if row["command"] in speeds else {"command": row["command"], "forward_mean": 0.0}
            for row in content["rows"]
        ]
        path.write_text(json.dumps(content))
    axis = Figure().subplots()
    seeds = records.read_evaluations(evaluations)["kslc"]
    plots._over_commands(axis, "kslc", "C0", seeds, "forward_std")
    drawn = axis.lines[0].get_xydata()
    np.testing.assert_allclose(drawn, [[1.0, 0.95], [2.0, 2.0]])
    assert (
        plots.main(["performance", *map(str, evaluations), "--out", str(tmp_path / "p.png")]) == 0
    )


def test_sim2sim_files_are_evaluations_too(evaluations, tmp_path):
    content = json.loads(evaluations[0].read_text())
    path = tmp_path / "sim2sim.json"
    path.write_text(json.dumps({"conditions": {"nominal": content["rows"], "payload=5": []}}))
    assert records.read_evaluations([path]) == {"sim2sim": [content["rows"]]}


def drawn_texts(results, tmp_path, monkeypatch):
    """The texts in the fields of the figure `conditions`."""
    figures = []
    monkeypatch.setattr(plots, "_save", lambda figure, out: figures.append(figure))
    (tmp_path / "x.json").write_text(json.dumps({"conditions": results}))
    assert plots.main(["conditions", str(tmp_path / "x.json")]) == 0
    axis = figures[0].axes[0]
    ticks = (axis.get_xticklabels(), axis.get_yticklabels())
    labels = [[label.get_text() for label in row] for row in ticks]
    return labels, [text.get_text() for text in axis.texts]


def test_every_condition_is_a_row_of_a_figure(tmp_path, monkeypatch):
    def row(command, survival, **more):
        return {"command": command, "survival": survival, "forward_mean": 0.9 * command, **more}

    results = {
        "nominal": [row(1.0, 1.0), row(2.0, 1.0)],
        "slope:10": [row(1.0, 0.5), {"command": 2.0, "survival": 0.0, "beyond": ["ground"]}],
    }
    labels, texts = drawn_texts(results, tmp_path, monkeypatch)
    assert labels == [["1 m/s", "2 m/s"], ["nominal", "slope:10"]]
    assert texts == ["100%\n0.90", "100%\n1.80", "50%\n0.90", "0%*"]
    schedule = {"nominal": [{"schedule": "stop", "survival": 0.75}]}
    labels, texts = drawn_texts(schedule, tmp_path, monkeypatch)
    assert labels == [["stop"], ["nominal"]] and texts == ["75%"]


def reactions(*forward):
    """A row of sim2sim --schedule: the speeds of its robots, at a command of 1 m/s."""
    commanded = [[1.0 if x is not None else None for x in robot] for robot in forward]
    series = {"every": 0.1, "commanded": commanded, "forward": forward}
    return {"schedule": "stop", "survival": 0.5, "series": series}


def test_the_speeds_of_a_condition_are_drawn_over_time(tmp_path, monkeypatch):
    """The second robot falls after 0.2 s. The legend says so, though the first panel shows none."""
    figures = []
    monkeypatch.setattr(plots, "_save", lambda figure, out: figures.append(figure))
    path = tmp_path / "x.json"
    rows = [reactions([0.0, 0.5, 1.0], [0.0, 0.5, None])]
    path.write_text(json.dumps({"conditions": {"nominal": rows[:1], "punch=500": rows}}))
    assert plots.main(["schedules", str(path), "--condition", "punch=500"]) == 0
    (drawn,) = figures
    first, second = drawn.axes
    assert first.get_title() == "stop: 50% survived"
    np.testing.assert_allclose(first.lines[1].get_xydata(), [[0.0, 0.0], [0.1, 0.5], [0.2, 1.0]])
    assert second.lines[2].get_xdata()[0] == pytest.approx(0.2)
    labels = [text.get_text() for text in drawn.legends[0].get_texts()]
    assert labels == ["commanded", "actual", "fell"]


def test_no_schedules(tmp_path, capsys):
    path = tmp_path / "x.json"
    rows = [{"command": 1.0, "survival": 1.0}]
    path.write_text(json.dumps({"conditions": {"nominal": rows, "payload=5": rows}}))
    assert plots.main(["schedules", str(path)]) == 2
    assert "holds no schedules" in capsys.readouterr().err
    assert plots.main(["schedules", str(path), "--condition", "com=1"]) == 2
    assert "has no condition 'com=1', but nominal, payload=5" in capsys.readouterr().err


@pytest.mark.parametrize("content", ["[]", "{}", '{"conditions": {}}', '{"conditions": {"a": []}}'])
def test_no_conditions(content, tmp_path, capsys):
    (tmp_path / "x.json").write_text(content)
    assert plots.main(["conditions", str(tmp_path / "x.json")]) == 2
    assert "holds no conditions" in capsys.readouterr().err


def test_not_an_evaluation(tmp_path, capsys):
    (tmp_path / "x.json").write_text("[]")
    assert plots.main(["performance", str(tmp_path / "x.json")]) == 2
    assert "is no evaluation" in capsys.readouterr().err


def test_missing_run(tmp_path, capsys):
    assert plots.main(["training", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.startswith("error: no metrics.jsonl")
