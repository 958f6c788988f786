"""Faults in a training: bad numbers, full disks, damaged files, a second process in its folder."""

import ast
import asyncio
import contextlib
import copy
import dataclasses
import functools
import json
import os
import pickle
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import slow
from processes import METRICS

from kslc_jax import (
    checkpoint_format,
    doctor,
    files,
    fingerprint,
    physics,
    ppo,
    robot,
    rollout,
    runtime,
    train,
    train_step,
)
from kslc_jax import policy as policy_lib
from kslc_jax.checkpoint_format import CheckpointError
from kslc_jax.checkup import trials
from kslc_jax.config import XBOT_L, preset, to_dict
from kslc_jax.robots import description
from kslc_jax.training import loop, memory, recorder, recovery, run_folder
from kslc_jax.training.checkpoint import Store
from kslc_jax.training.logs import MetricsFile

ROOT = Path(__file__).parents[1]
DEBUG = preset("debug")


@pytest.fixture(scope="module")
def made():
    """Debug preset: (init, compiled step)."""
    init, step = train_step.make(DEBUG)
    return init, step.lower(init()).compile()


@pytest.fixture(scope="module", params=["mujoco", *slow.cases("compiles MJX", "mjx")])
def either(request, made):
    """`made` with each engine."""
    if request.param == "mujoco":
        return made
    physics_config = dataclasses.replace(DEBUG.physics, engine=request.param)
    init, step = train_step.make(dataclasses.replace(DEBUG, physics=physics_config))
    return init, step.lower(init()).compile()


@pytest.fixture(scope="module")
def healthy(either):
    """The numbers of the environments after the first train step."""
    init, step = either
    return numbers(step(init())[0].env)


@pytest.fixture(scope="module")
def like():
    """Shapes of the debug preset's state."""
    return jax.eval_shape(lambda: train_step.init(DEBUG, 0))


@pytest.fixture(scope="module")
def state_at(like):
    """Gives a state at a train step, full of random numbers, to fill checkpoints."""

    def leaf(x):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.key(0)
        return jnp.asarray(np.random.default_rng(0).normal(size=x.shape), x.dtype)

    state = jax.tree.map(leaf, like)
    return lambda step: state.replace(step=jnp.asarray(step, jnp.int32))


def numbers(tree):
    return [checkpoint_format.host_array(x) for x in jax.tree.leaves(tree)]


