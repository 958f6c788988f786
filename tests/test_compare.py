"""The comparison: its jobs, how it resumes a stopped one, its table, and the copies it keeps."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from kslc_jax import compare, config, files, records


def test_every_variant_and_seed_is_a_job(tmp_path):
    args = compare.Args(out=tmp_path, seeds=(0, 1), ablation_seeds=(0,))
    names = [job.folder.name for job in compare.jobs(args)]
    assert names[:2] == ["kslc-seed0", "baseline-seed0"] and names[-1] == "baseline-seed1"
    assert len(names) == 2 * 2 + 5 and len(set(names)) == len(names)


def test_what_a_job_runs(tmp_path):
    args = compare.Args(out=tmp_path, variants=("no-arms", "baseline"), seeds=(0,), steps=1000)
    arms, baseline = compare.jobs(args)
    folder = str(tmp_path / "no-arms-seed0")
    assert arms.train == (
        *("--preset", "laptop", "--without", "arms", "--seed", "0"),
        *("--run-dir", folder, "--steps", "1000", "--run.snapshots", "16"),
    )
    assert baseline.train[:2] == ("--preset", "baseline-laptop")
    assert arms.evaluate[0] == folder and arms.evaluate[-1].endswith("evaluation.json")
    assert arms.evaluate[arms.evaluate.index("--fidelity") + 1] == "high"


def test_an_interrupted_training_is_resumed(tmp_path):
    """A resume names the preset, because train refuses another one than the run began with."""
    args = compare.Args(out=tmp_path, variants=("kslc",))
    (tmp_path / "kslc-seed0" / "checkpoints").mkdir(parents=True)
    begun = next(compare.jobs(args)).train
    assert "--resume" not in begun  # there is no checkpoint to resume from
    (tmp_path / "kslc-seed0" / "checkpoints" / "1" / "params").mkdir(parents=True)
    assert next(compare.jobs(args)).train == (*begun, "--resume")


def finished_run(folder, survival=1.0):
    """A run folder as a job leaves it: 25 train steps, and the range grows at step 14."""
    folder.mkdir(parents=True)
    seed = int(folder.name[-1])
    laptop = dataclasses.replace(config.preset("laptop"), seed=seed)
    (folder / "config.json").write_text(json.dumps(config.to_dict(laptop)))
    (folder / "versions.json").write_text(json.dumps({"git": "0123abc"}))
    row = {"command": 1.0, "forward_mean": 0.97, "survival": survival}
    (folder / files.EVALUATION).write_text(
        json.dumps({"fidelity": "high", "seeds": 8, "rows": [row]})
    )
    point = {"env_steps": 2500000, "rows": [row | {"forward_mean": 2 / 3, "forward_std": 0.1}]}
    (folder / files.LEARNING).write_text(json.dumps({"run": folder.name, "points": [point]}))
    lines = [
        dict.fromkeys(records.COLUMNS, 1 / 3)
        | {"env_steps": 1e5 * i, "seconds": 10.0 * i, "curriculum/v_max": 0.5 + (i >= 14)}
        | {"not in any figure": 1.0}
        for i in range(1, 26)
    ]
    (folder / "metrics.jsonl").write_text("".join(f"{json.dumps(r)}\n" for r in lines))


ASKED = ("--steps", "2500000", "--speeds", "1.0", "--variants", "kslc")
"""Arguments of the comparison that `finished_run` fulfils."""


@pytest.fixture
def called(monkeypatch):
    """Records the commands that `compare` calls. All of them fail."""
    modules = []

    def fake(module, arguments):
        modules.append(module)
        return False

    monkeypatch.setattr(compare, "call", fake)
    return modules


def test_what_is_done_is_skipped_and_what_fails_is_named(tmp_path, called, capsys):
    finished_run(tmp_path / "kslc-seed0")
    argv = ["--out", str(tmp_path), *ASKED, "baseline", "--seeds", "0"]
    assert compare.main(argv) == 1
    assert called == ["train"]  # of the baseline; no evaluation of a failed training
    out = capsys.readouterr()
    assert "done before" in out.out
    assert "failed: baseline-seed0" in out.err


@pytest.mark.parametrize(
    ("other", "again"),
    [
        (("--steps", "2500001"), "train"),
        (("--speeds", "2.0"), "evaluate"),
        (("--trials", "4"), "evaluate"),
        (("--fidelity", "train"), "evaluate"),
    ],
)
def test_an_answer_to_another_question_does_not_count(tmp_path, called, other, again):
    """A training that is long enough counts; only its evaluation is repeated. The old evaluation
    stays until a new one replaces it."""
    run = tmp_path / "kslc-seed0"
    finished_run(run)
    argv = ["--out", str(tmp_path), *ASKED, "--seeds", "0"]
    assert compare.main(argv) == 0
    assert compare.main([*argv, *other]) == 1 and called == [again]
    assert (run / files.EVALUATION).exists() == (again == "evaluate")


@pytest.mark.parametrize("steps", ["2500000", "2500001"], ids=["finished", "to go on with"])
def test_a_run_of_another_config_is_named_and_left_alone(tmp_path, called, capsys, steps):
    """Else its results would count as those of this config, or its evaluation would be lost."""
    folder = tmp_path / "kslc-seed0"
    finished_run(folder)
    other = config.preset("laptop", ("arms",))
    (folder / "config.json").write_text(json.dumps(config.to_dict(other)))
    argv = ["--out", str(tmp_path), *ASKED, "--seeds", "0", "--steps", steps]
    assert compare.main([*argv, "--keep", str(tmp_path / "kept")]) == 1 and not called
    out = capsys.readouterr()
    first, last = out.err.splitlines()
    assert first.startswith(f"error: {folder} is not of this comparison: ")
    assert last == "error: another training is in kslc-seed0 and was kept; name another --out"
    assert out.out == "" and list((tmp_path / "kept").iterdir()) == []
    assert (folder / files.EVALUATION).exists()


def test_a_run_that_trains_on_is_not_done_by_its_old_evaluation(tmp_path, called):
    """Its old evaluation counts neither in the table nor at the next call, even if the training
    fails."""
    finished_run(tmp_path / "kslc-seed0")
    argv = ["--out", str(tmp_path), *ASKED, "--seeds", "0"]
    assert compare.main([*argv, "--steps", "2500001"]) == 1
    assert compare.finished(tmp_path) == []
    assert compare.main(argv) == 1 and called == ["train", "train"]


def test_the_children_are_as_quiet_as_each_command_alone(tmp_path, called, monkeypatch):
    """They inherit XLA's log level from the environment. Without one, `compare` sets it."""
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    compare.main(["--out", str(tmp_path), *ASKED, "--seeds", "0"])
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"


