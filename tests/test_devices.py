"""A training on several devices or processes gives the numbers of one device.

XLA reads the number of CPU devices only when it starts. Most of these tests therefore run in other
processes. Each runs this file as a script, and calls the function that its command line names.
"""

import contextlib
import dataclasses
import functools
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import DEBUG, TRAIN, alone, command, ended, free_port, rows, started
from states import XBOT

from kslc_jax import checkpoint_format, env, observations, train, train_step
from kslc_jax.config import ConfigError, preset
from kslc_jax.training import checkpoint, devices

STEPS = 3
MJX = dataclasses.replace(
    preset("debug"), physics=dataclasses.replace(preset("debug").physics, engine="mjx")
)


# -------------------------------------------------------------------------------- in the processes


def glide(config, state, target, dynamics, ground_friction):
    """Physics that compiles fast: the joints move towards their targets, and nothing else moves."""
    qpos = state.qpos.at[7:].set(0.9 * state.qpos[7:] + 0.1 * target)
    return state.replace(qpos=qpos, torque=target)


def numbers(tree) -> dict[str, np.ndarray]:
    return {
        jax.tree_util.keystr(path): checkpoint_format.host_array(x)
        for path, x in jax.tree.leaves_with_path(tree)
    }


def learn(folder, engine):
    """Trains on 1 and on 4 devices. Then each does the last step from the other's checkpoint."""
    folder = Path(folder)
    if engine == "glide":
        env.step = functools.partial(env.step, simulate=glide)
    meshes = {count: devices.mesh(MJX, jax.devices()[:count]) for count in (1, 4)}
    steps = {}
    for count, mesh in meshes.items():
        init, step = devices.make(MJX, mesh)
        state = init()
        steps[count] = step.lower(state).compile()
        (folder / f"{count}.txt").write_text(steps[count].as_text())
        for _ in range(STEPS - 1):
            state, _ = steps[count](state)
        with contextlib.closing(checkpoint.Store(folder / str(count))) as store:
            store.save(state, MJX, {checkpoint.BEST_METRIC: 0.0})
        np.savez(folder / f"{count}-saved.npz", **numbers(state))
        state, metrics = steps[count](state)
        np.savez(folder / f"{count}.npz", **numbers((state.learner, metrics)))
    for before, after in ((1, 4), (4, 1)):
        with contextlib.closing(checkpoint.Store(folder / str(before))) as store:
            state = store.restore(jax.eval_shape(init), print)
        state, metrics = steps[after](devices.place(meshes[after], state))
        np.savez(folder / f"{before}-to-{after}.npz", **numbers((state.learner, metrics)))


def learn_together(out, port, index, processes="2"):
    """Trains on the devices of all processes."""
    devices.join(f"127.0.0.1:{port}", int(processes), int(index))
    assert jax.device_count() == int(processes) * jax.local_device_count()
    init, step = devices.make(MJX, devices.mesh(MJX))
    state = init()
    compiled = step.lower(state).compile()
    devices.meet()
    state, metrics = run(compiled, state, STEPS)
    np.savez(out, **numbers((state.learner, metrics)))


def command_line(*args):
    """`python -m kslc_jax.train` with cheap physics."""
    env.step = functools.partial(env.step, simulate=glide)
    sys.exit(train.main(list(args)))


def run(step, state, steps):
    metrics = {}
    for _ in range(steps):
        state, metrics = step(state)
    return state, metrics


# ------------------------------------------------------------------------------------- the parent


GLIDE = (__file__, "command_line")


def assert_same_training(a, b, tolerance=1e-3):
    """Both run folders have the same metrics, apart from the wall clock."""
    assert len(rows(a)) == len(rows(b))
    for one, other in zip(rows(a), rows(b), strict=True):
        for name in set(one) - {"seconds", "steps_per_second"}:
            assert one[name] == pytest.approx(other[name], rel=tolerance, abs=0.1 * tolerance), name


def latest(run_dir):
    """(train step, numbers) of the latest checkpoint."""
    with contextlib.closing(checkpoint.Store(run_dir)) as store:
        return store.steps()[-1], numbers(store.restore(like(), print))


