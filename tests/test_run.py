"""Run folders from the user's side: train, stop, resume, load, and errors."""

import contextlib
import ctypes.util
import dataclasses
import gzip
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from rich.console import Console

import kslc_jax
from kslc_jax import files, learning, ppo, runtime, train, train_step
from kslc_jax import policy as policy_lib
from kslc_jax.checkpoint_format import CheckpointError
from kslc_jax.config import ConfigError, preset
from kslc_jax.training import (
    checkpoint,
    checkpoint_process,
    loop,
    memory,
    recorder,
    run_folder,
    same_training,
    starting,
)
from kslc_jax.training.logs import MetricsFile, Progress
from kslc_jax.viewer import following

DEBUG = ["--preset", "debug"]


def cli(*args):
    """The output of `python -m kslc_jax.train`. It runs in this process, so that the compiled
    program is reused."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert train.main([str(a) for a in args]) == 0
    return out.getvalue()


def records(run_dir: Path):
    """The records of metrics.jsonl without `seconds`."""
    rows = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in r.items() if not k.startswith("seconds")} for r in rows]


def numbers(rows):
    return [{k: v for k, v in r.items() if k != "steps_per_second"} for r in rows]


def restored(run_dir: Path):
    config = run_folder.read_config(run_dir)
    like = jax.eval_shape(train_step.make(config)[0])
    store = checkpoint.Store(run_dir)
    state = store.restore(like, print)
    store.close()
    return state


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run of 8 train steps."""
    run_dir = tmp_path_factory.mktemp("runs") / "whole run"  # a path with a space
    out = cli(*DEBUG, "--run-dir", run_dir)
    return run_dir, out


def test_run_folder_and_output(whole):
    run_dir, out = whole
    assert "compiled in" in out and "steps/s" in out and "ETA" in out and "v_max" in out
    assert {
        "config.json",
        "versions.json",
        "metrics.jsonl",
        "checkpoints",
        "snapshots",
        "tensorboard",
    } <= {p.name for p in run_dir.iterdir()}
    assert run_folder.read_config(run_dir) == preset("debug")
    versions = json.loads((run_dir / "versions.json").read_text())
    assert versions["jax"] == jax.__version__ and "git" in versions
    rows = records(run_dir)
    assert [r["step"] for r in rows] == list(range(1, 9))
    assert rows[-1]["env_steps"] == 1024


def test_memory_is_reckoned_before_and_read_off_after_compiling(whole):
    about = re.search(r"about ([\d.]+) MiB of memory", whole[1])
    needs = re.search(r"compiled in \d+ s, needs ([\d.]+) MiB; training", whole[1])
    assert 1 / 1.5 < float(about[1]) / float(needs[1]) < 1.5


def test_stop_and_resume_is_bit_for_bit_the_uninterrupted_run(whole, tmp_path):
    run_dir, _ = whole
    cli(*DEBUG, "--run-dir", tmp_path / "r", "--steps", 512)
    cli("--resume", "--run-dir", tmp_path / "r", "--steps", 1024)
    assert numbers(records(tmp_path / "r")) == numbers(records(run_dir))
    rows = map(json.loads, (tmp_path / "r" / "metrics.jsonl").read_text().splitlines())
    assert np.all(np.diff([row["seconds"] for row in rows]) > 0.0)  # the clock goes on after resume
    a, b = restored(run_dir), restored(tmp_path / "r")
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow(reason="writing three profiles takes a quarter of a minute")
def test_profile_changes_no_number(whole, tmp_path):
    """A profile has two train steps, from the second step on. If the run ends early, the profile
    has the steps so far."""
    run_dir, rarely = tmp_path / "r", ("--run.snapshots", 0)
    out = cli(*DEBUG, *rarely, "--run-dir", run_dir, "--profile", 2)
    assert f"profile of 2 train steps in {run_dir / 'profile'}" in out and "perfetto" in out
    assert numbers(records(run_dir)) == numbers(records(whole[0]))
    (traced,) = (run_dir / "profile").rglob("*.trace.json.gz")
    events = json.loads(gzip.decompress(traced.read_bytes()))["traceEvents"]
    steps = [e["args"]["step_num"] for e in events if e.get("name") == "train"]
    assert sorted(map(int, steps)) == [2, 3]
    assert len(list(traced.parent.glob("*.xplane.pb"))) == 1
    out = cli("--resume", *rarely, "--run-dir", run_dir, "--steps", 1152, "--profile", 5)
    assert "warning: the training ended before there was a train step to profile" in out
    out = cli("--resume", *rarely, "--run-dir", run_dir, "--steps", 1536, "--profile", 5)
    assert "profile of 2 train steps" in out