def same(a, b):
    pairs = zip(numbers(a), numbers(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)


def the_error(capsys):
    """The one line with the error. Other lines are ignored: threads of orbax from an earlier test
    with a full disk may still write tracebacks."""
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
    return line


def put(tree, where, value, rows=slice(None)):
    """A copy of `tree` with `value` in some rows of a field. `where` is the dotted path of it."""
    name, _, rest = where.partition(".")
    old = tree[name] if isinstance(tree, dict) else getattr(tree, name)
    new = put(old, rest, value, rows) if rest else old.at[rows].set(value)
    return {**tree, name: new} if isinstance(tree, dict) else tree.replace(**{name: new})


# ---------------------------------------------------------------------------------- bad numbers

SEEN_AT_ONCE = [
    *("physics.qpos", "physics.qvel", "physics.qacc_warmstart", "physics.sensordata"),
    *("physics.torque", "dynamics.kp", "gait.phase", "command.velocity", "history"),
    *("privileged_history", "last_action", "last_last_action", "last_base_velocity", "push"),
]
SEEN_LATER = {"last_last_action": 2, "physics.qvel": 1}  # samples lost to an overflow by 1e30


class TestEnvironments:
    """A bad environment loses its samples only. Update, curriculum and other environments stay
    good."""

    def assert_contained(self, either, healthy, where, value, rows, lost):
        init, step = either
        new, metrics = step(put(init(), f"env.{where}", value, rows))
        assert all(np.isfinite(x).all() for x in numbers(new) if x.dtype.kind == "f")
        assert all(np.isfinite(value) for value in metrics.values())
        assert metrics["broken"] == lost / DEBUG.batch_size
        assert metrics["ppo/skipped"] == 0 and metrics["finite"] == 1
        others = np.delete(np.arange(DEBUG.env.num_envs), rows)
        kept = [[x[others] for x in environments] for environments in (numbers(new.env), healthy)]
        assert same(*kept)

    @pytest.mark.parametrize("value", [jnp.nan, *slow.cases("masked like NaN", jnp.inf)])
    @pytest.mark.parametrize("where", SEEN_AT_ONCE)
    def test_one(self, either, healthy, where, value):
        self.assert_contained(either, healthy, where, value, slice(3, 4), lost=1)

    @pytest.mark.parametrize("where", SEEN_AT_ONCE)
    def test_all(self, either, healthy, where):
        self.assert_contained(either, healthy, where, jnp.nan, slice(None), lost=DEBUG.env.num_envs)

    @pytest.mark.parametrize(("where", "lost"), SEEN_LATER.items())
    def test_overflow_in_mid_rollout(self, either, healthy, where, lost):
        """The state is finite at the start, so that the step itself makes the bad number."""
        self.assert_contained(either, healthy, where, 1e30, slice(3, 4), lost)


class TestLearner:
    """Masking cannot repair a bad learner or curriculum: the metrics `finite` and `ppo/skipped`
    show it."""

    @pytest.mark.parametrize(
        "where",
        [
            "learner.params.actor.Dense_0.kernel",
            "learner.params.critic.Dense_1.kernel",
            "learner.learning_rate",
            "curriculum.tracking",
            "curriculum.v_max",
        ],
    )
    def test_not_finite(self, either, where):
        init, step = either
        _, metrics = step(put(init(), where, jnp.nan, ...))
        assert metrics["finite"] == 0

    def test_optimiser(self, either):
        init, step = either
        state = init()
        bad = jax.tree.map(
            lambda x: x * jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else x,
            state.learner.opt_state,
        )
        _, metrics = step(state.replace(learner=state.learner.replace(opt_state=bad)))
        assert metrics["finite"] == 0

    def test_gradient(self, either):
        """The critic is so large that its loss overflows. Every update is skipped, and the learner
        does not change."""
        init, step = either
        state = put(init(), "learner.params.critic.Dense_0.kernel", 1e30, ...)
        before = jax.tree.map(jnp.copy, state.learner)
        new, metrics = step(state)
        assert metrics["ppo/skipped"] == 1 and metrics["finite"] == 1
        assert same(new.learner, before)


# ------------------------------------------------------------------------------------- going back


@pytest.fixture(scope="module")
def counting(like, state_at):
    """Gives the command line with a train step that only counts: `training` below."""
    shapes, finite = memory.shapes(DEBUG), jax.jit(rollout.finite)
    whole, none = state_at(0), {"none": jnp.zeros(1)}
    small = whole.replace(env=none, learner=whole.learner.replace(opt_state=none))

    def make(monkeypatch, folder):
        def run(poison, *args):
            class Step:
                lower = compile = lambda self, *_: self

                def __call__(self, state):
                    run.step = int(state.step) + 1
                    state = poison(state)
                    metrics = METRICS | {
                        "finite": finite(state.learner.params),
                        "ppo/skipped": jnp.isinf(state.learner.learning_rate),
                        "broken": run.broken(run.step - 1),
                    }
                    return state.replace(step=state.step + 1), metrics

            first = whole if run.whole else small
            monkeypatch.setattr(train_step, "make", lambda config: (lambda: first, Step()))
            rarely = ["--run.checkpoint-minutes", "60", "--run.snapshots", "0"]
            options = ["--preset", "debug", "--run-dir", run.dir, *rarely, *args]
            return train.main([str(x) for x in options])

        due = recorder.Recorder.due
        monkeypatch.setattr(
            recorder.Recorder, "due", lambda self: due(self) or run.step in run.saved_at
        )
        # The step that counts has the shapes of the debug preset; tracing others takes seconds.
        monkeypatch.setattr(memory, "shapes", lambda config: shapes)
        run.dir = folder
        run.whole = False  # True: with environments and optimiser, which a dump must have
        run.saved_at = ()  # train steps with a checkpoint, besides the first and the last one
        run.broken = lambda step: 0.0  # share of the samples, after so many train steps
        return run

    return make


@pytest.fixture
def training(counting, tmp_path, monkeypatch):
    """Runs the command line with a train step that only counts. `poison(state)` runs before it.

    The metrics report a NaN parameter as not finite, and an infinite learning rate as a skipped
    update. Each checkpoint takes most of a second, so there are few, and no snapshots. It takes
    time for each array, so the state is small."""
    return counting(monkeypatch, tmp_path / "r")


def nan_actor(state):
    return put(state, "learner.params.actor.Dense_0.kernel", jnp.nan, ...)


def steps_of(run_dir):
    return [json.loads(x)["step"] for x in (run_dir / "metrics.jsonl").read_text().splitlines()]


class TestGoingBack:
    def test_once_bad_goes_back_and_finishes(self, training, capsys):
        seen = []

        def poison(state):
            seen.append(int(state.step))
            return nan_actor(state) if seen[-1] == 5 and seen.count(5) == 1 else state

        training.saved_at = range(5, 8)
        assert training(poison, "--run.snapshots", 8) == 0
        out = capsys.readouterr().out
        assert "warning: the learner or the curriculum is not finite; back to train step 5" in out
        assert "attempt 1 of 3" in out and "done: 8 train steps, saved" in out
        assert steps_of(training.dir) == list(range(1, 9))
        policy = policy_lib.load_policy(training.dir)
        assert policy.step == 8

    def test_always_bad_stops_with_one_line_and_a_dump(self, training, capsys, state_at):
        def poison(state):
            return nan_actor(state) if int(state.step) == 5 else state

        training.saved_at, training.whole = range(5, 9), True
        assert training(poison) == 1
        said = capsys.readouterr()
        assert [f"attempt {i} of 3" in said.out for i in (1, 2, 3, 4)] == [True] * 3 + [False]
        (line,) = said.err.splitlines()
        assert line.startswith("error: the learner") and "doctor replay" in line
        assert Store(training.dir).steps()[-1] == 5, "a bad state was saved"
        config, state = recovery.read_dump(training.dir / files.BAD_STATE)
        assert config == DEBUG and same(state.learner.params, state_at(5).learner.params)

    def test_no_finite_gradient_for_long(self, training, capsys, monkeypatch):
        monkeypatch.setattr(recovery, "PATIENCE", 3)

        def poison(state):
            rate = state.learner.learning_rate if int(state.step) < 3 else jnp.inf
            return put(state, "learner.learning_rate", rate, ...)

        training.saved_at, training.whole = range(3, 9), True
        assert training(poison) == 1
        said = capsys.readouterr()
        assert "not one finite gradient in 3 train steps; back to train step 3" in said.out
        assert int(recovery.read_dump(training.dir / files.BAD_STATE)[1].step) == 3

    def test_bad_before_the_first_checkpoint_starts_anew(self, training, capsys):
        once = [True]

        def poison(state):
            return nan_actor(state) if once and once.pop() else state

        assert training(poison) == 0
        assert "back to train step 0" in capsys.readouterr().out

    def test_cautious(self, state_at):
        state = state_at(3)
        new = recovery.with_lower_rate(state, 2)
        assert new.learner.learning_rate == pytest.approx(0.25 * state.learner.learning_rate)
        assert new.learner.rate_ceiling == new.learner.learning_rate
        assert new.key != state.key and same(new.learner.params, state.learner.params)

    def test_caution_lasts(self, made):
        """The KL rule raises a lowered learning rate by at most 2 % a train step."""
        init, step = made
        state = recovery.with_lower_rate(init(), 1)
        low = float(state.learner.learning_rate)
        assert low == pytest.approx(0.5 * DEBUG.ppo.learning_rate)
        for i in range(1, 4):
            state, metrics = step(state)
            assert float(metrics["ppo/learning_rate"]) <= low * ppo.CEILING_GROWTH**i * 1.00001

    @pytest.mark.slow(reason="compiles the rollout step by step")
    def test_replay_shows_where(self, made, tmp_path, capsys, monkeypatch):
        """A number that overflows in the first control step, in one environment."""
        monkeypatch.setattr(train_step, "make", lambda config: made)
        path = tmp_path / "dump.npz"
        state = put(made[0](), "env.last_last_action", 1e30, slice(3, 4))
        recovery.dump(path, DEBUG, state)
        assert same(recovery.read_dump(path)[1], state)
        assert doctor.main(["replay", str(path)]) == 0
        out = capsys.readouterr().out.splitlines()
        assert out[0] == "train step 1 is the first with a number that is not finite:"
        where = "  control step 1 of 8: rollout.outcome.terms.action_smoothness, environments 3"
        assert where in out and not any("after" in line for line in out)

    def test_no_dump(self, tmp_path, capsys):
        (tmp_path / "x.npz").write_bytes(pickle.dumps("no dump"))
        assert doctor.main(["replay", str(tmp_path / "x.npz")]) == 2
        assert "is no dump" in capsys.readouterr().err


class TestBrokenSamples:
    """Many are said, and all of them for long end a training; both patience 10 train steps."""

    LONG = ("--steps", 40 * 128)

    def test_ten_train_steps_with_many_are_said_once(self, training, capsys):
        training.broken = lambda step: 0.02 if 5 <= step < 30 else 0.01
        assert training(lambda state: state, *self.LONG) == 0
        out = capsys.readouterr().out
        assert out.count("warning: ") == 1 and "done: 40 train steps" in out
        assert "in each of the last 10 train steps more than 1% of the samples were broken" in out
        assert "2.0% in the last one" in out

    def test_a_second_spell_is_said_again(self, training, capsys):
        training.broken = lambda step: 0.0 if step == 15 else 0.5
        assert training(lambda state: state, *self.LONG) == 0
        assert capsys.readouterr().out.count("warning: ") == 2

    def test_nine_are_not(self, training, capsys):
        training.broken = lambda step: 0.0 if step % 10 == 9 else 0.99
        assert training(lambda state: state, *self.LONG) == 0
        assert "warning" not in capsys.readouterr().out

    def test_all_for_long_end_it_with_one_line(self, training, capsys):
        training.broken = lambda step: 1.0 if step >= 5 else 0.0
        training.saved_at, training.whole = range(5, 41), True
        assert training(lambda state: state, *self.LONG) == 1
        said = capsys.readouterr()
        assert "every sample was broken in 10 train steps; back to train step 5" in said.out
        (line,) = said.err.splitlines()
        assert line.startswith("error: every sample was broken in 10 train steps, also after 3")
        assert Store(training.dir).steps()[-1] == 5, "a state that learnt nothing was saved"
        assert int(recovery.read_dump(training.dir / files.BAD_STATE)[1].step) == 5

    def test_a_short_training_is_not_done_either(self, training, capsys):
        training.broken = lambda step: 1.0
        training.saved_at = range(1, 9)
        assert training(lambda state: state) == 1
        said = capsys.readouterr()
        assert (
            said.err == "error: every sample was broken in all 8 train steps: nothing is learnt\n"
        )
        assert "done" not in said.out and Store(training.dir).steps() == [8]

    def test_the_last_steps_alone_are_no_failure(self, training, capsys):
        training.broken = lambda step: 1.0 if step >= 5 else 0.0
        assert training(lambda state: state) == 0
        assert "done: 8 train steps" in capsys.readouterr().out


# ----------------------------------------------------------------------------------- circumstances


class TestAround:
    """A training survives closed outputs and signals, and runs in threads and notebook cells."""

    @staticmethod
    def closed_output(monkeypatch):
        reader, writer = os.pipe()
        stream = os.fdopen(writer, "w")
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "__stdout__", stream)
        return reader

    def test_its_output_is_closed_on_the_way(self, training, monkeypatch):
        """`| head -n 2`, a pager that is left, tee at Ctrl-C."""
        reader = self.closed_output(monkeypatch)

        def poison(state):
            if int(state.step) == 3:
                os.close(reader)
            return state

        assert training(poison) == 0
        assert steps_of(training.dir) == list(range(1, 9))
        assert Store(training.dir).steps()[-1] == 8

    def test_stopped_with_its_output_closed(self, training, monkeypatch):
        os.close(self.closed_output(monkeypatch))

        def poison(state):
            if int(state.step) == 3:
                signal.raise_signal(signal.SIGHUP)
            return state

        assert training(poison) == 0
        assert Store(training.dir).steps()[-1] == 4

    @pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGUSR1"])
    def test_a_signal_while_it_compiles(self, name, training, monkeypatch, capsys):
        """It does one train step, so that there is something to resume."""
        compiles = loop.first_state_and_step

        def signalled(*args):
            signal.raise_signal(getattr(signal, name))
            return compiles(*args)

        monkeypatch.setattr(loop, "first_state_and_step", signalled)
        assert training(lambda state: state) == 0
        assert f"stopped by {name} at train step 1, saved" in capsys.readouterr().out
        assert Store(training.dir).steps() == [1]

    @pytest.mark.parametrize("name", ["SIGHUP", "SIGUSR1"])
    def test_warnings_stop_like_sigterm(self, name, training, capsys):
        def poison(state):
            if int(state.step) == 3:
                signal.raise_signal(getattr(signal, name))
            return state

        assert training(poison) == 0
        assert f"stopped by {name} at train step 4, saved" in capsys.readouterr().out
        assert Store(training.dir).steps()[-1] == 4

    @pytest.mark.parametrize(
        ("name", "at", "last"),
        [
            ("SIGUSR1", 4, 5),
            *slow.cases(
                "two trainings with many saves",
                *(("SIGTERM", 4, 6), ("SIGUSR1", 8, 8), ("SIGTERM", 8, 8)),
            ),
        ],
    )
    def test_signals_while_it_saves(self, name, at, last, training, monkeypatch, capsys):
        """Nothing is lost. SIGUSR1 comes twice: before the save that begins after train step `at`,
        and before the wait for it, which is after the next one. SIGTERM comes at the wait."""
        save, wait, sent = Store.save, Store.wait, []

        def send():
            if name == "SIGUSR1" or not sent:
                sent.append(name)
                signal.raise_signal(getattr(signal, name))

        def noisy_save(store, state, *rest):
            store.noisy = int(state.step) == at
            if store.noisy and name == "SIGUSR1":
                send()
            save(store, state, *rest)

        def noisy_wait(store):
            if store.__dict__.pop("noisy", False):
                send()
            wait(store)

        monkeypatch.setattr(Store, "save", noisy_save)
        monkeypatch.setattr(Store, "wait", noisy_wait)
        training.saved_at = range(1, 9)
        assert training(lambda state: state) == 0
        said = "done: 8 train" if last == 8 else f"stopped by {name} at train step {last}"
        assert said in capsys.readouterr().out and sent
        monkeypatch.setattr(Store, "save", save)
        monkeypatch.setattr(Store, "wait", wait)
        assert Store(training.dir).steps()[-1] == last
        assert training(lambda state: state, "--resume", "--steps", 1280) == 0
        assert steps_of(training.dir) == list(range(1, 11))

    def test_in_a_thread(self, training, capsys):
        codes = []
        snapshots = ("--run.snapshots", 2)
        thread = threading.Thread(
            target=lambda: codes.append(training(lambda state: state, *snapshots))
        )
        thread.start()
        thread.join()
        assert codes == [0] and "done: 8 train steps" in capsys.readouterr().out

    def test_in_a_thread_that_nobody_waits_for(self):
        """Python forbids new threads as soon as the main thread has ended."""
        code = (
            "import threading; from kslc_jax import train; threading.Thread("
            "target=lambda: print(train.main(['--preset', 'debug']))).start()"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.stdout == "2\n" and done.stderr.count("\n") == 1
        assert "thread.join()" in done.stderr

    def test_in_a_notebooks_cell_twice(self, training, capsys):
        """A cell runs within an event loop; its output has no file descriptor."""

        async def cell():
            first = training(lambda state: state, "--run.snapshots", 2)
            return first, training(lambda state: state, "--resume", "--steps", 1280)

        assert asyncio.run(cell()) == (0, 0)
        assert "done: 10 train steps" in capsys.readouterr().out
        assert steps_of(training.dir) == list(range(1, 11))


def files_of(folder):
    """The content of every file of a folder, without locks."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}


@pytest.fixture(scope="module")
def finished(counting, tmp_path_factory):
    """The run folder of a training of 8 train steps, 1024 environment steps."""
    folder = tmp_path_factory.mktemp("finished") / "r"
    with pytest.MonkeyPatch.context() as patch:
        assert counting(patch, folder)(lambda state: state) == 0
    return folder


class TestResume:
    """The messages of --resume, and the files that it keeps."""

    @pytest.fixture
    def done(self, finished, training, capsys):
        """Goes on with a copy of the finished training; what it says."""
        shutil.copytree(finished, training.dir)

        def resume(*args, code=0):
            capsys.readouterr()
            assert training(lambda state: state, "--resume", *args) == code
            said = capsys.readouterr()
            return said.err if code else said.out

        resume.dir = training.dir
        return resume

    @pytest.mark.parametrize(
        ("steps", "says"),
        [
            (100, "has done 1024 environment steps, more than the 100 that --steps asks for"),
            ("1024", "has done 1024 environment steps, all of the 1024 that --steps asks for"),
        ],
    )
    def test_nothing_is_left_to_do(self, steps, says, done):
        before = files_of(done.dir)
        out = done("--steps", steps)
        assert "nothing to do: " in out and says in out
        assert "compiled" not in out and "done:" not in out
        assert files_of(done.dir) == before

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            (["--ppo.learning-rate", "3e-4"], "ppo.learning_rate is 0.001 in the run that is"),
            (["--env.num-envs", "32"], "env.num_envs is 16 in the run that is there, not 32"),
            (["--seed", "5"], "seed is 0 in the run that is there, not 5"),
            (["--env.frames", "4"], "env.frames is 3 in the run that is there, not 4"),
        ],
    )
    def test_another_config_names_the_command(self, change, says, done, monkeypatch):
        """The command in the message gives the config that was asked for."""
        before = files_of(done.dir)
        line = done(*change, code=2)
        assert says in line and len(line.splitlines()) == 1
        command = shlex.split(line.rpartition(": ")[2])
        assert command[:3] == ["python", "-m", "kslc_jax.train"]
        args = train.parse(command[3:])
        assert args.config == train.parse(["--preset", "debug", *change]).config
        assert args.run_dir == done.dir.with_name("r-2") and not args.run_dir.exists()
        same_networks = "--env.frames" not in change
        assert args.start_from == (done.dir if same_networks else None)
        assert files_of(done.dir) == before

    def test_other_versions(self, done, monkeypatch):
        path = done.dir / "versions.json"
        first = json.loads(path.read_text())
        assert first["engine"] == "mujoco" and first["devices"] == 1
        old = first | {"jax": "0.8.0", "python": "3.10.1", "engine": "mjx", "devices": 4}
        old |= {"cpu": "another", "XLA_FLAGS": ""}
        path.write_text(json.dumps(old))
        line = done("--steps", 1152).splitlines()[0]
        assert line.startswith("resuming with ") and "(bits may differ from here)" in line
        for said in (
            f"jax {first['jax']} instead of 0.8.0",
            f"python {first['python']} instead of 3.10.1",
            "engine mujoco instead of mjx",
            "devices 1 instead of 4",
            f"cpu {first['cpu']} instead of another",
            f"XLA_FLAGS {first['XLA_FLAGS']} instead of none",
        ):
            assert said in line
        kept = json.loads(path.read_text())
        (news,) = kept.pop("resumed")
        assert kept == old
        changed = ("jax", "python", "engine", "devices", "cpu", "XLA_FLAGS")
        assert news == {"train_step": 8} | {name: first[name] for name in changed}
        assert done("--steps", 1280).startswith("resuming: ")  # as the last time
        assert len(json.loads(path.read_text())["resumed"]) == 1

    @pytest.mark.parametrize("content", [None, "{", "[]", '{"resumed": 3}', '{"jax": "0.8.0"}'])
    def test_versions_that_say_less(self, content, done):
        """Older runs name fewer; the file may be damaged. No number depends on it."""
        path = done.dir / "versions.json"
        path.unlink() if content is None else path.write_text(content)
        out = done("--steps", 1152)
        assert out.startswith("resuming with jax" if content and "jax" in content else "resuming: ")
        assert json.loads(path.read_text())["resumed"][0]["jax"] == jax.__version__


# ------------------------------------------------------------------------------------- full disks


@pytest.fixture
def disk(tmp_path):
    """A folder on its own disk of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], capture_output=True
    )
    if done.returncode:
        pytest.skip("mounting is not allowed here")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextlib.contextmanager
