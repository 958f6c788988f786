"""Records in Weights & Biases: the same as in metrics.jsonl, and no training ends because of it."""

import json
import math
import os
import sys
from types import SimpleNamespace

import pytest

from kslc_jax import files, train
from kslc_jax.config import preset, to_dict
from kslc_jax.errors import UserError
from kslc_jax.training import wandb_run

DEBUG = preset("debug")
RECORD = {"step": 3, "env_steps": 384, "reward": 0.5, "ppo/kl": math.nan}


class FakeRun:
    """Notes what it is told."""

    def __init__(self, fails=False):
        self.logged, self.fails, self.exit_code = [], fails, None

    def define_metric(self, *_, **__):
        pass

    def log(self, values, step):
        if self.fails:
            raise OSError("no network\nsecond line")
        self.logged.append((step, values))

    def finish(self, exit_code):
        self.exit_code = exit_code


@pytest.fixture
def fake(monkeypatch):
    """A package wandb that notes how it is called."""
    for name in ("WANDB_PROJECT", "WANDB_NAME"):
        monkeypatch.delenv(name, raising=False)
    run, calls = FakeRun(), []
    init = lambda **how: calls.append(how) or run  # noqa: E731
    package = SimpleNamespace(init=init, Settings=dict, run=run, calls=calls)
    monkeypatch.setitem(sys.modules, "wandb", package)
    return package


def test_records_and_settings(fake, tmp_path):
    with wandb_run.wandb_run(DEBUG, tmp_path, False, pytest.fail) as run:
        run.write(RECORD)
    assert fake.run.logged == [(3, {"step": 3, "env_steps": 384, "reward": 0.5})]
    assert fake.run.exit_code == 0
    (how,) = fake.calls
    assert how["project"] == "kslc_jax" and how["name"] == tmp_path.name
    assert how["config"] == to_dict(DEBUG) and how["dir"] == str(tmp_path)


def test_a_resumed_training_is_the_same_run(fake, tmp_path):
    for resume in (False, True, False):
        with wandb_run.wandb_run(DEBUG, tmp_path, resume, pytest.fail):
            pass
    first, second, third = (how["id"] for how in fake.calls)
    assert first == second != third and {how["resume"] for how in fake.calls} == {"allow"}


def test_a_failure_is_told_once(fake, tmp_path):
    fake.run.fails, said = True, []
    with wandb_run.wandb_run(DEBUG, tmp_path, False, said.append) as run:
        run.write(RECORD)
        run.write(RECORD)
    assert said == ["cannot write to wandb (no network); training goes on"]


def test_a_failed_training_is_marked(fake, tmp_path):
    with pytest.raises(ZeroDivisionError), wandb_run.wandb_run(DEBUG, tmp_path, False, print):
        raise ZeroDivisionError
    assert fake.run.exit_code == 1


def test_refused_is_one_line(fake, tmp_path):
    def refuse(**_):
        raise ValueError("api_key not configured")

    fake.init = refuse
    with (
        pytest.raises(UserError, match=r"--wandb: api_key not configured \(WANDB_MODE=offline"),
        wandb_run.wandb_run(DEBUG, tmp_path, False, print),
    ):
        pass


def test_not_installed_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    run_dir = tmp_path / "r"
    assert train.main(["--preset", "debug", "--run-dir", str(run_dir), "--wandb"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: --wandb: ") and "pip install 'kslc_jax[wandb]'" in line
    assert not run_dir.exists()


@pytest.mark.slow(reason="starts wandb's service, and trains")
def test_offline(tmp_path, monkeypatch):
    """The file that `wandb sync` would send holds the records of metrics.jsonl."""
    pytest.importorskip("wandb", reason="the extra 'wandb' is not installed")
    from wandb.proto import wandb_internal_pb2
    from wandb.sdk.internal import datastore

    monkeypatch.setenv("WANDB_MODE", "offline")
    run_dir = tmp_path / "r"
    assert train.main(["--preset", "debug", "--run-dir", str(run_dir), "--wandb"]) == 0
    (path,) = run_dir.glob("wandb/offline-run-*/*.wandb")
    store, sent = datastore.DataStore(), []
    store.open_for_scan(os.fspath(path))
    while data := store.scan_data():
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            sent.append({x.key or "/".join(x.nested_key): json.loads(x.value_json) for x in items})
    rows = [json.loads(x) for x in (run_dir / files.METRICS).read_text().splitlines()]
    kept = [{name: x for name, x in row.items() if math.isfinite(x)} for row in rows]
    ours = [{name: x for name, x in row.items() if not name.startswith("_")} for row in sent]
    assert ours == kept and [row["_step"] for row in sent] == list(range(1, 9))