def saved_steps(run_dir: Path) -> list[int]:
    """Train steps with a whole checkpoint, and 0."""
    return [0, *(int(p.name) for p in run_dir.glob("checkpoints/*") if p.name.isdigit())]


def wait_until(ready, process):
    for _ in range(3000):  # 0.1 s each; a busy machine compiles for minutes
        if ready():
            return
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.1)
    raise AssertionError("no progress")


@pytest.mark.slow(reason="half a minute each: a process that compiles; a stop above does not")
@pytest.mark.parametrize("sig", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_killed_run_resumes_with_the_same_numbers(sig, tmp_path):
    """A run is killed and resumed from its last checkpoint. Its numbers equal the run without a
    kill."""
    run_dir = tmp_path / "r"
    args = [*DEBUG, "--run-dir", str(run_dir), "--steps", "1000000"]
    args += ["--run.checkpoint-minutes", "0.005", "--run.snapshots", "0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "kslc_jax.train", *args],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until(lambda: max(saved_steps(run_dir)) > 1, process)
    process.send_signal(sig)
    out, _ = process.communicate(timeout=60)
    killed = sig == signal.SIGKILL
    assert process.returncode == (-sig if killed else 0)
    assert killed or "saved" in out
    until = max(saved_steps(run_dir)) + 5
    cli("--resume", "--run-dir", run_dir, "--steps", until * 128)
    cli(*DEBUG, "--run-dir", tmp_path / "unkilled", "--steps", until * 128)
    assert numbers(records(run_dir)) == numbers(records(tmp_path / "unkilled"))


def test_a_training_starts_from_a_policy(whole, tmp_path, capsys):
    """A training takes the networks and the curriculum of a policy, and starts at step 0. A policy
    with other network shapes gives a one-line error."""
    run_dir = tmp_path / "r"
    old = kslc_jax.load_policy(whole[0])
    old = dataclasses.replace(old, curriculum=old.curriculum.replace(v_max=jnp.asarray(2.5)))
    policy_lib.save_policy(old, tmp_path / "p")
    init, _ = train_step.make(preset("debug"))
    begin, origin = starting.from_policy(
        tmp_path / "p", preset("debug"), init, checkpoint_process.LocalStorage(), None
    )
    state = begin()
    for a, b in zip(
        jax.tree.leaves(state.learner.params), jax.tree.leaves(old.params), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    assert float(state.curriculum.v_max) == 2.5 and int(state.step) == 0
    cli(*DEBUG, "--run-dir", run_dir, "--start-from", tmp_path / "p", "--steps", 128)
    assert records(run_dir)[0]["curriculum/v_max"] == 2.5
    assert json.loads((run_dir / "versions.json").read_text()) | origin == json.loads(
        (run_dir / "versions.json").read_text()
    )
    again = [*DEBUG, "--run-dir", str(tmp_path / "s"), "--start-from"]
    for args, said in (
        ([*again, "xbot_l_run"], "cannot start from xbot_l_run: it has networks of other shapes"),
        ([*again, "none"], "no run, checkpoint or shipped policy called 'none'"),
        (["--resume", "--run-dir", str(run_dir), "--start-from", "x"], "take one of them"),
    ):
        assert train.main(args) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_load_policy(whole):
    run_dir, _ = whole
    policy = kslc_jax.load_policy(run_dir)
    assert policy.config == preset("debug") and policy.step == 8
    state, action = policy.act(policy.init(), jnp.zeros(59))
    assert action.shape == (16,) and state.history.shape == (3, 59)
    learner = restored(run_dir).learner
    jax.tree.map(np.testing.assert_array_equal, policy.params, ppo.deployed(learner))
    actor = learner.params["actor"]["Dense_0"]["kernel"]  # as it is trained: not the average
    assert np.abs(policy.params["actor"]["Dense_0"]["kernel"] - actor).max() > 1e-6
    same = kslc_jax.load_policy(run_dir / "checkpoints" / "8")
    np.testing.assert_array_equal(
        same.act(same.init(), jnp.ones(59))[1], policy.act(policy.init(), jnp.ones(59))[1]
    )


@pytest.mark.slow(reason="compiles trials of the policies, half a minute")
def test_policies_are_kept_on_the_way(whole, tmp_path, capsys):
    """Each snapshot loads as a policy. `learning` writes their learning curve into the run."""
    run_dir = tmp_path / "debug-seed0"
    shutil.copytree(whole[0], run_dir)
    folders = learning.snapshots(run_dir)
    assert [p.name for p in folders] == [str(i) for i in range(1, 9)]
    last = kslc_jax.load_policy(folders[-1])
    final = kslc_jax.load_policy(run_dir)
    assert (last.step, last.config) == (final.step, final.config)
    for a, b in zip(jax.tree.leaves(last.params), jax.tree.leaves(final.params), strict=True):
        np.testing.assert_array_equal(a, b)
    shutil.rmtree(folders[0])
    args = ["--speeds", "0", "1", "--seeds", "2", "--seconds", "3"]
    assert learning.main([str(run_dir), *args]) == 0
    points = json.loads((run_dir / files.LEARNING).read_text())["points"]
    assert [p["env_steps"] for p in points] == [128 * i for i in range(2, 9)]
    assert all([row["command"] for row in p["rows"]] == [0.0, 1.0] for p in points)
    assert learning.main([str(tmp_path), *args]) == 2
    assert "holds no snapshots" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("parts", "due"), [(0, []), (1, [8]), (3, [3, 6, 8]), (99, [*range(1, 9)])]
)
def test_snapshots_are_spread_over_the_run(parts, due):
    config = preset("debug")
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, snapshots=parts))
    assert [s for s in range(1, 9) if recorder.snapshot_due(config, s)] == due