def learnt(folder, engine):
    how = command(__file__, "learn", folder, engine, forced=4)
    done = subprocess.run(**how, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    return folder


SLOW = pytest.mark.slow(reason="compiles the train step three times for four devices")


@pytest.fixture(scope="module")
def glided(tmp_path_factory):
    """The folder that `learn` wrote with the physics of `glide`."""
    return learnt(tmp_path_factory.mktemp("glide"), "glide")


@pytest.fixture(scope="module")
def stepped(tmp_path_factory):
    """The folder that `learn` wrote with MJX."""
    return learnt(tmp_path_factory.mktemp("mjx"), "mjx")


def assert_close(a: Path, b: Path, tolerance=1e-3):
    """The devices add in another order: a mean over 128 joint accelerations differs by up to 2e-4
    on some machines."""
    with np.load(a) as one, np.load(b) as other:
        assert set(one) == set(other) and len(one) > 50
        for name in one:
            np.testing.assert_allclose(
                one[name], other[name], rtol=tolerance, atol=0.1 * tolerance, err_msg=name
            )


@SLOW
def test_four_devices_learn_what_one_learns(glided):
    assert_close(glided / "1.npz", glided / "4.npz")


@SLOW
@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 1)])
def test_checkpoints_move_between_device_counts(before, after, glided):
    assert_close(glided / f"{before}-to-{after}.npz", glided / f"{before}.npz")


@SLOW
def test_one_device_reads_the_checkpoint_of_four(glided):
    """This process never had four devices."""
    with contextlib.closing(checkpoint.Store(glided / "4")) as store:
        state = store.restore(like(), print)
    with np.load(glided / "4-saved.npz") as saved:
        for name, x in numbers(state).items():
            np.testing.assert_array_equal(x, saved[name], err_msg=name)


@SLOW
def test_devices_tell_what_the_documentation_counts(glided):
    """Communication per train step, from the text of the compiled program: each frame is sent once,
    and gradients are summed at one place, in the loop over minibatches."""
    assert not collectives(glided / "1.txt")
    told = collectives(glided / "4.txt")
    n, t = MJX.env.num_envs, MJX.ppo.rollout_steps
    actor, critic = t + MJX.env.frames - 1, t + MJX.env.privileged_frames - 1
    floats = {
        "frames": n
        * (
            actor * observations.actor_width(XBOT)
            + critic * observations.critic_width(XBOT, MJX.env.critic_memory)
        ),
        "action and mean": 2 * n * t * XBOT.count,
        "velocities": 3 * n * t,
        "distances of pairs, from which MJX takes the nearest: once per physics step": 42 * n,
        "log_prob, value, advantage, target, age, valid": 6 * n * t,
    }
    assert set(told) == {"all-gather", "all-reduce"}
    assert sum(told["all-gather"]) == sum(floats.values())
    params = sum(x.size for x in jax.tree.leaves(like().learner.params))
    # A few numbers are summed separately, and some scalars are summed with the gradients.
    assert [abs(size - params) < 50 for size in told["all-reduce"]].count(True) == 1
    assert sum(told["all-reduce"]) < params + 100


def like():
    """Shapes of a state."""
    return jax.eval_shape(train_step.make(MJX)[0])


def collectives(program: Path) -> dict[str, list[int]]:
    """Number of elements that each collective of a compiled program returns, by kind."""
    found: dict[str, list[int]] = {}
    kinds = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
    for shapes, kind in re.findall(rf" = (.*) ({kinds})\(", program.read_text()):
        sizes = [
            math.prod(map(int, s.split(",") if s else []))
            for s in re.findall(r"\[([\d,]*)\]", shapes)
        ]
        found.setdefault(kind, []).append(sum(sizes))
    return found


@pytest.mark.slow(reason="compiles MJX twice, a minute and a half on two cores")
def test_four_devices_learn_what_one_learns_with_mjx(stepped):
    assert_close(stepped / "1.npz", stepped / "4.npz")


