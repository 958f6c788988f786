"""The matrix of trainings: which jobs there are, and that a stopped matrix goes on."""

import json
import subprocess

import pytest

from kslc_jax import compare


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
        *("--run-dir", folder, "--steps", "1000"),
    )
    assert baseline.train[:2] == ("--preset", "baseline-laptop")
    assert arms.evaluate[0] == folder and arms.evaluate[-1].endswith("evaluation.json")


def test_an_interrupted_training_is_resumed(tmp_path):
    (tmp_path / "kslc-seed0" / "checkpoints").mkdir(parents=True)
    job = next(compare.jobs(compare.Args(out=tmp_path, variants=("kslc",))))
    assert job.train[0] == "--resume" and "--preset" not in job.train


def test_what_is_done_is_skipped_and_what_fails_is_named(tmp_path, monkeypatch, capsys):
    done = tmp_path / "kslc-seed0" / compare.EVALUATION
    done.parent.mkdir()
    done.write_text(json.dumps({"rows": [{"command": 1.0, "forward_mean": 0.97}]}))
    called = []

    def fake(command, **_):
        called.append(command[2])
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(subprocess, "run", fake)
    argv = ["--out", str(tmp_path), "--variants", "kslc", "baseline", "--seeds", "0"]
    assert compare.main(argv) == 1
    assert called == ["kslc_jax.train"]  # of the baseline; no evaluation of a failed training
    out = capsys.readouterr()
    assert "done before" in out.out and "0.97" in out.out
    assert "failed: baseline-seed0" in out.err


def test_a_job_ends_with_what_marks_it_as_done(tmp_path, monkeypatch):
    called = []

    def fake(command, **_):
        called.append(command[2:4])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", fake)
    job = next(compare.jobs(compare.Args(out=tmp_path, variants=("kslc",))))
    assert compare.run(job)
    folder = str(tmp_path / "kslc-seed0")
    train, *tried = called
    assert train[0] == "kslc_jax.train"
    assert tried == [["kslc_jax.learning", folder], ["kslc_jax.evaluate", folder]]


@pytest.mark.parametrize("argv", [["--variants", "kslk"], ["--preset", "laptob"]])
def test_unknown_names(argv, capsys):
    assert compare.main(argv) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 1 and err[0].startswith("error: ")
