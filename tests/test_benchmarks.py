"""The benchmarks: the compared programs do the same work, and all benchmarks run."""

import dataclasses
import gzip
import json
import shutil
import signal
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tyro
from states import ACTOR, BIPED, XBOT, make_command, make_gait

from benchmarks import (
    brax_on_new_jax,
    compile_time,
    gpu,
    gpu_all,
    gpu_parts,
    lent_gpu,
    memory,
    parts,
    purejaxrl,
    throughput,
    timeline,
    timing,
)
from kslc_jax import observations, physics, policy, randomize, signals, train, train_step
from kslc_jax.config import ConfigError, preset
from kslc_jax.training import run_folder


def test_runs_take_turns_and_first_calls_do_not_count(monkeypatch):
    clock, calls = [0.0], []

    def run(name, seconds):
        calls.append(name)
        clock[0] += 100.0 if calls.count(name) == 1 else seconds * calls.count(name)

    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock[0])
    seconds = timing.in_turn({"a": lambda: run("a", 1.0), "b": lambda: run("b", 2.0)}, 3)
    assert calls == ["a", "b"] * 4
    assert seconds == {"a": [2.0, 3.0, 4.0], "b": [4.0, 6.0, 8.0]}
    assert timing.medians(seconds) == {"a": 3.0, "b": 6.0}


def test_parts_add_up():
    programs = ("physics", "rollout", "samples", "update", "update without windows", "whole")
    seconds = dict(zip(programs, (1.0, 1.5, 0.1, 2.0, 1.2, 4.0), strict=True))
    split = parts.split(seconds)
    assert split == pytest.approx(
        dict(zip(parts.PARTS, (1.0, 0.5, 0.1, 0.8, 1.2), strict=True))
        | {"unaccounted": 0.4, "whole": 4.0}
    )


def test_timeline_of_a_trace(tmp_path):
    """Operations that contain other operations do not count. Times are in seconds from the start of
    the first operation."""

    def event(name, start, length, thread=1, **args):
        return {"ph": "X", "name": name, "ts": start, "dur": length, "tid": thread, "args": args}

    work = [("pure_callback.4", 3e6, 2e6), ("dot.1", 5e6, 1e6), ("add_fusion.2", 6e6, 5e5)]
    events = [
        {"ph": "M", "name": "thread_name", "tid": 1, "args": {"name": "tf_XLAEigen"}},
        event("python", 0.0, 9e6),
        event("while.7", 1e6, 8e6, hlo_op="while.7"),
        *(event(name, start, length, hlo_op=name) for name, start, length in work),
        event("end: dot.1", 6e6, 1.0, hlo_op="dot.1"),
        event("dot_general.3", 5e6, 1e6, thread=2, hlo_op="dot_general.3"),
    ]
    folder = tmp_path / "plugins/profile/now"
    folder.mkdir(parents=True)
    (folder / "vm.trace.json.gz").write_bytes(
        gzip.compress(json.dumps({"traceEvents": events}).encode())
    )
    operations = timeline.read(tmp_path)
    assert operations == [
        (1, "physics", 0.0, 2.0),
        (1, "matrix products", 2.0, 3.0),
        (1, "other operations", 3.0, 3.5),
        (2, "matrix products", 2.0, 3.0),
    ]
    assert timeline.seconds(operations) == {
        "physics": 2.0,
        "matrix products": 2.0,
        "other operations": 0.5,
    }
    timeline.draw(operations, "a trace", tmp_path / "timeline.png")
    assert (tmp_path / "timeline.png").stat().st_size > 5000


def test_ratios_are_of_each_turn():
    from benchmarks import comparison

    seconds = {"kslc_jax": [1.0, 2.0, 4.0], "other": [3.0, 4.0, 4.0]}
    rows = comparison.summary(seconds, batch=100)
    assert rows["other"] == {"steps_per_second": 25.0, "times_slower": 2.0, "range": [1.0, 3.0]}
    assert rows["kslc_jax"]["times_slower"] == 1.0