def test_a_stop_where_a_snapshot_is_due_keeps_it(tmp_path, monkeypatch):
    log = recorder.Recorder.log

    def stopping(self, metrics, step, took):
        if step == 4:
            signal.raise_signal(signal.SIGTERM)
        return log(self, metrics, step, took)

    monkeypatch.setattr(recorder.Recorder, "log", stopping)
    assert "stopped by SIGTERM at train step 4" in cli(
        *DEBUG, "--run-dir", tmp_path, "--run.snapshots", 4
    )
    assert [path.name for path in learning.snapshots(tmp_path)] == ["2", "4"]


@pytest.mark.slow(reason="compiles, simulates and draws in software, half a minute")
def test_gait_strip(whole, tmp_path):
    """With an off-screen GL the command draws. Without one, it says what to install."""
    out = tmp_path / "strip.png"
    args = [whole[0], "--speeds", "0.5", "1.0", "--seconds", "0.5", "--gait-strip", out]
    env = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run(
        [sys.executable, "-m", "kslc_jax.play", *map(str, args)],
        capture_output=True,
        text=True,
        check=False,
        env=env,
        timeout=300,
    )
    if any(ctypes.util.find_library(name) for name in ("EGL", "OSMesa")):
        assert done.returncode == 0, done.stderr
        assert "fell at 0.5 m/s" in done.stdout
        image = matplotlib.image.imread(out)
        assert image.shape[:2] == (840, 1800) and image[:420].std() > 0.05
    else:
        assert done.returncode == 2 and "apt-get install" in done.stderr


def damage(folder: Path):
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_damaged_checkpoint_falls_back_to_the_one_before(whole, tmp_path):
    run_dir = tmp_path / "r"
    shutil.copytree(whole[0], run_dir)
    cli("--resume", "--run-dir", run_dir, "--steps", 1280)
    damage(run_dir / "checkpoints" / "10")
    out = cli("--resume", "--run-dir", run_dir, "--steps", 1408)
    assert "warning" in out and "resumed at train step 8" in out
    assert [r["step"] for r in records(run_dir)] == list(range(1, 12))


