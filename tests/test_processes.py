"""Several processes of one training: their output, the files of the first one, and the end of all
when one stops, fails or dies.

The train step here only counts, so that it compiles fast; tests/test_devices.py uses the real one.
The processes run this file as a script.
"""

import contextlib
import shutil
import signal
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec
from processes import DEBUG, METRICS, alone, ended, rows, started, wait_for_rows

from kslc_jax import checkpoint_format, files, train, train_step
from kslc_jax import policy as policy_lib
from kslc_jax.config import preset
from kslc_jax.training import checkpoint, devices, recovery, run_folder

BATCH = preset("debug").batch_size

SLOW = pytest.mark.slow(reason="starts Python four times")

# -------------------------------------------------------------------------------- in the processes


def filled(like):
    """An array with the shape and type of `like`, full of numbers from 0 to -0.999. A scalar is 0,
    and a random key is key 0."""
    if checkpoint_format.is_key(like):
        return jax.random.key(0)
    numbers = np.arange(like.size).reshape(like.shape) % 1000 / 1000
    return jnp.asarray(-numbers if like.ndim else numbers, like.dtype)


def counting(bad):
    """Replaces `devices.make` by a train step that only counts, and reports bad numbers.

    bad: "never"; "once", from step 3 until the training goes back; "always", from step 3 on.
    """

    def make(config, mesh):
        like = jax.eval_shape(lambda: train_step.init(config, 0))
        placed = devices.shardings(mesh, like)
        everywhere = NamedSharding(mesh, PartitionSpec())

        def init():
            return jax.tree.map(filled, like).replace(step=jnp.zeros((), jnp.int32))

        def step(state):
            new = state.replace(step=state.step + 1)
            drawn_anew = jax.random.key_data(state.key).any() & (bad == "once")
            finite = (new.step < 3) | drawn_anew | (bad == "never")
            total = sum(jnp.sum(x.astype(jnp.float32)) for x in jax.tree.leaves(state.env))
            return new, {**METRICS, "finite": finite, "total": total}

        outputs = (placed, everywhere)
        jitted = jax.jit(step, donate_argnums=0, in_shardings=(placed,), out_shardings=outputs)
        return jax.jit(init, out_shardings=placed), jitted

    return make


def count(bad, *args):
    """`python -m kslc_jax.train` with the train step of `counting`."""
    devices.make = counting(bad)
    sys.exit(train.main(list(args)))


# ------------------------------------------------------------------------------------- the parent

COUNT = (__file__, "count", "never")
ON = ("--run.checkpoint-minutes", "1e-9", "--run.snapshots", "2", "--steps")


