"""Several seeds in one program: their folders, their numbers, stops, resumes and bad seeds."""

import dataclasses
import io
import json
import shutil
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import METRICS
from rich.console import Console

from kslc_jax import checkpoint_format, config, files, train, train_step
from kslc_jax import policy as policy_lib
from kslc_jax.config import preset
from kslc_jax.training import checkpoint, recorder, run_folder, seeds
from kslc_jax.training.logs import SeedsProgress

DEBUG = preset("debug")
STEPS = DEBUG.num_updates
COUNT = 3


def blank(like):
    """Zeros [COUNT, ...] for an array of one seed; for a random key, the keys 0, 1, ..."""
    if checkpoint_format.is_key(like):
        return jax.vmap(jax.random.key)(jnp.arange(COUNT))
    return jnp.zeros((COUNT, *like.shape), like.dtype)


@pytest.fixture(scope="module")
def like():
    """Shapes of the state of one seed.

    It has no environments and no optimiser, because a checkpoint takes time for each array."""
    state = jax.eval_shape(lambda: train_step.init(DEBUG, 0))
    none = {"none": jax.ShapeDtypeStruct((1,), jnp.float32)}
    return state.replace(env=none, learner=state.learner.replace(opt_state=none))


@pytest.fixture(scope="module")
def first_state(like):
    return jax.tree.map(blank, like)


def records(folder):
    rows = (folder / files.METRICS).read_text().splitlines()
    return [
        {k: v for k, v in json.loads(row).items() if not k.startswith(("seconds", "steps_per"))}
        for row in rows
    ]


def steps_of(folder):
    return [row["step"] for row in records(folder)]


@pytest.fixture
def training(first_state, tmp_path, monkeypatch):
    """Runs the command line with a program that only counts; its learning rate is its reward.

    `poison(state)` runs before each train step. Seeds with a NaN rate are not finite. The
    checkpoints of three seeds take more than a second, so there are few, and no snapshots.
    """
    due = recorder.Recorder.due
    monkeypatch.setattr(
        recorder.Recorder, "due", lambda self: due(self) or run.step in run.saved_at
    )

    def one_first_state():
        return seeds.one_of(first_state, 0)

    def run(poison=lambda state: state, *args):
        class Step:
            lower = compile = lambda self, *_: self

            def __call__(self, state):
                state = poison(state)
                state = state.replace(step=state.step + 1)
                run.step = int(state.step.max())
                rate = state.learner.learning_rate
                metrics = {name: np.full(COUNT, value) for name, value in METRICS.items()}
                metrics |= {"step": state.step, "finite": jnp.isfinite(rate), "reward": rate}
                return state, metrics

        monkeypatch.setattr(seeds, "make", lambda config, count: (lambda: first_state, Step()))
        monkeypatch.setattr(train_step, "make", lambda config: (one_first_state, None))
        rarely = ["--run.checkpoint-minutes", "60", "--run.snapshots", "0"]
        options = ["--preset", "debug", "--run-dir", run.dir, *rarely, *args]
        return train.main([str(x) for x in options])

    run.dir = tmp_path / "r"
    run.folders = [run.dir / f"seed-{i}" for i in range(COUNT)]
    run.saved_at = ()  # train steps with checkpoints, besides the first and the last one
    return run


def stop_at(step):
    def poison(state):
        if int(state.step[0]) == step:
            signal.raise_signal(signal.SIGTERM)
        return state

    return poison


def bad_from(step, *which):
    """The rates of these seeds become NaN after `step` train steps."""

    def poison(state):
        rate = state.learner.learning_rate
        bad = np.isin(np.arange(COUNT), which) & (np.asarray(state.step) == step)
        rate = jnp.where(bad, jnp.nan, rate)
        return state.replace(learner=state.learner.replace(learning_rate=rate))

    return poison