@pytest.mark.slow(reason="compiles MJX four times, three minutes on two cores")
def test_two_processes_learn_what_one_learns(stepped, tmp_path):
    """Two processes on this machine, with two devices each."""
    port = free_port()
    files = [tmp_path / f"{index}.npz" for index in range(2)]
    with contextlib.ExitStack() as both:
        processes = []
        for index, file in enumerate(files):
            how = command(__file__, "learn_together", file, port, index, forced=2)
            processes.append(both.enter_context(subprocess.Popen(**how)))
            both.callback(processes[-1].kill)
        for process in processes:
            _, errors = process.communicate(timeout=500)
            assert process.returncode == 0, errors
    assert_close(files[0], files[1], tolerance=0.0)
    assert_close(files[0], stepped / "1.npz")


TWO = pytest.mark.slow(reason="compiles the train step in two processes, with cheap physics")


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """A training of five steps on one device."""
    run_dir = tmp_path_factory.mktemp("one") / "r"
    alone(*GLIDE, *DEBUG, "--steps", 5 * MJX.batch_size, "--run-dir", run_dir)
    return run_dir


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Three steps of the same training by two processes with two devices each."""
    run_dir = tmp_path_factory.mktemp("two") / "r"
    with contextlib.ExitStack() as stack:
        ended(started(stack, *GLIDE, *DEBUG, "--steps", 3 * MJX.batch_size, "--run-dir", run_dir))
    return run_dir


@TWO
def test_two_processes_start_what_one_device_goes_on_with(one, two, tmp_path):
    """After one device, four devices of one process resume it."""
    run_dir = tmp_path / "r"
    shutil.copytree(two, run_dir)
    more = (*GLIDE, "--resume", "--run-dir", run_dir, "--steps")
    assert "resumed at train step 3" in alone(*more, 4 * MJX.batch_size)
    said = alone(*more, 5 * MJX.batch_size, devices=4)
    assert "4 of 4 devices" in said and "resumed at train step 4" in said
    assert_same_training(run_dir, one)


@pytest.mark.slow(reason="compiles MJX in two processes, some minutes on two cores")
def test_two_processes_train_by_the_command_line_itself(stepped, tmp_path):
    run_dir, steps = tmp_path / "r", STEPS * MJX.batch_size
    with contextlib.ExitStack() as stack:
        ended(started(stack, *TRAIN, *DEBUG, "--steps", steps, "--run-dir", run_dir))
    step, found = latest(run_dir)
    assert step == STEPS
    with np.load(stepped / "1.npz") as expected:
        for name in expected:
            if ".params" in name:
                ours = found[name.replace("[0]", ".learner", 1)]
                np.testing.assert_allclose(ours, expected[name], rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.slow(reason="compiles a second train step")
def test_one_device_is_a_mesh_too(debug):
    """A mesh of one device gives the same bits, also with the mujoco engine."""
    finals = []
    for init, step in (train_step.make(debug), devices.make(debug, devices.mesh(debug))):
        state, _ = step(init())
        with jax.no_tracing():
            state, metrics = step(state)
        finals.append(numbers((state, metrics)))
    for name, expected in finals[0].items():
        np.testing.assert_array_equal(finals[1][name], expected, err_msg=name)


def test_what_cannot_be_split_is_refused(debug):
    with pytest.raises(ConfigError, match=r"env\.num_envs: 16 .* over 3 devices"):
        devices.mesh(debug, jax.devices() * 3)
    with pytest.raises(ConfigError, match=r"physics\.engine: mujoco runs on one device"):
        devices.mesh(debug, jax.devices() * 4)


@pytest.mark.slow(reason="compiles a train step of two seeds")
def test_seeds_train_side_by_side(debug):
    """vmap over seeds gives each seed the same training as alone."""
    seeds = jnp.array([0, 1])
    init = jax.jit(functools.partial(train_step.init, debug))
    step = jax.jit(jax.vmap(functools.partial(train_step.step, debug)))
    together, _ = run(step, jax.jit(jax.vmap(init))(seeds), 2)
    _, step = train_step.make(debug)
    for i, seed in enumerate(seeds):
        alone, _ = run(step, init(seed), 2)
        mine = jax.tree.map(lambda x, i=i: x[i], together.learner.params)
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(alone.learner.params), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)
    kernels = together.learner.params["actor"]["Dense_0"]["kernel"]
    assert float(jnp.abs(kernels[0] - kernels[1]).max()) > 0.01


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