class TestErrors:
    """Each error is one line on stderr that starts with 'error:', with exit code 2 and no
    traceback."""

    @pytest.fixture
    def fails(self, capsys):
        def run(*args):
            assert train.main([str(a) for a in args]) == 2
            lines = capsys.readouterr().err.strip().splitlines()
            assert len(lines) == 1 and lines[0].startswith("error: "), lines
            return lines[0]

        return run

    def test_in_a_process_of_its_own(self):
        command = [sys.executable, "-m", "kslc_jax.train", "--preset", "lapto"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 2 and done.stdout == ""
        assert done.stderr.startswith("error: ") and len(done.stderr.splitlines()) == 1

    def test_unknown_preset(self, fails):
        assert "did you mean 'laptop'" in fails("--preset", "lapto")

    def test_unknown_ablation(self, fails):
        assert "arms" in fails("--preset", "debug", "--without", "armz")

    def test_bad_value_names_the_field(self, fails):
        assert "env.num_envs" in fails(*DEBUG, "--env.num-envs", "0")
        assert "minibatches" in fails(*DEBUG, "--ppo.minibatches", "7")

    def test_folder_with_a_training(self, whole, fails):
        before = (whole[0] / "metrics.jsonl").read_bytes()
        assert "--resume" in fails(*DEBUG, "--run-dir", whole[0])
        assert (whole[0] / "metrics.jsonl").read_bytes() == before

    def test_nothing_to_resume(self, tmp_path, fails):
        assert "no training" in fails("--resume", "--run-dir", tmp_path / "none")
        assert "--run-dir" in fails("--resume")

    def test_other_config_on_resume(self, whole, fails, monkeypatch):
        shapes = memory.shapes(preset("debug"))  # to trace each of the configs takes seconds
        monkeypatch.setattr(memory, "shapes", lambda config: shapes)
        line = fails("--resume", "--run-dir", whole[0], "--ppo.gamma", "0.9")
        assert "ppo.gamma" in line and "0.994" in line
        line = fails("--resume", "--run-dir", whole[0], "--preset", "laptop")
        assert "env.num_envs is 16" in line and "2048" in line
        assert "env.arms" in fails("--resume", "--run-dir", whole[0], *DEBUG, "--without", "arms")
        assert "unknown preset" in fails("--resume", "--run-dir", whole[0], "--preset", "lapto")

    def test_damaged_config(self, tmp_path, fails):
        (tmp_path / "config.json").write_text("{")
        assert "config.json is damaged" in fails("--resume", "--run-dir", tmp_path)
        (tmp_path / "config.json").write_text('{"schema": 1, "seeds": 0}')
        assert "unknown field seeds" in fails("--resume", "--run-dir", tmp_path)

    def test_all_checkpoints_gone(self, whole, tmp_path, fails):
        shutil.copytree(whole[0], tmp_path / "r")
        shutil.rmtree(tmp_path / "r" / "checkpoints")
        assert "no checkpoint" in fails("--resume", "--run-dir", tmp_path / "r", "--steps", "2048")

    def test_folder_in_use(self, whole, tmp_path, fails):
        shutil.copytree(whole[0], tmp_path / "r")
        with run_folder.locked(tmp_path / "r"):
            assert "in use" in fails("--resume", "--run-dir", tmp_path / "r", "--steps", "2048")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
    def test_unwritable_folder(self, tmp_path, fails):
        tmp_path.chmod(0o500)
        assert "cannot write" in fails(*DEBUG, "--run-dir", tmp_path / "r")

    def test_run_dir_below_a_file(self, tmp_path, fails):
        (tmp_path / "file").write_text("")
        assert "cannot write" in fails(*DEBUG, "--run-dir", tmp_path / "file" / "r")

    def test_policy_not_there(self):
        with pytest.raises(CheckpointError, match="no run, checkpoint or shipped"):
            kslc_jax.load_policy("no-such-policy")

    def test_policy_of_several_seeds(self, tmp_path):
        for seed in (0, 1):
            (tmp_path / f"seed-{seed}").mkdir()
            (tmp_path / f"seed-{seed}" / "config.json").write_text("{}")
        with pytest.raises(CheckpointError, match=r"several trainings, name one: .*/seed-0, .*1$"):
            kslc_jax.load_policy(tmp_path)
        with pytest.raises(ConfigError, match=r"several trainings, name one: .*/seed-0, .*1$"):
            following.Follower(tmp_path)

    def test_damaged_policy(self, whole, tmp_path):
        shutil.copytree(whole[0], tmp_path / "r")
        damage(tmp_path / "r" / "checkpoints" / "8")
        with pytest.raises(CheckpointError, match="no readable checkpoint"):
            kslc_jax.load_policy(tmp_path / "r")


def test_killed_before_its_first_checkpoint(whole, tmp_path, capsys):
    """Without a checkpoint a run cannot resume, and a new start may overwrite it. A run with more
    records is not overwritten."""
    run_dir = tmp_path / "r"
    (run_dir / "checkpoints").mkdir(parents=True)
    shutil.copy(whole[0] / "config.json", run_dir)
    (run_dir / "metrics.jsonl").write_text('{"step": 1}\n{"torn')
    assert train.main(["--resume", "--run-dir", str(run_dir)]) == 2
    assert "no checkpoint" in capsys.readouterr().err
    cli(*DEBUG, "--run-dir", run_dir)
    assert numbers(records(run_dir)) == numbers(records(whole[0]))
    shutil.rmtree(run_dir / "checkpoints")  # eight records remain
    assert train.main([*DEBUG, "--run-dir", str(run_dir)]) == 2
    assert "already holds a training" in capsys.readouterr().err


def test_the_first_train_step_is_saved_at_once(tmp_path):
    run = dataclasses.replace(preset("debug").run, steps=256, checkpoint_minutes=60.0)
    config = dataclasses.replace(preset("debug"), run=run)
    loop.train(config, tmp_path / "r", resume=False, progress=Progress(config))
    assert checkpoint.Store(tmp_path / "r").steps() == [1, 2]


def test_a_longer_run_is_remembered(whole, tmp_path):
    """The run folder stores the length that --resume --steps gives. A later --resume trains to the
    same end without --steps."""
    shutil.copytree(whole[0], tmp_path / "r")
    cli("--resume", "--run-dir", tmp_path / "r", "--steps", 1152)
    assert run_folder.read_config(tmp_path / "r").run.steps == 1152


def test_git_is_not_needed(monkeypatch):
    monkeypatch.setenv("PATH", "")
    versions = run_folder.versions()
    assert versions["git"] == "unknown" and versions["kslc_jax"] == kslc_jax.__version__


def test_an_edited_checkout_has_another_digest(tmp_path):
    """Two edited checkouts of one commit are both called `-dirty`."""
    (tmp_path / "part").mkdir()
    one, two = tmp_path / "a.py", tmp_path / "part" / "b.py"
    digests = []
    for path, text in ((one, "x = 1"), (two, "y = 1"), (two, "y = 2"), (one, "x = 2")):
        path.write_text(text)
        digests.append(run_folder._digest(tmp_path))
    one.rename(tmp_path / "c.py")
    digests.append(run_folder._digest(tmp_path))
    (tmp_path / "notes.txt").touch()
    assert len(set(digests)) == 5 and run_folder._digest(tmp_path) == digests[-1]
    ours = run_folder.versions()["code"]
    assert ours == run_folder._digest(Path(kslc_jax.__file__).parent)
    (tmp_path / files.VERSIONS).write_text('{"code": "before"}')
    said = run_folder.what_changed(tmp_path, {"code": ours, "jax": "of no run before"})
    assert said == f"with code {ours} instead of before (bits may differ from here)"


def test_versions_keep_variables_without_their_paths(monkeypatch):
    """`XLA_FLAGS` may also be the name of a file with flags."""
    kept = "--xla_a=2 --xla_b='x y' --xla_c=PATH --xla_d=PATH --xla_e=z PATH"
    text = kept
    for path in ("/home/" + "me/dump", '"my folder/dump"', "./flags"):
        text = text.replace("PATH", path, 1)
    monkeypatch.setenv("XLA_FLAGS", text)
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "0")
    versions = run_folder.versions()
    assert versions["XLA_FLAGS"] == kept and versions["NVIDIA_TF32_OVERRIDE"] == "0"
    monkeypatch.delenv("XLA_FLAGS")
    assert run_folder.versions()["XLA_FLAGS"] == ""