def longest_file(size):
    """No file may grow beyond `size` bytes. It imitates a full disk without the right to mount."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture(scope="module")
def save(state_at):
    """Writes checkpoints of these train steps into a run folder."""

    def write(run_dir, *steps):
        with contextlib.closing(Store(run_dir)) as store:
            for step in steps:
                store.save(state_at(step), DEBUG, METRICS | {"step": step})

    return write


@pytest.fixture(scope="module")
def written(save, tmp_path_factory):
    """Gives a run folder with the checkpoints of these train steps. It is written once."""

    @functools.cache
    def folder(*steps):
        run_dir = tmp_path_factory.mktemp("written")
        save(run_dir, *steps)
        return run_dir

    return folder


@pytest.fixture
def saved(written):
    """Fills a run folder with copies of checkpoints, which a test may damage."""
    return lambda run_dir, *steps: shutil.copytree(written(*steps), run_dir, dirs_exist_ok=True)


@pytest.fixture
def restored(like):
    """Gives (train step, warnings) of the checkpoint from which a run folder would resume."""

    def restore(run_dir):
        said = []
        with contextlib.closing(Store(run_dir)) as store:
            state = store.restore(like, said.append)
        return int(state.step), said

    return restore


def test_no_checkpoint_names_a_folder(save, restored, tmp_path):
    """Run folders are published. Orbax would write where they were."""
    save(tmp_path, 1, 2)
    stored = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(stored) > 20 and not [p for p in stored if bytes(tmp_path) in p.read_bytes()]
    assert restored(tmp_path) == (2, [])


class TestFullDisk:
    @pytest.mark.slow(reason="on a mounted disk; below is a quicker full disk")
    def test_save_fails_in_one_line_and_leaves_nothing(self, saved, restored, state_at, disk):
        saved(disk, 1)
        (disk / "filler").write_bytes(bytes(shutil.disk_usage(disk).free - 60_000))
        with contextlib.closing(Store(disk)) as store:
            with pytest.raises(CheckpointError, match="no space left on the disk; those before"):
                store.save(state_at(2), DEBUG, METRICS)
                store.wait()
            assert [p.name for p in store.folder.iterdir()] == ["1"]
            (disk / "filler").unlink()
            store.save(state_at(3), DEBUG, METRICS)
        assert restored(disk) == (3, [])

    def test_too_long_a_file(self, saved, restored, state_at, tmp_path):
        """The same without the right to mount. The failure does not disturb the next save."""
        saved(tmp_path, 1)
        with contextlib.closing(Store(tmp_path)) as store:
            with longest_file(2000), pytest.raises(CheckpointError, match="could not save"):
                store.save(state_at(2), DEBUG, METRICS)
                store.wait()
            store.save(state_at(3), DEBUG, METRICS)
        assert restored(tmp_path) == (3, [])

    def test_training_goes_on_and_says_so(self, training, disk, capsys):
        """The disk fills after the third train step and has room again after the sixth."""
        filler = disk / "filler"
        shutil.rmtree(training.dir, ignore_errors=True)
        training.dir.symlink_to(disk)

        def poison(state):
            if int(state.step) == 3:
                with filler.open("wb") as file, contextlib.suppress(OSError):
                    file.write(bytes(2**20))
            if int(state.step) == 6:
                filler.unlink()
            return state

        training.saved_at = (4, 5, 7)
        assert training(poison, "--run.keep", 1) == 0
        out = capsys.readouterr().out
        assert "warning: could not save a checkpoint" in out and "training goes on" in out
        assert steps_of(disk) == list(range(1, 9))
        assert Store(disk).steps()[-1] == 8

    def test_the_last_save_fails(self, training, disk, capsys):
        """One line, and the checkpoint before stays."""
        shutil.rmtree(training.dir, ignore_errors=True)
        training.dir.symlink_to(disk)

        def poison(state):
            if int(state.step) == 7:
                patience, kept = time.monotonic() + 60, disk / "checkpoints"
                # The checkpoint before must be gone, too: removing it makes room again.
                while [*kept.glob("[0-9]*")] != [kept / "4"] and time.monotonic() < patience:
                    time.sleep(0.05)
                with (disk / "filler").open("wb") as file, contextlib.suppress(OSError):
                    file.write(bytes(2**20))
            return state

        training.saved_at = (4,)
        assert training(poison, "--run.keep", 1) == 2
        assert "could not save" in the_error(capsys)
        assert Store(disk).steps()[-1] == 4

    def test_metrics_are_completed_when_there_is_room_again(self, tmp_path):
        said, record = [], {"step": 1, "env_steps": 1, "x": 0.5}
        file = MetricsFile(tmp_path, warn=said.append)
        file.write(record)
        size = file.path.stat().st_size
        with longest_file(size + 10):
            for step in (2, 3):
                file.write(record | {"step": step})
            assert file.path.stat().st_size == size + 10
        file.write(record | {"step": 4})
        file.close()
        assert steps_of(tmp_path) == [1, 2, 3, 4] and len(said) == 1

    def test_old_metrics_survive_a_resume_without_room(self, tmp_path):
        lines = "".join(json.dumps({"step": i, "env_steps": i}) + "\n" for i in range(200))
        (tmp_path / "metrics.jsonl").write_text(lines)
        with longest_file(1000), pytest.raises(OSError):
            MetricsFile(tmp_path, after=150)
        assert (tmp_path / "metrics.jsonl").read_text() == lines
        assert [p.name for p in tmp_path.iterdir()] == ["metrics.jsonl"]

    def test_read_only(self, disk, capsys):
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        for folder in (disk, disk / "new"):
            assert train.main(["--preset", "debug", "--run-dir", str(folder)]) == 2
            line = the_error(capsys)
            assert line.startswith(f"error: cannot write to {folder}: Read-only")


# ---------------------------------------------------------------------------------- damaged files


def flip_bits(folder):
    """Flips one bit at three places of the folder's largest file.

    One place is not enough: it can lie in an old index of orbax, which nobody reads (1 of 250 times
    on a busy machine).
    """
    path = max(folder.iterdir(), key=lambda p: p.stat().st_size)
    data = bytearray(path.read_bytes())
    for quarter in (1, 2, 3):
        data[quarter * len(data) // 4] ^= 4
    path.write_bytes(data)


class TestDamage:
    @pytest.mark.parametrize(
        "item", ["params", *slow.cases("orbax reads them like params", "core", "env")]
    )
    def test_flipped_bits(self, saved, save, restored, tmp_path, item):
        """The bits are in the numbers, where orbax itself finds no error."""
        saved(tmp_path, 1, 2)
        flip_bits(tmp_path / "checkpoints" / "2" / item / "ocdbt.process_0" / "d")
        step, (warning,) = restored(tmp_path)
        assert step == 1 and "checkpoint 2 is damaged" in warning and "1 is used" in warning
        assert {p.name for p in (tmp_path / "checkpoints").iterdir()} == {"1", "damaged-2"}
        save(tmp_path, 2)  # the damaged folder does not prevent the save
        assert restored(tmp_path) == (2, [])

    @pytest.mark.parametrize("item", ["params", "core", "env", "meta"])
    def test_missing(self, saved, restored, tmp_path, item):
        saved(tmp_path, 1, 2)
        shutil.rmtree(tmp_path / "checkpoints" / "2" / item)
        step, (warning,) = restored(tmp_path)
        assert step == 1 and "damaged" in warning

    @pytest.fixture
    def carried(self, saved, like, tmp_path):
        """Gives (the whole state, the state restored without environments, warnings)."""
        saved(tmp_path, 1, 2)

        def restore():
            said = []
            with contextlib.closing(Store(tmp_path)) as store:
                whole = store.restore(like, said.append)
            for step in ("1", "2"):
                shutil.rmtree(tmp_path / "checkpoints" / step / "env")
            with contextlib.closing(Store(tmp_path)) as store:
                return whole, store.restore(like, said.append), said

        return restore

    def test_a_run_that_was_carried_without_environments(self, carried, monkeypatch):
        """Everything else is as it was saved. The new episodes are of the curriculum there."""
        asked = []
        monkeypatch.setattr(train_step, "new_episodes", lambda *x: asked.append(x) or "episodes")
        whole, state, (warning,) = carried()
        assert "checkpoint 2 has no environments, all robots begin new episodes" in warning
        assert state.env == "episodes"
        assert same(whole.replace(env=None), state.replace(env=None))
        ((config, key, step, curriculum),) = asked
        assert config == DEBUG and step == 2 and key == whole.key
        assert same(curriculum, whole.curriculum)

    @pytest.mark.slow(reason="compiles the reset of the environments")
    def test_new_episodes_begin_at_all_ages(self, carried, like):
        """As in a new training: else all episodes would end at the same time."""
        _, state, _ = carried()
        assert jax.eval_shape(lambda: state.env) == like.env and rollout.finite(state.env)
        ages = np.sort(state.env.time)
        assert ages[0] < 0.3 * DEBUG.episode_steps and ages[-1] > 0.7 * DEBUG.episode_steps
        assert (state.env.command_until > state.env.time).all()

    def test_policy_with_flipped_bits(self, saved, restored, tmp_path):
        saved(tmp_path, 1)
        flip_bits(tmp_path / "checkpoints" / "1" / "params" / "ocdbt.process_0" / "d")
        # Orbax finds damage in the index, the checksum finds it in the numbers.
        said = "the numbers of 'params' are not those|Encountered error while reading"
        with pytest.raises(CheckpointError, match=said):
            policy_lib.load_policy(tmp_path)

    def test_changed_meta(self, saved, restored, tmp_path):
        edit_meta(saved(tmp_path, 1), lambda meta: meta["config"].update(seed=7))
        with pytest.raises(CheckpointError, match="the numbers of 'meta' are not those"):
            policy_lib.load_policy(tmp_path)


def edit_meta(run_dir, change):
    (path,) = (run_dir / "checkpoints").glob("*/meta/metadata")
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


class TestSchema:
    OLD = ROOT / "tests" / "data" / "checkpoint-schema-1"
    """A checkpoint with two environments and two hidden units, after one train step."""

    def test_policy_of_schema_1(self):
        policy = policy_lib.load_policy(self.OLD)
        assert policy.step == 1
        action = policy.act_on(jnp.full((1, 59), 0.5))
        written = [0.00246058, 0.00342976, -0.00067609, 0.00228753]
        np.testing.assert_allclose(action[:4], written, rtol=1e-4)

    def test_training_of_schema_1_says_why_not(self, tmp_path, capsys):
        run = shutil.copytree(self.OLD, tmp_path / "run")
        (run / "versions.json").write_text('{"jax": "0.1.0"}')
        before = files_of(run)
        assert train.main(["--resume", "--run-dir", str(run)]) == 2
        line = the_error(capsys)
        ours = checkpoint_format.SCHEMA_VERSION
        assert f"checkpoint schema 1, this kslc_jax goes on from {ours}" in line
        assert "--start-from" in line
        assert files_of(run) == before

    def test_policies_of_all_older_schemas_load(self, saved, tmp_path):
        assert tuple(range(1, checkpoint_format.SCHEMA_VERSION)) == checkpoint_format.OLDER_POLICIES
        for schema in checkpoint_format.OLDER_POLICIES:
            older = {"schema": schema, "checksums": {}}
            edit_meta(
                saved(tmp_path / str(schema), 1), lambda meta, older=older: meta.update(older)
            )
            assert policy_lib.load_policy(tmp_path / str(schema)).step == 1

    def test_tree_of_this_schema(self, like):
        """A change of the tree needs a new SCHEMA_VERSION. Else old checkpoints fail with errors of
        orbax."""
        stored = (
            ROOT / "tests" / "data" / f"train_state_schema_{checkpoint_format.SCHEMA_VERSION}.txt"
        )
        leaves = [
            f"{jax.tree_util.keystr(where)} {x.dtype} {x.ndim}"
            for where, x in jax.tree.leaves_with_path(like)
        ]
        assert leaves == stored.read_text().splitlines()

    def test_without_checksums_loads(self, saved, restored, tmp_path):
        edit_meta(saved(tmp_path, 1), lambda meta: meta.pop("checksums"))
        assert restored(tmp_path) == (1, [])
        assert policy_lib.load_policy(tmp_path).step == 1

    def test_newer_says_why_not(self, saved, restored, tmp_path):
        edit_meta(saved(tmp_path, 1), lambda meta: meta.update(schema=99))
        for load in (policy_lib.load_policy, restored):
            with pytest.raises(CheckpointError, match="checkpoint schema 99, this kslc_jax reads"):
                load(tmp_path)

    def test_newer_config_says_why_not(self, saved, restored, tmp_path):
        def newer(meta):
            meta["config"]["schema"] = 99
            del meta["checksums"]

        edit_meta(saved(tmp_path, 1), newer)
        with pytest.raises(CheckpointError, match="schema version 99"):
            policy_lib.load_policy(tmp_path)

    def test_another_robot(self, saved, restored, tmp_path):
        def other(meta):
            meta["robot"]["name"] = "XBot-S"
            del meta["checksums"]

        edit_meta(saved(tmp_path, 1), other)
        for load in (policy_lib.load_policy, restored):
            with pytest.raises(CheckpointError, match=r"another robot, .*XBot-S.*XBot-L"):
                load(tmp_path)


@pytest.fixture
def edit_robot(tmp_path, monkeypatch):
    """Changes the robot's MJCF, for this process, from one text to another."""

    def edit(old: str, new: str) -> None:
        text = description.read(XBOT_L).mjcf.read_text()
        assert old in text
        path = tmp_path / "robot.xml"
        path.write_text(text.replace(old, new, 1))
        described = dataclasses.replace(description.read(XBOT_L), mjcf=path)
        monkeypatch.setattr(description, "read", lambda name: described)
        monkeypatch.setattr(robot, "load", functools.lru_cache(robot.load.__wrapped__))

    return edit