def stored(run_dir):
    """(train step, bytes of each number) of the latest checkpoint."""
    like = jax.eval_shape(lambda: train_step.init(preset("debug"), 0))
    with contextlib.closing(checkpoint.Store(run_dir)) as store:
        step, state = store.steps()[-1], store.restore(like, print)
    names = {
        jax.tree_util.keystr(path): checkpoint_format.host_array(x).tobytes()
        for path, x in jax.tree.leaves_with_path(state)
    }
    return step, {name: x for name, x in names.items() if name != ".step"}


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A training of three train steps by two processes with two devices each, and their output."""
    run_dir = tmp_path_factory.mktemp("two") / "r"
    with contextlib.ExitStack() as stack:
        processes = started(stack, *COUNT, *DEBUG, *ON, 3 * BATCH, "--run-dir", run_dir)
        return run_dir, ended(processes)


@SLOW
def test_the_first_process_alone_writes_and_speaks(two):
    run_dir, ((first, warnings), second) = two
    assert "on 4 of 4 devices (cpu), 2 processes" in first and "done: 3 train steps" in first
    assert not warnings and second == ("", "")
    assert [row["step"] for row in rows(run_dir)] == [1, 2, 3]
    assert len(list((run_dir / "tensorboard").iterdir())) == 1
    assert sorted(int(p.name) for p in (run_dir / "snapshots").iterdir()) == [2, 3]
    policy = policy_lib.load_policy(run_dir / "snapshots" / "2")
    assert policy.step == 2 and policy_lib.load_policy(run_dir).step == 3


@SLOW
def test_no_number_changes_with_the_number_of_devices(two, tmp_path):
    """Two processes with two devices each, then one with four, then two with two. Each training
    resumes the checkpoint of the one before and saves the same bits."""
    run_dir = tmp_path / "r"
    shutil.copytree(two[0], run_dir)
    step, first = stored(run_dir)
    assert step == 3 and len(first) > 40
    more = (*COUNT, "--resume", "--run-dir", run_dir, *ON)
    said = alone(*more, 4 * BATCH, devices=4)
    assert "4 of 4 devices" in said and "resumed at train step 3" in said
    assert stored(run_dir) == (4, first)
    with contextlib.ExitStack() as stack:
        (said, _), _ = ended(started(stack, *more, 6 * BATCH))
    assert "resumed at train step 4" in said
    assert stored(run_dir) == (6, first)
    totals = [row["total"] for row in rows(run_dir)]
    assert totals == pytest.approx([totals[0]] * 6)


@SLOW
def test_a_signal_to_one_process_stops_all(tmp_path):
    run_dir = tmp_path / "r"
    with contextlib.ExitStack() as stack:
        processes = started(stack, *COUNT, *DEBUG, "--steps", 10**7, "--run-dir", run_dir)
        wait_for_rows(run_dir, 3, processes)
        processes[1].send_signal(signal.SIGTERM)
        (first, _), _ = ended(processes)
    last = rows(run_dir)[-1]["step"]
    assert f"stopped by a signal to another process at train step {last}, saved" in first
    assert stored(run_dir)[0] == last


@SLOW
def test_all_go_back_where_numbers_are_bad(tmp_path):
    run_dir = tmp_path / "r"
    with contextlib.ExitStack() as stack:
        once = (__file__, "count", "once", *DEBUG, *ON, 4 * BATCH, "--run-dir", run_dir)
        (first, _), second = ended(started(stack, *once))
    assert "back to train step 2" in first and "done: 4 train steps, saved" in first
    assert second == ("", "")
    assert [row["step"] for row in rows(run_dir)] == [1, 2, 3, 4]


@SLOW
def test_all_give_up_where_that_does_not_help(tmp_path):
    run_dir = tmp_path / "r"
    with contextlib.ExitStack() as stack:
        always = (__file__, "count", "always", *DEBUG, *ON, 4 * BATCH, "--run-dir", run_dir)
        (_, first), second = ended(started(stack, *always), code=1)
    assert "error: the learner" in first and "doctor replay" in first
    assert second == ("", "")
    config, state = recovery.read_dump(run_dir / files.BAD_STATE)
    assert config.env.num_envs == state.env.time.shape[0] == 16


@SLOW
def test_what_stops_the_first_process_stops_all(two):
    """Here the first process refuses to overwrite a run folder."""
    with contextlib.ExitStack() as stack:
        started_again = started(stack, *COUNT, *DEBUG, *ON, BATCH, "--run-dir", two[0])
        (_, first), (_, second) = ended(started_again, code=2)
    assert "already holds a training" in first and len(first.splitlines()) == 1
    assert second == "error: the first process gave up, see what it says\n"


@SLOW
@pytest.mark.parametrize("lost", [0, 1])
def test_the_death_of_one_process_ends_the_other(tmp_path, lost):
    """Afterwards the run folder is unlocked, and its checkpoint is readable."""
    run_dir = tmp_path / "r"
    with contextlib.ExitStack() as stack:
        processes = started(stack, *COUNT, *DEBUG, "--steps", 10**7, "--run-dir", run_dir)
        wait_for_rows(run_dir, 3, processes)
        processes[lost].kill()
        processes[1 - lost].communicate(timeout=1500)
        assert processes[1 - lost].returncode != 0
    assert stored(run_dir)[0] >= 1
    with run_folder.locked(run_dir):
        pass


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