@pytest.mark.slow(reason="traces two train steps")
@pytest.mark.parametrize("estimator", [(16,), ()])
def test_purejaxrls_loop_is_of_todays_train_step(debug, estimator):
    """Its states and metrics have the shapes and names of ours."""
    network = dataclasses.replace(debug.network, estimator=estimator)
    config = dataclasses.replace(debug, network=network)
    state = jax.eval_shape(train_step.make(config)[0])
    ours = jax.eval_shape(lambda s: train_step.step(config, s), state)
    assert jax.eval_shape(lambda s: purejaxrl.step(config, s), state) == ours


def test_brax_gets_our_networks(debug):
    """With the config of the comparison: the same means, deviations and values."""
    pytest.importorskip("brax", reason="an extra, needed by one benchmark only")
    from benchmarks import brax_ppo, comparison

    config = comparison.comparable(debug)
    made = brax_ppo._network_factory(config)()
    policy, value = (
        part.init(jax.random.key(1)) for part in (made.policy_network, made.value_network)
    )
    robot = physics.robot_for(config.physics)
    widths = {
        "state": config.env.frames * observations.actor_width(robot),
        "privileged_state": config.env.privileged_frames * observations.critic_width(robot),
    }
    obs = {name: jnp.ones((3, width)) for name, width in widths.items()}
    mean, std = made.policy_network.apply(None, policy, obs)
    assert mean.shape == std.shape == (3, robot.count)
    assert made.value_network.apply(None, value, obs).shape == (3,)


def test_brax_gets_what_a_new_jax_lacks(monkeypatch):
    """One copy for each device, also of random keys; a JAX that has the function keeps its own."""
    tree = {"key": jax.random.key(3), "x": jnp.arange(3.0)}
    devices = jax.local_devices()[:1]
    copies = brax_on_new_jax.replicated(tree, devices)
    assert copies["key"].shape == (1,) and copies["key"][0] == tree["key"]
    np.testing.assert_array_equal(copies["x"], [[0.0, 1.0, 2.0]])
    assert copies["x"].sharding.spec == jax.sharding.PartitionSpec("i")
    monkeypatch.setattr(brax_on_new_jax, "jax", SimpleNamespace())
    brax_on_new_jax.prepare()
    assert brax_on_new_jax.jax.device_put_replicated is brax_on_new_jax.replicated
    monkeypatch.setattr(brax_on_new_jax, "jax", SimpleNamespace(device_put_replicated="its own"))
    brax_on_new_jax.prepare()
    assert brax_on_new_jax.jax.device_put_replicated == "its own"