def test_the_table_of_what_is_finished(tmp_path, capsys):
    finished_run(tmp_path / "kslc-seed0")
    finished_run(tmp_path / "kslc-seed1", survival=0.5)
    assert compare.main(["--out", str(tmp_path), *ASKED, "--seeds", "0", "1"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    head, _, first, second = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    assert head == ["run", "steps", "v_max [m/s]", "after", "1.0"]
    assert first == ["kslc-seed0", "2.5 M", "1.5", "1.4 M, 2.3 min", "0.97"]
    assert second == ["kslc-seed1", "2.5 M", "1.5", "1.4 M, 2.3 min", "falls"]


def test_runs_stand_in_the_order_of_the_variants(tmp_path):
    names = ["kslc-seed0", "kslc-seed1", "baseline-seed0", "no-arms-seed0", "another1"]
    for name in reversed(names):
        finished_run(tmp_path / name)
    assert [run.name for run in compare.finished(tmp_path)] == names


def test_what_is_kept_draws_the_same_figures(tmp_path):
    run, kept = tmp_path / "runs" / "kslc-seed0", tmp_path / "kept"
    finished_run(run)
    argv = ["--out", str(run.parent), "--keep", str(kept), *ASKED, "--seeds", "0"]
    assert compare.main(argv) == 0
    metrics, short = records.read_metrics(run), records.read_metrics(kept / run.name)
    assert list(short) == list(records.COLUMNS)
    assert list(short["env_steps"] / 1e5) == [1, 11, 14, 21, 25]
    assert records.milestones(short) == records.milestones(metrics)
    assert list(short["episode_steps"]) == [0.33333] * 5
    (curve,) = records.read_learning([kept / run.name])["kslc"]
    assert curve.reached == [[0.66667]] and curve.env_steps == [2500000]
    for name in ("config.json", "versions.json", files.EVALUATION):
        assert (kept / run.name / name).read_text() == (run / name).read_text()


def test_keeping_never_writes_into_the_runs(tmp_path, capsys):
    assert compare.main(["--out", str(tmp_path), "--keep", str(tmp_path / "x" / "..")]) == 2
    assert "keep must not be out" in capsys.readouterr().err


def test_a_job_ends_with_what_marks_it_as_done(tmp_path, monkeypatch):
    called = []

    def fake(module, arguments):
        called.append((module, arguments[0]))
        return True

    monkeypatch.setattr(compare, "call", fake)
    job = next(compare.jobs(compare.Args(out=tmp_path, variants=("kslc",))))
    finished_run(job.folder)
    folder = str(job.folder)
    (job.folder / files.LEARNING).unlink()
    assert compare.run(job, 2_500_000)
    assert called == [("train", "--preset"), ("learning", folder), ("evaluate", folder)]
    called.clear()
    assert not compare.run(job, 2_500_001)  # stopped by a signal: saved, and exit code 0
    assert called == [("train", "--preset")]


@pytest.mark.parametrize(
    ("number", "tell", "heard"),
    [
        (signal.SIGINT, os.killpg, signal.SIGINT),
        (signal.SIGTERM, os.kill, signal.SIGTERM),
        (signal.SIGHUP, os.kill, signal.SIGTERM),
    ],
    ids=["to all", "to the parent", "a closed terminal"],
)
def test_a_signal_leaves_time_to_save(tmp_path, number, tell, heard):
    """The child saves for longer than the 0.25 s that `subprocess.run` would allow it."""
    child = """
import signal, sys, time
def save(*_):
    time.sleep(1.0)
    open(sys.argv[1], "w").close()
    sys.exit(0)
signal.signal(int(sys.argv[2]), save)
open(sys.argv[1] + ".ready", "w").close()
time.sleep(60)
"""
    parent = f"""
import signal, subprocess, sys
from kslc_jax import compare
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
start = subprocess.Popen
child = [sys.executable, "-c", {child!r}, {str(tmp_path / "saved")!r}, "{heard:d}"]
subprocess.Popen = lambda _: start(child)
compare.call("train", ())
"""
    process = subprocess.Popen(
        [sys.executable, "-c", parent], start_new_session=True, stderr=subprocess.DEVNULL
    )
    while not (tmp_path / "saved.ready").exists():
        assert process.poll() is None
        time.sleep(0.05)
    tell(process.pid, number)
    assert process.wait(timeout=30) != 0
    assert (tmp_path / "saved").exists()


@pytest.mark.parametrize("argv", [["--variants", "kslk"], ["--preset", "laptob"]])
def test_unknown_names(argv, capsys):
    assert compare.main(argv) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 1 and err[0].startswith("error: ")