def git(folder: Path, *command: str) -> str:
    who = ("-c", "user.name=somebody", "-c", "user.email=somebody@example.org")
    argv = ["git", "-C", str(folder), *who, *command]
    return subprocess.run(argv, capture_output=True, text=True, check=True).stdout.strip()


def test_only_a_checkout_of_this_package_has_a_revision(tmp_path, monkeypatch):
    """Not the repository of somebody who has installed the package into it, also if all is added;
    and not the repository that a git hook runs in."""
    for top, known in (("", True), (".venv/lib/site-packages", False)):
        repository = tmp_path / f"repository-{known}"
        module = repository / top / "kslc_jax" / "training" / "run_folder.py"
        module.parent.mkdir(parents=True)
        module.touch()
        git(repository.parent, "init", "-q", str(repository))
        git(repository, "commit", "-q", "--allow-empty", "-m", "empty")
        assert run_folder._revision(module) == ""  # git does not track it yet
        git(repository, "add", "--force", ".")
        git(repository, "commit", "-q", "-m", "all")
        commit = git(repository, "rev-parse", "--short", "HEAD")
        assert run_folder._revision(module) == (commit if known else "")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "repository-True" / ".git"))
    assert run_folder._revision(module) == ""


def test_every_field_can_be_overridden():
    args = train.parse([*DEBUG, "--rewards.weights.joint-pos", "2.5", "--gait.no-random-phase"])
    assert args.config.rewards.weights.joint_pos == 2.5 and not args.config.gait.random_phase
    args = train.parse([*DEBUG, "--network.actor", "8", "4", "--randomize.kp", "0.8", "1.2"])
    assert args.config.network.actor == (8, 4) and args.config.randomize.kp == (0.8, 1.2)
    args = train.parse([*DEBUG, "--without", "arms", "cycle-curriculum", "--seed", "3"])
    assert args.config.env.arms == "held" and not args.config.curriculum.cycle
    assert args.config.seed == 3