@pytest.mark.slow(reason="compiles a second train step")
def test_purejaxrls_loop_learns_the_same(debug):
    """Stored and shuffled observations give the same parameters as windows gathered from frames."""
    ours, theirs = train_step.make(debug), purejaxrl.make(debug)
    for init, step in (ours, theirs):
        state = init()
        for _ in range(2):
            state, metrics = step(state)
        if step is ours[1]:
            expected = state.learner.params, metrics
    for a, b in zip(
        jax.tree.leaves((state.learner.params, metrics)), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_gym_environment_is_the_same_robot(debug):
    """Physics, motors and frames of the Gymnasium environment equal those of the package."""
    pytest.importorskip("gymnasium", reason="an extra, needed by one benchmark only")
    from benchmarks import comparison
    from benchmarks.gym_env import XBot

    config = timing.on_engine(comparison.comparable(debug), "mujoco")
    env = XBot(config, seed=1)
    env._noise[:] = 0.0
    env.reset()
    sole = env.model.geom_friction[env.robot.foot_geom_ids[0], 0]
    ground = config.randomize.ground_friction
    nominal = randomize.nominal(XBOT, friction=2.0 * sole - ground)
    state = physics.initial_state(
        config.physics, jnp.asarray(env.data.qpos), jnp.asarray(env.data.qvel)
    )
    step = jax.jit(lambda s, target: physics.step(config.physics, s, target, nominal, ground))
    rng = np.random.default_rng(0)
    for _ in range(20):
        target = env.robot.default_qpos[7:] + 0.3 * rng.standard_normal(16)
        env.simulate(target)
        state = step(state, jnp.asarray(target, jnp.float32))
    np.testing.assert_allclose(env.data.qpos, state.qpos, atol=1e-4)

    env.action = rng.standard_normal(16)
    env.data.qpos[:], env.data.qvel[:] = state.qpos, state.qvel
    env.data.sensordata[:] = state.sensordata
    env._read()
    sources = observations.Sources(
        signals=signals.read(env.robot, state),
        gait=make_gait(clock=env.clock, stance=env.stance),
        command=make_command(velocity=env.command),
        dynamics=SimpleNamespace(friction=jnp.ones(())),
        reference=env.reference,
        last_action=env.action,
        push=jnp.zeros(5),
        base_mass=jnp.asarray(env.model.body_mass[env.robot.anatomy.base]),
    )
    frames = env._observe()
    actor = observations._frame(ACTOR, sources)
    np.testing.assert_allclose(frames["policy"][-1], actor, atol=1e-5)
    critic = observations.critic_frame(config.env, XBOT, sources)
    np.testing.assert_allclose(frames["critic"][-1], critic, atol=1e-5)


@pytest.mark.slow(reason="compiles two train steps")
@pytest.mark.parametrize(
    ("variants", "first", "second"),
    [
        ({"robot": BIPED}, "XBot-L", "biped"),
        ({"cones": True}, "elliptic", "pyramidal"),
        ({"pieces": True}, "in pieces", "whole"),
    ],
)
def test_throughput_of_two_variants(variants, first, second, tmp_path, capsys):
    path = tmp_path / "out.json"
    asked: dict = {"num_envs": 16, "repeats": 1, "engines": ("mujoco",), **variants}
    throughput.main(throughput.Args(preset="debug", json=path, **asked))
    rates = json.loads(path.read_text())["steps_per_second"]["mujoco"]
    assert f"{rates[second] / rates[first]:.2f} of {first}" in capsys.readouterr().out


@pytest.mark.slow(reason="compiles three programs")
def test_throughput(tmp_path):
    """Physics alone is faster than the rollout; the rollout is faster than training."""
    path = tmp_path / "numbers.json"
    throughput.main(throughput.Args(preset="debug", repeats=3, engines=("mujoco",), json=path))
    rates = json.loads(path.read_text())["steps_per_second"]["mujoco"]
    assert rates["physics only"] > rates["rollout"] > rates["whole training"] > 10


@pytest.mark.slow(reason="compiles six programs")
def test_parts(tmp_path):
    out, path = tmp_path / "parts.png", tmp_path / "parts.json"
    parts.main(parts.Args(preset="debug", engines=("mujoco",), out=out, json=path))
    seconds = json.loads(path.read_text())["seconds"]["mujoco"]
    assert out.stat().st_size > 10_000
    assert seconds["whole"] == pytest.approx(sum(seconds.values()) - seconds["whole"])
    assert seconds["physics"] > 0 and seconds["gradient steps"] > 0


def test_the_peak_of_a_process_does_not_count_its_parent():
    """The child needs less than half of the 1 GiB that the parent holds."""
    large = np.ones(2**27)
    code = "from benchmarks import memory; print(memory.peak_of_process())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 0.5 * large.nbytes < memory.peak_of_process()


@pytest.mark.slow(reason="starts Python eight times")
def test_compile_time_and_memory(tmp_path, capsys):
    path = tmp_path / "numbers.json"
    compile_time.main(compile_time.Args(presets=("debug",), engines=("mujoco",), json=path))
    phases = json.loads(path.read_text())["seconds"]["debug, mujoco"]
    assert phases["cold"]["compile"] > phases["cold"]["first step"] > 0
    assert phases["warm"].keys() == phases["cold"].keys()
    pair = compile_time.paired("debug", "mujoco", None, 1)["warm"]
    assert pair["ratio"] == pair["one after the other"] / pair["in two threads"]

    out = tmp_path / "memory.png"
    memory.main(memory.Args("debug", (16, 4096, 2**28), (3,), out=out, json=path))
    small, large = json.loads(path.read_text())["points"]
    assert large["peak_mib"] > small["peak_mib"] > small["before_mib"] > 50
    assert large["estimated_mib"] > 100 * small["estimated_mib"]
    for point in (small, large):
        assert 1 / 1.5 < point["estimated_mib"] / point["planned_mib"] < 1.5
    said = capsys.readouterr().out
    assert "[3/3]" in said and "does not fit" in said
    assert out.stat().st_size > 10_000
    memory.main(memory.Args("debug", (16,), (3,), minutes=0.0))
    assert "0 minutes are over: 1 points are left out" in capsys.readouterr().out


@pytest.mark.slow(reason="compiles MJX, a minute on two cores")
def test_gpu_in_small(tmp_path):
    """On any machine: one rate for each part of each case, and one for the other precision."""
    cases, parts = ("mjx:16x8", "mujoco:32x4"), ("physics only", "whole training")
    out = tmp_path / "gpu.json"
    gpu.main(gpu.Args(out, "debug", cases, parts, ("float32",), repeats=1))
    rates = json.loads(out.read_text())["steps per second"]
    assert set(rates) == {f"{c} {p}" for c in cases for p in parts} | {"float32"}
    assert min(rates.values()) > 0


def test_gpu_cases():
    config = gpu.shaped(preset("laptop"), "mjx:4096x12")
    assert config.physics.engine == "mjx"
    assert (config.env.num_envs, config.ppo.rollout_steps) == (4096, 12)
    for wrong in ("mjx", "mjx:4096", "mjx:manyx12", "mjx:1x1"):
        with pytest.raises(SystemExit, match=r"^error: "):
            gpu.main(gpu.Args(cases=(wrong,)))


def test_gpu_goes_on_without_what_fails(capsys):
    def fails():
        raise RuntimeError("out of memory\nand so on")

    runs = gpu.first_calls({"large": fails, "small": lambda: lambda: 3})
    assert list(runs) == ["small"] and runs["small"]() == 3
    assert "large: out of memory\n" in capsys.readouterr().out


@pytest.fixture
def plan(tmp_path):
    return gpu_all.Plan(("seeds", "paper"), "debug", "debug", 100.0, 1, False, tmp_path / "g.json")


def test_gpu_asks_for_a_plan(plan, monkeypatch):
    plans = []
    monkeypatch.setattr(gpu_all, "run", plans.append)
    args = gpu.Args(plan.out, "debug", repeats=1, all=True, questions=plan.parts)
    gpu.main(dataclasses.replace(args, budget=100.0, paper="debug"))
    assert plans == [plan]
    assert gpu.Args().questions[-1] == "exact"  # its four processes take longest


def test_gpu_questions_go_on_without_what_fails(plan, monkeypatch, capsys):
    """A part that fails or comes too late is told; the others are printed and written."""

    def child(module, argv, env, timeout):
        part = argv[argv.index("--part") + 1]
        assert module == "benchmarks.gpu_parts" and timeout <= 160.0
        if part == "seeds":
            raise subprocess.CalledProcessError(1, "seeds")
        return {"machine": {}, "steps/s": 1234.0}

    monkeypatch.setattr(timing, "child", child)
    monkeypatch.setattr(gpu_all.importlib.util, "find_spec", lambda name: None)
    gpu_all.run(dataclasses.replace(plan, parts=(*plan.parts, "brax")))
    out = capsys.readouterr().out
    assert "seeds:\n  failed: Command 'seeds' returned" in out
    assert "paper:\n  steps/s: 1234\n" in out and "brax: left out, brax is not installed" in out
    assert [path.name for path in plan.out.parent.iterdir()] == ["g-paper.json"]
    gpu_all.run(dataclasses.replace(plan, budget=0.0))
    assert "paper: left out, 0 s are over" in capsys.readouterr().out


def test_gpu_question_of_exactness(plan, monkeypatch):
    """It compares the second half of the resumed run, for each setting of the flag."""

    def child(module, argv, env, timeout):
        flagged = gpu_all.DETERMINISTIC in env["XLA_FLAGS"]
        sums = [*range(gpu_parts.STEPS)]
        if "resumed" in argv:
            half = sums[gpu_parts.STEPS // 2 :]
            return {"machine": {}, "sums": sums, "resumed": half if flagged else half[::-1]}
        rate = 80.0 if flagged else 100.0
        return {"machine": {"device": "x"}, "sums": sums, "two runs": True, "steps/s": rate}

    monkeypatch.setattr(timing, "child", child)
    gpu_all.run(dataclasses.replace(plan, parts=("exact",)))
    found = json.loads(plan.out.with_name("g-exact.json").read_text())
    assert found["deterministic operations, times the steps/s"] == 0.8
    assert found["machine"] == {"device": "x"}
    for title, exact in ((gpu_all.AS_IT_IS, False), (gpu_all.DETERMINISTIC, True)):
        assert found[title]["two processes"] and found[title]["resume in two processes"] == exact


def test_gpu_questions_keep_what_they_have_when_their_time_is_over(plan, monkeypatch, capsys):
    """The second process of `exact` takes too long; what the first one found stands."""

    def child(module, argv, env, timeout):
        if "resumed" in argv:
            raise subprocess.TimeoutExpired("resumed", timeout)
        return {"machine": {}, "sums": [1], "two runs": True, "steps/s": 100.0}

    monkeypatch.setattr(timing, "child", child)
    gpu_all.run(dataclasses.replace(plan, parts=("exact",)))
    found = json.loads(plan.out.with_name("g-exact.json").read_text())
    assert found[gpu_all.AS_IT_IS] == {"two runs": True, "steps/s": 100.0}
    said = capsys.readouterr().out
    assert "    two runs: True\n" in said and "  failed: Command 'resumed' timed out" in said


def test_gpu_questions_share_the_time():
    """One that takes all its time leaves some to those after it; the last one gets all."""
    parts, left = ("seeds", "paper", "large", "brax", "exact"), 480.0
    given = []
    for index in range(len(parts)):
        given.append(gpu_all.most(parts[index:], left))
        left -= given[-1]
    assert given == pytest.approx([140.0, 119.0, 96.7, 72.5, 51.8], abs=0.1)
    assert gpu_all.most(("large",), 480.0) == 480.0


@pytest.mark.parametrize(("installed", "seconds"), [(True, 80.0), (False, 100.0)])
def test_gpu_trainings_leave_time_to_brax(installed, seconds, plan, monkeypatch):
    """Of 160 s, seven eighths at most; they end a minute before that."""
    large = []

    def child(module, argv, env, timeout):
        asked = dict(zip(argv[::2], argv[1::2], strict=True))
        large.extend([float(asked["--train-seconds"])] if asked["--part"] == "large" else [])
        return {"machine": {}}

    monkeypatch.setattr(timing, "child", child)
    monkeypatch.setattr(gpu_all, "_installed", lambda package: installed)
    gpu_all.run(dataclasses.replace(plan, parts=("large",), train=True))
    gpu_all.run(dataclasses.replace(plan, parts=("large", "brax"), train=True))
    assert large == pytest.approx([100.0, seconds], abs=1.0)


def test_gpu_question_of_brax(plan, monkeypatch):
    """The process is asked for Brax; it compares Brax with ours."""
    from benchmarks import comparison

    asked = []

    def child(module, argv, env, timeout):
        args = tyro.cli(gpu_parts.Args, args=argv)
        return {"machine": {}, **gpu_parts.PARTS[args.part](args)}

    def on_mjx(*how):
        asked.append(how)
        return {"kslc_jax": [1.0], "brax": [2.0]}

    monkeypatch.setattr(timing, "child", child)
    monkeypatch.setattr(comparison, "on_mjx", on_mjx)
    monkeypatch.setattr(gpu_all, "_installed", lambda package: True)
    gpu_all.run(dataclasses.replace(plan, parts=("brax",), repeats=3))
    assert asked == [(preset("debug"), 3, ("brax",))]
    found = json.loads(plan.out.with_name("g-brax.json").read_text())
    assert found["brax"]["times_slower"] == 2.0
    assert found["kslc_jax"]["steps_per_second"] == preset("debug").batch_size


def test_gpu_trainings_share_the_time(monkeypatch):
    """The time that a quick training leaves over goes to those after it."""
    now, given = [0.0], []

    def until(speed, state, program, seconds):
        given.append(seconds)
        now[0] += min(seconds, 10.0)
        return (10.0, 3) if seconds >= 10.0 else None

    def measured(programs, repeats):
        now[0] += 40.0  # with compiling
        return dict.fromkeys(programs, 0.5)

    monkeypatch.setattr(gpu_parts.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(gpu_parts, "compiled", lambda make: (None, None, {}))
    monkeypatch.setattr(gpu_parts, "in_turn", measured)
    monkeypatch.setattr(gpu_parts, "until", until)
    monkeypatch.setattr("kslc_jax.train_step.make", lambda config: (lambda: None, None))
    numbers = gpu_parts.large(gpu_parts.Args("large", train_seconds=100.0))
    assert given == [30.0, 50.0] and len(numbers) == 4
    assert set(numbers.values()) == {2 * 49152 / 0.5, 4 * 49152 / 0.5, (10.0, 3)}


def test_gpu_training_until_a_speed(monkeypatch):
    """The time is that at the end of the train step that reaches it."""
    speeds, now = iter([0.5, 3.0, 3.5, 4.0]), [5.0]
    monkeypatch.setattr(gpu_parts.time, "monotonic", lambda: now[0])

    def program(state):
        now[0] += 2.0
        return state + 1, {"curriculum/v_max": next(speeds), "step": state + 1}

    assert gpu_parts.until(3.5, 0, program, 100.0) == (6.0, 3)
    assert gpu_parts.until(3.5, 0, program, 0.0) is None


def test_larger_batches():
    sizes = {
        name: (config.env.num_envs, config.ppo.minibatches)
        for name, config in gpu_parts.larger(preset("laptop")).items()
    }
    assert sizes == {
        "4096 x 24, 8 minibatches": (4096, 8),
        "8192 x 24, 16 minibatches": (8192, 16),
    }


@pytest.mark.slow(reason="compiles nine programs in seven processes")
@pytest.mark.parametrize("question", ["seeds", "exact", "paper", "large"])
def test_gpu_questions_in_small(question, plan):
    """On the CPU a training is bit-exact, with the flag, too."""
    gpu_all.run(dataclasses.replace(plan, parts=(question,), budget=3600.0))
    found = json.loads(plan.out.with_name(f"g-{question}.json").read_text())
    assert found["machine"]["jax"] == jax.__version__
    if question == "exact":
        for title in (gpu_all.AS_IT_IS, gpu_all.DETERMINISTIC):
            rows = found[title]
            assert rows["two runs"] and rows["two processes"]
            assert rows["resume in one process"] and rows["resume in two processes"]
    elif question == "large":
        assert len(found) == 3
    else:
        assert min(v for name, v in found.items() if name.endswith("steps/s")) > 0


def written(folder, *names, size=2000):
    """Writes files into a run folder."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(bytes(size))


@pytest.fixture
def lent(tmp_path, monkeypatch):
    """Options for a run of a made-up training; `lent.program` sets what it does."""
    made_up = tmp_path / "kslc_jax" / "train.py"
    made_up.parent.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "seed-3"
    kept = ("config.json", "metrics.jsonl", "robot/r.xml", "checkpoints/19/params/d")
    kept += ("checkpoints/19/core/d", "snapshots/4/params/d", "snapshots/14/params/d")
    written(run, *kept, "tensorboard/events", ".lock", "checkpoints/19/env/d")
    written(run, "checkpoints/8/params/d", "snapshots/16.tmp/params/d")
    args = lent_gpu.Args(tmp_path / "out", seconds=60.0, run_dir=tmp_path / "runs", resume=True)
    return SimpleNamespace(program=made_up.write_text, args=args, run=run, kept=set(kept))


def files_in(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_lent_gpu_stops_and_carries_without_environments(lent, tmp_path, capsys):
    """The time ends by SIGTERM. The copy has the last checkpoint without environments."""
    lent.program("import time\ntime.sleep(1000)\n")
    args = dataclasses.replace(lent.args, seconds=0.1)
    assert lent_gpu.main(args) == -signal.SIGTERM
    names = [lent_gpu.part_name(i, args.parts) for i in range(args.parts)]
    assert sorted(path.name for path in args.out.iterdir()) == names
    assert f"{args.out}: 0.0 MiB in 4 files\n" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="out is not empty"):
        lent_gpu.main(args)
    there = tmp_path / "there"
    assert lent_gpu.main(lent_gpu.Args(there / "lent", unpack=args.out)) == 0
    assert files_in(there / "lent" / "seed-3") == lent.kept
    said = f"go on with: python -m kslc_jax.train --resume --run-dir {there / 'lent'}\n"
    assert capsys.readouterr().out == said
    (args.out / names[2]).unlink()
    assert lent_gpu.main(lent_gpu.Args(there / "again", unpack=args.out)) == 1
    assert capsys.readouterr().err.startswith(f"error: {args.out} lacks carried-3-of-4.tar; ")
    with pytest.raises(ConfigError, match="holds no copy: no file such as "):
        lent_gpu.main(lent_gpu.Args(there / "third", unpack=tmp_path / "none"))


def test_lent_gpu_copies_while_it_trains(lent, tmp_path, monkeypatch):
    """A training that is killed from outside leaves the copy of the minute before."""
    monkeypatch.setattr(lent_gpu, "EVERY", 0.0)
    copied = lent.args.out / lent_gpu.part_name(3, 4)
    lent.program(
        "import pathlib, time\n"
        f"while not pathlib.Path({str(copied)!r}).exists():\n    time.sleep(0.01)\n"
    )
    assert lent_gpu.main(lent.args) == 0


def test_lent_gpu_kills_a_training_that_does_not_stop(lent, monkeypatch, capsys):
    lent.program("import signal, time\nsignal.signal(15, signal.SIG_IGN)\ntime.sleep(1000)\n")
    monkeypatch.setattr(lent_gpu, "GRACE", 0.2)
    args = dataclasses.replace(lent.args, seconds=0.5)  # until the signal is ignored
    assert lent_gpu.main(args) == -signal.SIGKILL
    said = capsys.readouterr().out
    assert "not saved after 0 s: killed\n" in said and "MiB in 4 files" in said


def test_lent_gpu_leaves_a_run_that_is_there(lent):
    """A new training is refused as `train` refuses it, and nothing is copied."""
    lent.program("")
    with pytest.raises(run_folder.RunError, match="already holds a training of 1 seeds: go on"):
        lent_gpu.main(dataclasses.replace(lent.args, resume=False))
    assert not lent.args.out.exists()


def test_lent_gpu_passes_options_on():
    """What comes after -- goes to the training."""
    ours = ["--out", "o", "--preset", "paper", "--seeds", "1"]
    args, options = lent_gpu.parse([*ours, "--", "--ppo.clip", "0.1"])
    words = lent_gpu.command(args, options)
    assert words[2:7] == ["kslc_jax.train", "--run-dir", "runs/lent", "--preset", "paper"]
    assert words[-2:] == ["--ppo.clip", "0.1"] and "--resume" not in words
    assert "--preset" not in lent_gpu.command(dataclasses.replace(args, resume=True), ())
    assert lent_gpu.parse(ours)[1] == []


def test_lent_gpu_carries_the_most_important_first(lent, tmp_path, capsys):
    """Last states of all seeds, then metrics, then snapshots, newest first. What does not fit is
    named, and no file is larger than asked for."""
    other = lent.run.with_name("seed-4")
    shutil.copytree(lent.run, other)
    groups = [f"{run}: {what}" for what in ("its last state", "its metrics") for run in SEEDS]
    groups += [f"{run}: snapshot {step}" for step in (14, 4) for run in SEEDS]
    assert list(lent_gpu.wanted(lent.args.run_dir)) == groups
    room = 2 * 2**20
    written(lent.run, "snapshots/4/params/d", size=room)
    written(other, "checkpoints/19/core/d", size=room - lent_gpu.END - lent_gpu.HEADERS)
    left = lent_gpu.carry(lent.args.run_dir, lent.args.out, 2, room)
    assert left == ["seed-3: snapshot 4"]
    sizes = [path.stat().st_size for path in sorted(lent.args.out.iterdir())]
    assert sizes[0] < 50_000 and room - 20_000 < sizes[1] <= room
    lent.program("")
    args = dataclasses.replace(lent.args, out=tmp_path / "small", parts=1, part_mib=0.0625)
    assert lent_gpu.main(args) == 1
    said = capsys.readouterr().out
    assert "did not fit: seed-4: its last state; seed-3: snapshot 4\n" in said


SEEDS = ("seed-3", "seed-4")


@pytest.mark.slow(reason="a process that trains, then a training in this one")
@pytest.mark.parametrize("seeds", [1, 2])
def test_a_carried_training_goes_on(seeds, tmp_path, capsys):
    """Train, carry, unpack, resume: the metrics go on where they were, as in one training."""
    args = lent_gpu.Args(
        tmp_path / "out", run_dir=tmp_path / "lent", preset="debug", seeds=seeds, snapshots=1
    )
    batch = preset("debug").batch_size
    assert lent_gpu.main(args, ("--steps", str(3 * batch))) == 0
    run = tmp_path / "runs" / "lent"
    assert lent_gpu.main(lent_gpu.Args(run, unpack=args.out)) == 0
    capsys.readouterr()
    assert train.main(["--resume", "--run-dir", str(run), "--steps", str(5 * batch)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("3 has no environments, all robots begin new episodes") == seeds
    folders = [run] if seeds == 1 else [run / "seed-0", run / "seed-1"]
    for folder in folders:
        rows = [json.loads(row) for row in (folder / "metrics.jsonl").read_text().splitlines()]
        assert [row["step"] for row in rows] == [1, 2, 3, 4, 5]
        assert {row["broken"] for row in rows} == {0.0}
        assert policy.load_policy(folder).step == 5
        assert policy.load_policy(folder / "snapshots" / "3").step == 3


@pytest.mark.slow(reason="compiles MJX three times and starts worker processes")
def test_comparison_in_short(tmp_path):
    for package in ("brax", "gymnasium", "rsl_rl", "torch"):
        pytest.importorskip(package, reason="an extra, needed by this benchmark only")
    path = tmp_path / "numbers.json"
    command = [sys.executable, "-m", "benchmarks.comparison", "--short", "--json", str(path)]
    subprocess.run(command, check=True)
    tables = json.loads(path.read_text())["tables"]
    assert set(tables["mjx"]) == {"kslc_jax", "purejaxrl", "brax"}
    assert set(tables["mujoco"]) == {"kslc_jax", "purejaxrl", "torch"}
    rates = [row["steps_per_second"] for table in tables.values() for row in table.values()]
    assert min(rates) > 1