MASS = 'mass="21.081917"'
CHANGES = {
    MASS: ('mass="9.5"', "mass of base_link 21.0819 -> 9.5"),
    'kp="15"': ('kp="30"', "kp of left_ankle_pitch_joint 15 -> 30, kp of left_ankle_roll_joint"),
    'armature="0.01"': ('armature="0.02"', "armature of left_leg_roll_joint 0.01 -> 0.02, "),
    'pos="-0.01987378 ': ('pos="-0.02987378 ', "inertias"),
}
"""A text of the MJCF, what takes its place, and what is said of it."""


def swung(model):
    """[steps, ...] positions and sensors of a robot whose joints follow a sine for 0.4 s."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.keyframe("home").id)
    data.qvel[:] = 0.0  # a reset of an episode sets its own
    target, rows = data.qpos[7:].copy(), []
    for step in range(round(0.4 / model.opt.timestep)):
        data.ctrl[:] = target + 0.3 * np.sin(0.04 * step)
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.sensordata]))
    return np.array(rows)


class TestChangedRobot:
    """A training or a policy of a robot that has other numbers now."""

    def test_the_same_robot_is_no_word(self, saved, restored, tmp_path):
        saved(tmp_path, 1)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert restored(tmp_path) == (1, [])
            policy_lib.load_policy(tmp_path)

    @pytest.mark.parametrize("old", CHANGES)
    def test_every_kind_of_change_is_named(self, edit_robot, old):
        new, said = CHANGES[old]
        before = fingerprint.fingerprint(XBOT_L)
        assert fingerprint.changes(before, before) == ""
        edit_robot(old, new)
        found = fingerprint.changes(before, fingerprint.fingerprint(XBOT_L))
        assert found.startswith(said) and len(found) < 200

    @pytest.mark.parametrize("fidelity", fingerprint.FIDELITIES)
    def test_every_number_that_moves_the_robot_counts(self, fidelity):
        """A change of any array of the model that changes a simulation changes the fingerprint."""
        biped = robot.load(fidelity, name=str(Path(__file__).parent / "data" / "biped.toml"))
        before, path = fingerprint._digests(biped), swung(biped.mj_model)
        silent = set()
        for name in dir(biped.mj_model):
            numbers = getattr(biped.mj_model, name)
            if not (isinstance(numbers, np.ndarray) and numbers.size and numbers.dtype.kind == "f"):
                continue
            model = copy.copy(biped.mj_model)
            getattr(model, name)[...] = 1.1 * numbers + 0.003
            if not np.array_equal(path, swung(model), equal_nan=True):
                now = fingerprint._digests(dataclasses.replace(biped, mj_model=model))
                silent |= {name} if now == before else set()
        values = {"actuator_gainprm", "actuator_biasprm", "jnt_range", "dof_armature", "body_mass"}
        values.add("key_qpos")
        derived = {"body_invweight0", "dof_invweight0", "body_subtreemass", "geom_rbound"}
        assert "body_mass" in silent and silent <= values | derived

    @pytest.mark.parametrize(
        "name", ["actuator_trnid", "sensor_objid", "sensor_refid", "geom_type", "body_parentid"]
    )
    def test_what_belongs_to_what_counts(self, name):
        """Other whole numbers of the model would crash MuJoCo, so this asks for the checksum."""
        model = copy.copy(robot.load("high").mj_model)
        before = fingerprint._digests(robot.load("high"))
        getattr(model, name)[-1] += 1
        changed = dataclasses.replace(robot.load("high"), mj_model=model)
        assert fingerprint._digests(changed) != before

    def test_every_option_of_the_simulation_counts(self):
        """The config has the time step and the iterations."""
        xbot = robot.load()
        before = fingerprint._digests(xbot)
        names = {name for name in dir(xbot.mj_model.opt) if not name.startswith("_")}
        assert {"noslip_iterations", "jacobian", "o_margin", "wind"} < names
        for name in names - {"timestep", "iterations", "ls_iterations"}:
            model = copy.copy(xbot.mj_model)
            setattr(model.opt, name, getattr(model.opt, name) + 1)
            now = fingerprint._digests(dataclasses.replace(xbot, mj_model=model))
            assert len({g for g in before if before[g] != now[g]}) == 1, name

    def test_resume_and_policy_say_so(self, saved, restored, tmp_path, edit_robot):
        saved(tmp_path, 1)
        edit_robot(MASS, 'mass="9.5"')
        step, said = restored(tmp_path)
        assert step == 1 and len(said) == 1
        assert re.search("changed since checkpoint 1: .*mass of base_link .* -> 9.5; from", said[0])
        with pytest.warns(
            UserWarning, match=r"robot has changed since .*base_link .* -> 9\.5"
        ) as w:
            policy = policy_lib.load_policy(tmp_path)
        assert len(w) == 1 and "\n" not in str(w[0].message)
        policy_lib.save_policy(policy, tmp_path / "copy")  # is still of the old robot
        with pytest.warns(UserWarning, match="base_link"):
            policy_lib.load_policy(tmp_path / "copy")

    def test_older_checkpoints_have_no_numbers_and_load_without_a_word(
        self, saved, restored, tmp_path, edit_robot
    ):
        def older(meta):
            del meta[checkpoint_format.ROBOT_NUMBERS], meta["checksums"]

        edit_meta(saved(tmp_path, 1), older)
        edit_robot(MASS, 'mass="9.5"')
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert restored(tmp_path) == (1, [])
            policy = policy_lib.load_policy(tmp_path)
            policy_lib.save_policy(policy, tmp_path / "copy")
            assert policy_lib.load_policy(tmp_path / "copy").robot is None

    def test_a_shipped_policy_knows_its_robot(self, edit_robot):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            policy_lib.load_policy("xbot_l_run")
        edit_robot('kp="350"', 'kp="700"')
        with pytest.warns(UserWarning, match=r"^xbot_l_run: .*kp of left_\w+ 350 -> 700"):
            policy_lib.load_policy("xbot_l_run")

    def test_both_fidelities_count(self, monkeypatch):
        """Joint friction acts at high fidelity only."""
        before = fingerprint.fingerprint(XBOT_L)
        described = description.read(XBOT_L)
        rubs = ("ankle", description.Motor(friction=0.123))
        changed = dataclasses.replace(described, motors=(*described.motors, rubs))
        monkeypatch.setattr(description, "read", lambda name: changed)
        monkeypatch.setattr(robot, "load", functools.lru_cache(robot.load.__wrapped__))
        said = fingerprint.changes(before, fingerprint.fingerprint(XBOT_L))
        assert said == "joint friction and damping at high fidelity"


class Bomb:
    """Writes a file when unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


