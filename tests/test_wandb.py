"""Records in Weights & Biases: the same as in metrics.jsonl, and no training ends because of it."""

import json
import math
import struct
import sys
from types import SimpleNamespace

import pytest

from kslc_jax import files, train
from kslc_jax.config import preset, to_dict
from kslc_jax.errors import UserError
from kslc_jax.training import recorder, run_folder, wandb_run

DEBUG = preset("debug")
STEPS = tuple(enumerate((1, 2, 3, 2, 3)))
"""(order, train step) of a training that has gone back."""
RECORD = {"step": 3, "env_steps": 384, "reward": 0.5, "ppo/kl": math.nan}


class FakeRun:
    """Notes what it is told. It counts its steps itself, unless it gets one. As wandb does, it
    ignores a step before the last one."""

    def __init__(self, fails=False):
        self.logged, self.fails, self.exit_code = [], fails, None
        self.step, self.axes = -1, []

    def define_metric(self, name, step_metric):
        self.axes.append((name, step_metric))

    def log(self, values, step=None):
        if self.fails:
            raise OSError("no network\nsecond line")
        step = self.step + 1 if step is None else step
        if step >= self.step:
            self.step = step
            self.logged.append(values)

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
    assert fake.run.logged == [{"step": 3, "env_steps": 384, "reward": 0.5}]
    assert fake.run.axes == [("*", "env_steps")] and fake.run.exit_code == 0
    (how,) = fake.calls
    assert how["project"] == "kslc_jax" and how["name"] == tmp_path.name
    assert how["config"] == to_dict(DEBUG) and how["dir"] == str(tmp_path)


def test_a_resumed_training_is_the_same_run(fake, tmp_path):
    for resume in (False, True, False):
        with wandb_run.wandb_run(DEBUG, tmp_path, resume, pytest.fail):
            pass
    first, second, third = (how["id"] for how in fake.calls)
    assert first == second != third and {how["resume"] for how in fake.calls} == {"allow"}


def test_what_a_training_repeats_is_sent_again(fake, tmp_path):
    """It has gone back to a checkpoint after bad numbers, or resumes with other numbers."""
    rows = [{"step": step, "env_steps": 128 * step, "reward": 0.1 * i} for i, step in STEPS]
    with wandb_run.wandb_run(DEBUG, tmp_path, False, pytest.fail) as run:
        for row in rows:
            run.write(row)
    assert fake.run.logged == rows


@pytest.mark.parametrize(("last", "opens"), [(7, True), (8, False)])
def test_a_finished_training_opens_no_run(last, opens, fake, tmp_path):
    """Its `--resume` does nothing, and leaves wandb alone."""
    run_folder.open_folder(tmp_path, DEBUG, resume=False, facts={})
    store = SimpleNamespace(steps=lambda: [2, last], close=lambda: None)
    storage = SimpleNamespace(open=lambda *_: store, save_policy=pytest.fail)
    progress = SimpleNamespace(warn=pytest.fail)
    with recorder.opened(DEBUG, tmp_path, True, {}, progress, storage, wandb=True):
        pass
    assert DEBUG.num_updates == 8
    assert len(fake.calls) == opens and (tmp_path / files.WANDB_ID).exists() == opens


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


def entries(log):
    """The entries of a .wandb file: 7 bytes, then LevelDB's log format. Its blocks have 32 KB, the
    header of each part of an entry is checksum, length and kind; whole and last parts end one."""
    at, entry = 7, b""
    while at + 7 <= len(log):
        if (left := 32768 - at % 32768) < 7:
            at += left
            continue
        length, kind = struct.unpack_from("<HB", log, at + 4)
        entry += log[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):
            yield entry
            entry = b""


@pytest.mark.slow(reason="starts wandb's service, and trains")
def test_offline(tmp_path, monkeypatch):
    """The file that `wandb sync` would send holds the records of metrics.jsonl."""
    pytest.importorskip("wandb", reason="the extra 'wandb' is not installed")
    from wandb.proto import wandb_internal_pb2

    monkeypatch.setenv("WANDB_MODE", "offline")
    run_dir = tmp_path / "r"
    assert train.main(["--preset", "debug", "--run-dir", str(run_dir), "--wandb"]) == 0
    (path,) = run_dir.glob("wandb/offline-run-*/*.wandb")
    sent = []
    for data in entries(path.read_bytes()):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(data)
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            sent.append({x.key or "/".join(x.nested_key): json.loads(x.value_json) for x in items})
    rows = [json.loads(x) for x in (run_dir / files.METRICS).read_text().splitlines()]
    kept = [{name: x for name, x in row.items() if math.isfinite(x)} for row in rows]
    ours = [{name: x for name, x in row.items() if not name.startswith("_")} for row in sent]
    assert ours == kept and [row["_step"] for row in sent] == list(range(8))
