"""Published numbers against new ones: bands, milestones, and the errors without stored numbers."""

import json
import math
import types

import jax
import pytest
from states import still_policy

from kslc_jax import files, records, reproduce, runtime
from kslc_jax import policy as policy_lib
from kslc_jax.config import preset
from kslc_jax.training import loop
from kslc_jax.training.recovery import NumbersError


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A shipped policy that always commands the default pose. It falls soon."""
    monkeypatch.setattr(policy_lib, "POLICIES", tmp_path)
    policy_lib.save_policy(still_policy(preset("debug"), step=7), tmp_path / "still")
    return tmp_path / "still"


def rows_of(survival):
    return [{"command": 1.0, "survival": survival, "forward_mean": 0.0}]


def evaluation(survival, fidelity="train"):
    rows = rows_of(survival)
    return json.dumps({"seeds": 2, "seconds": 3.0, "fidelity": fidelity, "rows": rows})


@pytest.fixture
def falls_again(monkeypatch):
    """Trials without a simulation: the robot falls."""
    monkeypatch.setattr(reproduce.evaluate, "sweep", lambda *_: rows_of(0.0))


def test_bands():
    old = [{"command": 1.0, "survival": 1.0, "forward_mean": 0.98, "cost_of_transport": 1.0}]
    new = [{"command": 1.0, "survival": 1.0, "forward_mean": 0.92, "cost_of_transport": 9.0}]
    assert reproduce.compare_rows(old, new) == [
        ("survival at 1 m/s", 1.0, 1.0, True),
        ("forward_mean at 1 m/s", 0.98, 0.92, False),  # 0.06 off; the band is 0.05. CoT has none
    ]
    missing = reproduce.compare_rows(old, [{"command": 1.0, "survival": 0.0}])
    assert not any(agrees for *_, agrees in missing)


def test_milestones_may_be_half_as_late_again():
    old = {"1": 10e6, "1.5": 12e6, "2": 15e6}
    rows = reproduce.compare_milestones(old, {"1": 14.9e6, "1.5": 18.1e6})
    assert [agrees for *_, agrees in rows] == [True, False, False]
    assert math.isinf(rows[2][2])


@pytest.mark.slow(reason="compiles trials")
def test_a_real_trial_is_compared(shipped, capsys):
    """In 3 s the policy falls, as its evaluation says."""
    (shipped / files.EVALUATION).write_text(evaluation(0.0))
    assert reproduce.main(["still"]) == 0
    assert "all 2 numbers lie within" in capsys.readouterr().out


@pytest.mark.parametrize(("survival", "code"), [(0.0, 0), (1.0, 1)])
def test_a_shipped_policy_is_tried_again(shipped, falls_again, survival, code, capsys):
    (shipped / files.EVALUATION).write_text(evaluation(survival))
    assert reproduce.main(["still"]) == code
    said = capsys.readouterr().out
    assert ("lie outside their band" if code else "all 2 numbers lie within") in said


def test_nothing_to_compare_with_is_one_line(shipped, capsys):
    for argv, says in (
        (["still"], "no readable evaluation.json"),
        (["none"], "no run, checkpoint"),
    ):
        assert reproduce.main(argv) == 2
        err = capsys.readouterr().err.strip().splitlines()
        assert len(err) == 1 and err[0].startswith("error: ") and says in err[0]


def test_training_again_is_compared(shipped, falls_again, tmp_path, monkeypatch, capsys):
    (shipped / files.EVALUATION).write_text(evaluation(0.0))
    (shipped / files.MILESTONES).write_text(json.dumps({"1": 2000}))
    asked = []

    def fake(args, config, until):
        asked.append(until)
        return {"1": 2500.0}

    monkeypatch.setattr(reproduce, "retrain", fake)
    assert reproduce.main(["still", "--train", "--run-dir", str(tmp_path / "run")]) == 0
    assert asked == [3000.0]


@pytest.fixture
def trained(shipped, falls_again, monkeypatch):
    """A fake training of `shipped`. `outcome` sets the share of its steps and its error."""
    (shipped / files.EVALUATION).write_text(evaluation(0.0))
    (shipped / files.MILESTONES).write_text(json.dumps({"1": 2000}))
    outcome = {"steps": 1.0, "raises": None}

    def fake(config, run_dir, resume, progress):
        progress.close()
        if outcome["raises"]:
            raise outcome["raises"]
        run_dir.mkdir(parents=True, exist_ok=True)
        rows = [
            dict.fromkeys(records.COLUMNS, 0.0) | {"env_steps": steps, "curriculum/v_max": v}
            for steps, v in ((128, 0.5), (2900, 1.0))
        ]
        (run_dir / "metrics.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
        return types.SimpleNamespace(step=round(outcome["steps"] * config.num_updates))

    monkeypatch.setattr(loop, "train", fake)
    return outcome


@pytest.mark.parametrize(
    ("outcome", "code", "says"),
    [
        ({}, 0, "all 3 numbers lie within"),
        ({"steps": 0.5}, 130, "stopped; the same command"),
        ({"raises": NumbersError("bad again and again")}, 1, "error: bad again and again"),
    ],
)
def test_how_a_training_ends(trained, tmp_path, outcome, code, says, capsys):
    trained |= outcome
    assert reproduce.main(["still", "--train", "--run-dir", str(tmp_path / "run")]) == code
    said = capsys.readouterr()
    assert says in (said.err or said.out).splitlines()[-1]


def test_a_jax_that_hangs_is_refused(shipped, monkeypatch, capsys):
    monkeypatch.setattr(jax, "__version__", "0.11.0")
    assert reproduce.main(["still", "--train"]) == 2
    assert runtime.JAX_FIX in capsys.readouterr().err