class TestNoPickle:
    FORBIDDEN = frozenset(
        {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
    )

    @pytest.mark.parametrize(
        "path", sorted((ROOT / "kslc_jax").rglob("*.py")), ids=lambda p: p.stem
    )
    def test_nothing_unpickles(self, path):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & self.FORBIDDEN
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in ("eval", "exec", "jnp.load")
                allowed = {k.arg: ast.unparse(k.value) for k in node.keywords}
                assert allowed.get("allow_pickle", "False") == "False"

    @pytest.mark.slow(reason="reads a checkpoint once for each of its files")
    def test_a_pickle_in_place_of_any_file_does_nothing(self, saved, restored, tmp_path):
        source = saved(tmp_path / "source", 1)
        mark = tmp_path / "mark"
        files = [p.relative_to(source) for p in source.rglob("*") if p.is_file()]
        assert len(files) > 15
        for file in files:
            copy = tmp_path / "copy"
            shutil.copytree(source, copy)
            (copy / file).write_bytes(pickle.dumps(Bomb(mark)))
            if {"params", "meta"} & set(file.parts):  # the rest of a checkpoint no policy reads
                with contextlib.suppress(CheckpointError):
                    policy_lib.load_policy(copy)
            with contextlib.suppress(CheckpointError):
                restored(copy)
            shutil.rmtree(copy)
        dump = tmp_path / "bomb.npz"
        np.savez(dump, config=np.array([Bomb(mark)], dtype=object))
        with pytest.raises(CheckpointError):
            recovery.read_dump(dump)
        assert not mark.exists()


# --------------------------------------------------------------------------------- locks and hangs


class TestLock:
    def test_names_the_process(self, tmp_path, capsys):
        with run_folder.locked(tmp_path):
            assert train.main(["--preset", "debug", "--run-dir", str(tmp_path)]) == 2
        line = the_error(capsys)
        assert line == f"error: {tmp_path} is in use by another process, id {os.getpid()}"
        assert [p.name for p in tmp_path.iterdir()] == [".lock"]

    def test_death_releases(self, tmp_path):
        code = (
            "import time; from pathlib import Path; from kslc_jax.training import run_folder\n"
            f"with run_folder.locked(Path({str(tmp_path)!r})):\n"
            "    print('locked', flush=True); time.sleep(99)"
        )
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert process.stdout.readline() == "locked\n"
        with (
            pytest.raises(run_folder.RunError, match=f"id {process.pid}"),
            run_folder.locked(tmp_path),
        ):
            pass
        process.kill()
        process.wait()
        with run_folder.locked(tmp_path):
            assert (tmp_path / ".lock").read_text() == str(os.getpid())


class TestNoHang:
    @pytest.mark.parametrize("args", [["--preset", "debug"], [], ["--resume"]])
    def test_bad_jax_is_refused_on_every_path(self, args, tmp_path, monkeypatch, capsys):
        if args == ["--resume"]:
            (tmp_path / "config.json").write_text(json.dumps(to_dict(preset("debug"))))
        monkeypatch.setattr(jax, "__version__", "0.10.2")
        assert train.main([*args, "--run-dir", str(tmp_path)]) == 2
        assert "jax 0.10.2 can hang" in capsys.readouterr().err

    def test_watchdog_shows_where(self, capfd):
        dog = runtime.Watchdog(factor=2.0, least=0.2, first=0.2)
        with dog.step():
            time.sleep(0.01)
        assert not capfd.readouterr().err
        with dog.step():
            time.sleep(0.8)
        err = capfd.readouterr().err
        assert "takes longer than" in err and "test_watchdog_shows_where" in err

    def test_watchdog_does_not_count_a_pause(self):
        """As when a laptop sleeps."""
        child = """if True:
            import time
            from kslc_jax import runtime
            with runtime.Watchdog(first=1.0).step():
                print("in the step", flush=True)
                time.sleep(0.3)
        """
        pipe = subprocess.PIPE
        with subprocess.Popen([sys.executable, "-c", child], stdout=pipe, stderr=pipe) as process:
            assert process.stdout and process.stdout.readline() == b"in the step\n"
            process.send_signal(signal.SIGSTOP)
            time.sleep(1.5)
            process.send_signal(signal.SIGCONT)
            assert process.communicate(timeout=60) == (b"", b"")

    def test_watchdogs_limit(self):
        dog = runtime.Watchdog()
        assert dog.limit() == 600.0
        dog._seconds.extend([1.0, 1.0, 100.0])
        assert dog.limit() == 60.0
        dog._seconds.extend([10.0] * 9)
        assert dog.limit() == 200.0


# ----------------------------------------------------------------------------------------- doctor


class TestDoctor:
    def test_table_and_exit_code(self, monkeypatch, capsys):
        good, bad = ("disk", lambda: "room", "buy one"), ("jax", lambda: 1 / 0, "install another")
        monkeypatch.setattr(doctor, "CHECKS", (good,))
        assert doctor.main([]) == 0
        assert "pass" in (out := capsys.readouterr().out) and "room" in out and "buy" not in out
        monkeypatch.setattr(doctor, "CHECKS", (good, bad))
        assert doctor.main(["check"]) == 1
        out = capsys.readouterr().out
        assert "FAIL" in out and "division by zero" in out and "install another" in out

    def test_a_package_that_cannot_be_imported_is_no_traceback(self, monkeypatch, capsys):
        """The table must also work on machines with a broken JAX or orbax."""
        for name in ("jax", "orbax.checkpoint", "kslc_jax.policy"):
            monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.setattr(doctor, "CHECKS", (("jax", doctor.check_jax, "install another"),))
        assert doctor.main(["check"]) == 1
        assert "install another" in capsys.readouterr().out

    def test_what_is_quick_passes_here(self):
        for check in (doctor.check_python, doctor.check_jax, doctor.check_cores):
            assert check()

    def test_faults_are_seen(self, tmp_path, monkeypatch):
        (tmp_path / "file").touch()
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "file"))
        monkeypatch.setattr(jax, "__version__", "0.11.0")
        monkeypatch.setattr(doctor, "FREE_DISK", 1e9)
        monkeypatch.setattr(trials, "engines_apart", lambda name: 1e-3)
        for check in (doctor.check_cache, doctor.check_jax, doctor.check_disk):
            with pytest.raises((OSError, RuntimeError)):
                check()
        with pytest.raises(RuntimeError, match=r"1\.0e-03 rad apart after 20 steps"):
            doctor.check_engines()

    @pytest.mark.slow(reason="compiles the physics with both engines")
    def test_engines_agree(self):
        assert "rad apart" in doctor.check_engines()