def test_resume_difference_names_the_first_field():
    a = preset("debug")
    b = dataclasses.replace(a, gait=dataclasses.replace(a.gait, cycle_time=0.5))
    with pytest.raises(ConfigError, match=r"gait\.cycle_time is 0\.64.*not 0\.5"):
        same_training.difference(a, b)
    same_training.difference(a, dataclasses.replace(a, run=dataclasses.replace(a.run, steps=9)))


def test_metrics_behind_the_checkpoint_are_dropped(tmp_path):
    lines = [json.dumps({"step": s, "env_steps": s}) for s in (1, 2, 3)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + '\n{"step": 4, "torn')
    MetricsFile(tmp_path, after=2).close()
    assert (tmp_path / "metrics.jsonl").read_text().splitlines() == lines[:2]


def test_versions_known_to_hang_are_refused():
    for bad in ("0.10.0", "0.10.2", "0.11.0"):
        with pytest.raises(RuntimeError, match="pip install"):
            runtime.check_jax(bad, "cpu")
        runtime.check_jax(bad, "gpu")
    for good in ("0.7.2", "0.9.2", "0.11.1", "0.12.0.1"):
        runtime.check_jax(good, "cpu")


def test_progress_fits_into_80_columns():
    """The live table fits into 80 columns and cuts none of these values."""
    record = dict.fromkeys(
        ["env_steps", "steps_per_second", "seconds", "episode_steps", "tracking", "fast_tracking"],
        1.0,
    ) | {"curriculum/v_max": 3.5, "curriculum/cycle_time": 0.64, "reward/dof_acc": 481234.5}
    record["reward/feet_contact_number"] = 0.9231
    screen = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    progress = Progress(preset("laptop"), screen)
    screen.print(progress._table(record))
    out = screen.file.getvalue()
    for word in (
        "v_max",
        "3.5 m/s",
        "ETA",
        "1/2400",
        "feet_contact_number",
        "+2.7693",
        "4.812e+05",
    ):
        assert word in out
    assert max(map(len, out.splitlines())) <= 80


def test_progress_prints_a_line_without_a_terminal(capsys):
    record = dict.fromkeys(
        ["env_steps", "steps_per_second", "seconds", "episode_steps", "tracking", "fast_tracking"],
        1.0,
    ) | {"curriculum/v_max": 0.5, "curriculum/cycle_time": 0.64}
    Progress(preset("debug")).show(record)
    out = capsys.readouterr().out
    assert "steps/s 1" in out and "v_max 0.5 m/s" in out and len(out.splitlines()) == 1


def test_snapshots_come_in_the_order_of_their_steps(tmp_path):
    for step in (100, 1000, 200):
        (tmp_path / "snapshots" / str(step)).mkdir(parents=True)
    assert [path.name for path in learning.snapshots(tmp_path)] == ["100", "200", "1000"]


@pytest.mark.parametrize("there", [True, False])
def test_a_gpu_that_jax_does_not_use_is_told(there, tmp_path, monkeypatch):
    if there:
        (tmp_path / "nvidia0").touch()
    monkeypatch.setattr(runtime, "NVIDIA", tmp_path / "nvidia0")
    assert ("kslc_jax[cuda]" in runtime.idle_gpu()) == there