def test_each_seed_leaves_an_ordinary_run(training, like, capsys):
    snapshots = ("--run.snapshots", 2)
    assert training(lambda state: state, "--seeds", COUNT, "--seed", 0, *snapshots) == 0
    out = capsys.readouterr().out
    assert "3 seeds, each with 16 environments x 8 steps" in out and "3 seeds, " in out
    assert sorted(p.name for p in training.dir.iterdir()) == ["seed-0", "seed-1", "seed-2"]
    for seed, folder in enumerate(training.folders):
        config = run_folder.read_config(folder)
        assert config == dataclasses.replace(DEBUG, seed=seed, run=config.run)
        assert json.loads((folder / files.VERSIONS).read_text())["seeds"] == COUNT
        assert steps_of(folder) == list(range(1, STEPS + 1))
        assert checkpoint.Store(folder).steps()[-1] == STEPS
        kept = sorted(path.name for path in (folder / files.SNAPSHOTS).iterdir())
        assert kept == [str(STEPS // 2), str(STEPS)]
        policy = policy_lib.load_policy(folder)
        assert (policy.config.seed, policy.step) == (seed, STEPS)
        stored = checkpoint.Store(folder).restore(like, print)
        assert np.array_equal(jax.random.key_data(stored.key), [0, seed])


def test_a_stopped_training_goes_on_as_a_whole(training, capsys):
    assert training(stop_at(3), "--seeds", COUNT) == 0
    assert "stopped by SIGTERM at train step 4, saved; go on with" in capsys.readouterr().out
    assert [steps_of(folder) for folder in training.folders] == [[1, 2, 3, 4]] * COUNT
    assert training(lambda state: state, "--resume") == 0
    assert "resumed at train step 4" in capsys.readouterr().out
    file = training.folders[1] / "versions.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"python": "3.10.1"}))
    assert [steps_of(f) for f in training.folders] == [list(range(1, STEPS + 1))] * COUNT
    assert training(lambda state: state, "--resume") == 0
    out = capsys.readouterr().out
    assert "nothing to do" in out and " instead of 3.10.1" in out  # it looks at every seed
    assert train.main(["--resume", "--run-dir", str(training.folders[2])]) == 0
    out = capsys.readouterr().out
    assert out.startswith("resuming with seeds 1 instead of 3 (bits may differ from here): ")
    assert "nothing to do" in out


@pytest.mark.slow(reason="two trainings of three seeds, each with many saves")
def test_a_kill_between_two_saves_leaves_seeds_at_different_steps(training, capsys):
    """Each goes on from its own checkpoint; one without any begins. No record is lost or double."""
    training.saved_at = (3,)
    assert training(stop_at(3), "--seeds", COUNT) == 0
    shutil.rmtree(training.folders[1] / files.CHECKPOINTS / "4")
    shutil.rmtree(training.folders[2] / files.CHECKPOINTS)
    (training.folders[2] / files.METRICS).unlink()
    assert training(lambda state: state, "--resume") == 0
    assert "resumed at train step 0" in capsys.readouterr().out
    assert [steps_of(f) for f in training.folders] == [list(range(1, STEPS + 1))] * COUNT
    assert [checkpoint.Store(f).steps()[-1] for f in training.folders] == [STEPS] * COUNT


@pytest.mark.slow(reason="three trainings of three seeds")
def test_a_bad_seed_stops_alone_and_is_named(training, capsys):
    training.saved_at = (3, 4)
    assert training(bad_from(3, 1), "--seeds", COUNT) == 1
    out, err = capsys.readouterr()
    said = "seed-1: warning: the learner or the curriculum is not finite at train step 4"
    assert said in out.replace("\n", " ")
    assert err.startswith("error: 2 of 3 seeds are done") and len(err.splitlines()) == 1
    assert f"--resume --run-dir {training.folders[1]}" in err
    assert steps_of(training.folders[1]) == [1, 2, 3, 4]
    assert checkpoint.Store(training.folders[1]).steps()[-1] == 3, "a bad state was saved"
    for folder in (training.folders[0], training.folders[2]):
        assert steps_of(folder) == list(range(1, STEPS + 1))
        assert checkpoint.Store(folder).steps()[-1] == STEPS
    assert training(bad_from(3, 1), "--resume") == 1  # the others have nothing to do
    assert capsys.readouterr().err == err
    assert training(lambda state: state, "--resume") == 0  # now it is good: it catches up
    assert steps_of(training.folders[1]) == list(range(1, STEPS + 1))


@pytest.mark.slow(reason="two trainings of three seeds, each with many saves")
def test_a_bad_seed_far_behind_does_not_keep_the_others(training, capsys):
    """They end at their last train step, and then nobody waits for the bad one."""
    training.saved_at = (2, 3)
    assert training(stop_at(3), "--seeds", COUNT) == 0
    for step in "34":
        shutil.rmtree(training.folders[0] / files.CHECKPOINTS / step)
    assert training(bad_from(2, 0), "--resume") == 1
    assert "2 of 3 seeds are done; stopped: seed-0 (train step 3: " in capsys.readouterr().err
    assert steps_of(training.folders[0]) == [1, 2, 3]
    for folder in training.folders[1:]:
        assert steps_of(folder) == list(range(1, STEPS + 1))
        assert checkpoint.Store(folder).steps()[-1] == STEPS


@pytest.mark.slow(reason="two trainings of three seeds, each with many saves")
def test_a_seed_that_cannot_be_saved_does_not_end_the_others(training, monkeypatch, capsys):
    finish = recorder.Recorder.finish

    def fails(self, state, record):
        if self._run_dir.name == "seed-0":
            raise checkpoint_format.CheckpointError("no space")
        finish(self, state, record)

    monkeypatch.setattr(recorder.Recorder, "finish", fails)
    training.saved_at = (3, STEPS - 1)
    assert training(stop_at(3), "--seeds", COUNT) == 2
    assert capsys.readouterr().err == "error: no space\n"
    assert [checkpoint.Store(folder).steps()[-1] for folder in training.folders] == [3, 4, 4]
    assert training(lambda state: state, "--resume") == 1
    out, err = capsys.readouterr()
    assert "seed-0: warning: no space" in out
    assert err.startswith("error: 2 of 3 seeds are done; stopped: seed-0 (train step 8: no space)")
    saved = [checkpoint.Store(folder).steps()[-1] for folder in training.folders]
    assert saved == [STEPS - 1, STEPS, STEPS]


def test_no_good_seed_ends_it(training, capsys):
    assert training(bad_from(3, 0, 1, 2), "--seeds", COUNT) == 1
    assert capsys.readouterr().err.startswith("error: 0 of 3 seeds are done")
    assert [steps_of(folder) for folder in training.folders] == [[1, 2, 3, 4]] * COUNT


def test_folders_in_use_or_full_are_refused(training, capsys):
    assert training(stop_at(0), "--seeds", COUNT) == 0
    capsys.readouterr()
    assert training(lambda state: state, "--seeds", COUNT) == 2
    assert "already holds a training" in capsys.readouterr().err
    with run_folder.locked(training.folders[2]):
        assert training(lambda state: state, "--resume") == 2
    assert "seed-2 is in use" in capsys.readouterr().err
    assert training(lambda state: state, "--resume", "--seeds", 2) == 2
    assert "holds 3 seeds, not 2" in capsys.readouterr().err
    assert training(lambda state: state, "--seeds", COUNT, "--seed", COUNT) == 2
    assert "r already holds a training of 3 seeds: go on with --resume --run-dir " in (
        capsys.readouterr().err
    )
    with pytest.raises(run_folder.RunError, match="r already holds a training of 3 seeds"):
        run_folder.open_folder(training.dir, DEBUG, False, {})
    assert training(lambda state: state, "--resume", "--ppo.gamma", 0.9) == 2
    said = capsys.readouterr().err
    assert "ppo.gamma is 0.994 in the run that is there, not 0.9" in said
    assert "To begin a new one from the start: " in said
    assert f"--run-dir {training.dir}-2 --seeds {COUNT}" in said and "start-from" not in said
    assert sorted(training.dir.iterdir()) == training.folders
    shutil.rmtree(training.folders[1])
    assert training(lambda state: state, "--resume") == 2
    assert "holds the seeds 0, 2" in capsys.readouterr().err


def test_seeds_do_not_hide_in_the_folder_of_a_run(training, capsys):
    """--resume would go on with the run alone."""
    training.dir.mkdir()
    (training.dir / files.CONFIG).write_text("{}")
    (training.dir / files.METRICS).write_text("{}\n{}\n")
    assert training(lambda state: state, "--seeds", COUNT) == 2
    assert "r already holds a training: go on with" in capsys.readouterr().err
    assert training(lambda state: state, "--resume", "--seeds", COUNT) == 2
    (training.dir / files.CONFIG).write_text(json.dumps(config.to_dict(DEBUG)))
    capsys.readouterr()
    assert training(lambda state: state, "--resume", "--seeds", COUNT) == 2
    assert "holds a training of one seed, not 3 seeds" in capsys.readouterr().err


def test_more_seeds_than_memory(training, capsys):
    assert training(lambda state: state, "--seeds", "1e9") == 2
    assert "GiB: lower --seeds, env.num_envs, " in capsys.readouterr().err
    assert not training.dir.exists()


@pytest.mark.parametrize(
    "other",
    [
        ("--start-from", "xbot_l_run"),
        ("--profile", "2"),
        ("--wandb",),
        ("--devices", "2"),
        ("--coordinator", "auto"),
    ],
)
def test_what_cannot_be_combined(other, tmp_path, capsys):
    with pytest.raises(train.ConfigError, match=f"excludes {other[0]}"):
        train.parse(["--preset", "debug", "--seeds", "2", "--run-dir", str(tmp_path), *other])


@pytest.mark.parametrize("seeds", [0, -1, 2**31, "2.5", "many"])
def test_numbers_of_seeds(seeds):
    with pytest.raises(train.UserError, match="--seeds"):
        train.parse(["--preset", "debug", "--seeds", str(seeds), "--seed", "1"])


def test_table_has_median_lowest_and_highest():
    names = [*METRICS, "env_steps", "steps_per_second", "seconds"]
    rows = [dict.fromkeys(names, 1.0) | {"curriculum/v_max": v} for v in (0.5, 3.5, 1.0)]
    rows = [row | {"reward/dof_acc": 2.0 * i} for i, row in enumerate(rows)]
    screen = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    progress = SeedsProgress(preset("laptop"), screen)
    progress.records, progress.stopped = rows, ["seed-7"]
    screen.print(progress._table(rows[0]))
    out = screen.file.getvalue()
    assert "3 seeds, 3 steps/s in all; stopped: seed-7" in out
    (speeds,) = (line.split() for line in out.splitlines() if "v_max" in line)
    assert speeds == ["v_max", "1.0", "m/s", "0.5", "m/s", "3.5", "m/s"]
    (terms,) = (line.split() for line in out.splitlines() if "dof_acc" in line)
    assert terms == ["dof_acc", "2", "0", "4"]
    assert max(map(len, out.splitlines())) <= 80
    assert "v_max 1.0 m/s (0.5 m/s to 3.5 m/s)" in progress._line(rows[0])


ALONE = {"rtol": 1e-3, "atol": 1e-4}
"""XLA multiplies the matrices of all seeds in one batched product, which sums in another order. So
a seed agrees with its own single run to float32 rounding, for a few steps."""


@pytest.mark.slow(reason="compiles two programs of the train step")
def test_a_seed_computes_what_it_computes_alone():
    """The first states agree as well; without the compiler flags of these tests to the last bit."""
    together, step = seeds.make(DEBUG, 2)[0](), seeds.make(DEBUG, 2)[1]
    singles = [train_step.make(dataclasses.replace(DEBUG, seed=seed)) for seed in range(2)]
    states = [init() for init, _ in singles]
    for seed, state in enumerate(states):
        for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(together), strict=True):
            a, b = checkpoint_format.host_array(a), checkpoint_format.host_array(b)[seed]
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
    for _ in range(3):
        together, told = step(together)
        for seed, (_, single) in enumerate(singles):
            states[seed], metrics = single(states[seed])
            for name, value in metrics.items():
                np.testing.assert_allclose(told[name][seed], value, **ALONE, err_msg=name)
    for seed, state in enumerate(states):
        its = seeds.one_of(together, seed)
        for a, b in zip(jax.tree.leaves(its.learner), jax.tree.leaves(state.learner), strict=True):
            np.testing.assert_allclose(a, b, **ALONE)


@pytest.mark.slow(reason="compiles two programs of the train step")
def test_resumes_as_a_whole_bit_for_bit_and_alone(tmp_path):
    """Through the command line, in C MuJoCo."""

    def run(name, *args):
        where = ["--run-dir", str(tmp_path / name), "--run.snapshots", "0"]
        assert train.main([*where, *map(str, args)]) == 0

    def seed(name, number):
        return records(tmp_path / name / f"seed-{number}")

    run("whole", "--preset", "debug", "--seeds", 2, "--steps", 4 * DEBUG.batch_size)
    run("parts", "--preset", "debug", "--seeds", 2, "--steps", 2 * DEBUG.batch_size)
    run("parts", "--resume", "--steps", 3 * DEBUG.batch_size)
    assert [seed("parts", i) for i in range(2)] == [seed("whole", i)[:3] for i in range(2)]
    run("parts/seed-1", "--resume", "--steps", 4 * DEBUG.batch_size)
    alone, whole = seed("parts", 1)[3], seed("whole", 1)[3]
    assert alone["step"] == 4
    for name, value in whole.items():
        np.testing.assert_allclose(alone[name], value, **ALONE, err_msg=name)