# ------------------------------------------------------------------------------------ determinism


def twenty_steps(init, step):
    state, rows = init(), []
    for _ in range(20):
        state, metrics = step(state)
        rows.append({name: float(value).hex() for name, value in metrics.items()})
    return rows, checkpoint_format.checksum(state)


class TestDeterminism:
    @pytest.mark.slow(reason="sixty train steps; of the physics alone test_physics says it")
    def test_two_inits_and_any_number_of_threads(self, made, monkeypatch):
        """Metrics and state are bit-identical. The step is compiled once; only the simulator's
        number of threads changes."""
        init, step = made
        rows, real = [twenty_steps(init, step)], physics._batch
        used = []
        for threads in (1, 2):

            def batch(robot, size, _, written, threads=threads):
                used.append(threads)
                return real(robot, size, threads, written)

            monkeypatch.setattr(physics, "_batch", batch)
            rows.append(twenty_steps(init, step))
        assert {*used} == {1, 2}
        assert rows[0] == rows[1] == rows[2]

    @pytest.mark.slow(reason="compiles a train step with each engine, twice")
    @pytest.mark.parametrize("engine", ["mujoco", "mjx"])
    def test_two_processes(self, engine, like, tmp_path):
        """Two processes with the same seed, one with one physics thread and one with two."""
        rows, sums = [], []
        for i in (1, 2):
            args = ["--preset", "debug", "--steps", 20 * 128, "--run-dir", tmp_path / str(i)]
            args += ["--physics.engine", engine, "--physics.threads", i]
            command = [sys.executable, "-m", "kslc_jax.train", *map(str, args)]
            subprocess.run(command, check=True, capture_output=True)
            text = (tmp_path / str(i) / "metrics.jsonl").read_text()
            rows.append([json.loads(line) for line in text.splitlines()])
            with contextlib.closing(Store(tmp_path / str(i))) as store:
                sums.append(checkpoint_format.checksum(store.restore(like, pytest.fail)))
        wall_clock = ("seconds", "steps_per_second")
        a, b = ([{k: v for k, v in r.items() if k not in wall_clock} for r in x] for x in rows)
        assert len(a) == 20 and a == b and sums[0] == sums[1]


# ------------------------------------------------------------------------------------------ kills


@pytest.mark.slow(reason="starts five trainings, each of which compiles")
def test_kills(tmp_path):
    """The kill test in small: after two SIGKILLs and one SIGTERM the metrics are bit-identical."""
    command = [sys.executable, str(ROOT / "benchmarks" / "kill_test.py"), "--kills", "2"]
    command += ["--terms", "1", "--folder", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=550)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 of" in done.stdout and signal.SIGKILL.name in done.stdout
