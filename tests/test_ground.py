"""Uneven ground: its height function, both models of it, and what the environment reads from it."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import slow

from kslc_jax import config as config_lib
from kslc_jax import (
    curriculum,
    env,
    evaluate,
    load_policy,
    observations,
    physics,
    randomize,
    robot,
    signals,
    sim2sim,
    similar,
)
from kslc_jax import ground as ground_lib
from kslc_jax.config import ConfigError, HighFidelity, PhysicsConfig, TerrainConfig, preset
from kslc_jax.evaluation import measure, perturbations, trained, trials

SIZES = {"rough": 0.05, "slope": 10.0, "stairs": 0.1}
KINDS = tuple(SIZES)
ALL = TerrainConfig(**SIZES)
BIPED = str(Path(__file__).parent / "data" / "biped.toml")
FAR = (40.2, -21.3)
"""A place [m] beyond the first window of the height field."""


def only(kind: str) -> TerrainConfig:
    return TerrainConfig(**{kind: SIZES[kind]}, flat=0.0, least=1.0)


def ground_of(kind: str, yaw: float = 0.6) -> ground_lib.Ground:
    return ground_lib.largest(only(kind)).replace(yaw=np.float32(yaw))


def places(count: int, span: float) -> np.ndarray:
    return np.random.default_rng(0).uniform(-span, span, (count, 2))


class TestHeight:
    @pytest.mark.parametrize("kind", KINDS)
    def test_the_start_is_flat_and_level(self, kind):
        xy = places(2000, 0.5)
        xy = xy[np.hypot(*xy.T) < 0.5]
        assert np.abs(ground_lib.height(ground_of(kind), *xy.T, np)).max() < 1e-6

    def test_waves_have_their_size(self):
        heights = ground_lib.window(ground_of("rough"), far=True)
        assert np.abs(heights).max() == pytest.approx(0.05, rel=1e-3)
        assert np.abs(heights - heights.mean()).max() < 0.06
        assert heights.std() > 0.01

    @pytest.mark.parametrize("yaw", [0.0, 2.0])
    def test_a_slope_rises_in_its_direction(self, yaw):
        gradient = ground_lib.slope(ground_of("slope", yaw), jnp.float32(30.0), jnp.float32(7.0))
        rise = np.tan(np.radians(10.0)) * np.array([np.cos(yaw), np.sin(yaw)])
        np.testing.assert_allclose(gradient, rise, atol=1e-6)

    def test_stairs_rise_by_a_step_per_tread_and_have_flat_treads(self):
        x = np.arange(10.0, 20.0, 0.01)
        heights = ground_lib.height(ground_of("stairs", 0.0), x, 0.0 * x, np)
        assert heights[-1] - heights[0] == pytest.approx(0.1 * 25, abs=0.1)
        assert np.median(np.abs(np.diff(heights))) < 1e-6
        steepest = np.abs(np.diff(heights)).max() / 0.01
        assert steepest == pytest.approx(0.1 / ground_lib.RISER, rel=0.05)

    @pytest.mark.parametrize("kind", ["rough", "slope"])
    def test_the_flat_place_makes_the_ground_near_it_only_a_little_steeper(self, kind):
        def steepest(far):
            slopes = np.gradient(ground_lib.window(ground_of(kind), far), ground_lib.SPACING)
            return np.hypot(*slopes).max()

        assert steepest(False) < 1.25 * steepest(True)

    def test_the_level_rises_evenly_on_stairs(self):
        """A camera that follows it does not jump."""
        ground = ground_of("stairs", 0.0)
        levels = [ground_lib.level(ground, x, 0.0) for x in np.arange(10.0, 12.0, 0.02)]
        np.testing.assert_allclose(np.diff(levels), 0.1 * 0.02 / ground_lib.TREAD, atol=0.006)

    @pytest.mark.parametrize("kind", KINDS)
    def test_planes_touch_the_ground(self, kind):
        """Points of a plane near its own point lie on the ground; numpy and JAX agree."""
        ground, xy = ground_of(kind), places(200, 30.0)
        pos, quat = ground_lib.planes(ground, jnp.asarray(np.c_[xy, 0 * xy[:, 0]], jnp.float32))
        pos = np.asarray(pos, np.float64)
        np.testing.assert_allclose(pos[:, 2], ground_lib.height(ground, *xy.T, np), atol=2e-4)
        turned = np.zeros((len(pos), 9))
        for q, out in zip(np.asarray(quat, np.float64), turned, strict=True):
            mujoco.mju_quat2Mat(out, q)
        for axis in (0, 1):
            near = pos + 0.002 * turned.reshape(-1, 3, 3)[:, :, axis]
            error = near[:, 2] - ground_lib.height(ground, near[:, 0], near[:, 1], np)
            assert np.quantile(np.abs(error), 0.95) < 1e-4


class TestDraws:
    def draw(self, terrain, v_max=3.0, count=500):
        keys = jax.random.split(jax.random.key(0), count)
        return jax.vmap(functools.partial(ground_lib.sample, terrain, v_max=v_max))(keys)

    def test_one_kind_an_episode_and_a_share_is_flat(self):
        drawn = self.draw(ALL)
        sizes = np.stack([drawn.rough, drawn.slope, drawn.stairs], 1)
        assert (np.count_nonzero(sizes, 1) <= 1).all()
        assert np.mean(~sizes.any(1)) == pytest.approx(0.2, abs=0.06)
        assert np.all(np.mean(sizes > 0, 0) > 0.2)
        assert sizes.max(0) == pytest.approx([0.05, np.tan(np.radians(10)), 0.1], rel=0.05)

    def test_sizes_grow_with_the_commands(self):
        terrain = dataclasses.replace(only("rough"), full_from=2.0)
        for v_max, size in ((0.5, 0.0125), (2.0, 0.05), (4.0, 0.05)):
            np.testing.assert_allclose(self.draw(terrain, v_max).rough, size, rtol=1e-5)


class TestHeightField:
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("near", [(0.0, 0.0), FAR])
    def test_it_is_the_function(self, kind, near):
        """Rays down onto the height field find the function's heights and normals."""
        bot, ground = robot.load("high", terrain=only(kind)), ground_of(kind)
        model = bot.mj_model
        batch = mujoco.batch.Batch(model, 1, nthread=1)
        placed = ground_lib.place(ground, *near, np)
        names = ("geom_pos", "geom_quat", "geom_dataid")
        for name, value in zip(names, placed, strict=True):
            batch.expand(name)[0, bot.ground_geom_ids[0]] = value
        batch.bind("qpos")[0] = model.key_qpos[0]
        batch.bind("qpos")[0, 2] = 1000.0  # out of the way
        xy = np.array(near) + places(2000, 2.0)
        start = np.c_[xy, np.full(len(xy), 100.0)]
        down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
        dist, _, normal = batch.ray(start, down, normal=True)
        error = 100.0 - dist[0] - ground_lib.height(ground, *xy.T, np)
        # The points of the field are 5 cm apart. Far from the start a stair's riser lies between
        # two rows of them; near it the stairs bend round the flat place and cross the rows.
        most = {"rough": 2e-3, "slope": 5e-4, "stairs": 6e-3 if near == FAR else 25e-3}[kind]
        assert np.quantile(np.abs(error), 0.99) < most
        assert np.median(np.abs(error)) < 1e-3
        gradient = jax.vmap(functools.partial(ground_lib.slope, ground))(*jnp.asarray(xy.T, "f4"))
        up = np.c_[-gradient, np.ones(len(xy))]
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip(np.sum(up * normal[0], 1), -1, 1)))
        # A stair's round edge reaches 1 cm into the next facet, which then leans by 5.7 degrees.
        assert np.quantile(angle, 0.7) < {"rough": 4.0, "slope": 0.5, "stairs": 3.0}[kind]


def standing(config: PhysicsConfig, kind: str | None, place, steps: int, yaw: float = 0.6):
    """State of a robot that its servos hold, after some control steps from a drop at a place."""
    bot = physics.robot_for(config)
    ground = ground_of(kind, yaw) if kind else None
    height = ground_lib.height(ground, *place, np) if kind else 0.0
    qpos = bot.default_qpos + np.r_[place, height, np.zeros(4 + bot.count)]
    data = mujoco.MjData(bot.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_forward(bot.mj_model, data)
    state = physics.initial_state(config, jnp.asarray(qpos, "f4"), jnp.zeros(bot.mj_model.nv))
    state = state.replace(sensordata=jnp.asarray(data.sensordata, jnp.float32))
    dynamics = randomize.nominal(bot).replace(ground=jax.tree.map(jnp.asarray, ground))
    target = state.qpos[7:]
    step = jax.jit(lambda state: physics.step(config, state, target, dynamics, 1.0))
    for _ in range(steps):
        state = step(state)
    return state


def forces(config: PhysicsConfig, state: physics.PhysicsState) -> np.ndarray:
    return np.asarray(signals.read(physics.robot_for(config), state).foot_force)


class TestBothModels:
    @pytest.mark.parametrize("kind", [KINDS[0], *slow.cases("compiles both again", *KINDS[1:])])
    def test_a_robot_stands_in_the_same_way(self, kind):
        """Own planes in training, a height field at high fidelity: pose and forces agree."""
        train, high = PhysicsConfig(engine="mujoco", terrain=ALL), HighFidelity(terrain=only(kind))
        a, b = (standing(config, kind, FAR, 40) for config in (train, high))
        np.testing.assert_allclose(a.qpos[:3], b.qpos[:3], atol=0.008)
        np.testing.assert_allclose(a.qpos[3:7], b.qpos[3:7], atol=0.008)
        weight = 9.81 * physics.robot_for(train).total_mass
        np.testing.assert_allclose(forces(train, a), forces(high, b), atol=0.25 * weight)
        assert abs(forces(train, a).sum() - forces(high, b).sum()) < 0.3 * weight

    @pytest.mark.slow(reason="compiles both models of another robot")
    @pytest.mark.parametrize("kind", ["rough", "slope"])
    def test_another_robot_stands_in_the_same_way(self, kind):
        """For 0.25 s: then the biped, which has no policy, falls."""
        train = PhysicsConfig(engine="mujoco", robot=BIPED, terrain=ALL)
        high = HighFidelity(robot=BIPED, terrain=only(kind))
        a, b = (standing(config, kind, FAR, 25) for config in (train, high))
        np.testing.assert_allclose(a.qpos[:3], b.qpos[:3], atol=0.01)
        weight = 9.81 * physics.robot_for(train).total_mass
        for config, state in ((train, a), (high, b)):
            assert 0.3 * weight < forces(config, state).sum() < 2.0 * weight

    def test_own_planes_of_flat_ground_are_the_floor(self):
        """At the start, where the ground is flat, every number is that of the model without it."""
        flat, uneven = PhysicsConfig(engine="mujoco"), PhysicsConfig(engine="mujoco", terrain=ALL)
        a, b = standing(flat, None, (0.0, 0.0), 30), standing(uneven, "stairs", (0.0, 0.0), 30)
        np.testing.assert_array_equal(a.qpos, b.qpos)
        np.testing.assert_array_equal(a.qvel, b.qvel)

    @pytest.mark.slow(reason="compiles MJX")
    def test_mjx_agrees_with_c(self):
        uneven = dataclasses.replace(preset("laptop").physics, terrain=ALL)
        engines = (dataclasses.replace(uneven, engine=e) for e in ("mujoco", "mjx"))
        a, b = (standing(config, "slope", FAR, 20) for config in engines)
        np.testing.assert_allclose(a.qpos, b.qpos, atol=2e-4)
        np.testing.assert_allclose(a.qvel, b.qvel, atol=2e-2)

    def test_no_model_has_more_without_uneven_ground(self):
        assert physics.robot_for(PhysicsConfig()).terrain is None
        assert robot.load().mj_model.ngeom + 8 == robot.load(terrain=ALL).mj_model.ngeom
        assert robot.load().mj_model.nhfield == 0

    def test_any_robot_gets_it(self, name=BIPED):
        for fidelity, terrain in (("train", ALL), ("high", only("rough"))):
            bot = robot.load(fidelity, name=name, terrain=terrain)
            assert len(bot.ground_geom_ids) == (8 if fidelity == "train" else 1)


class TestSignals:
    def test_heights_are_above_the_ground(self):
        """A robot that stands on a slope has the heights that it has on the floor."""
        flat, uneven = PhysicsConfig(engine="mujoco"), PhysicsConfig(engine="mujoco", terrain=ALL)
        ground = ground_of("slope", yaw=0.0)
        floor = standing(flat, None, (0.0, 0.0), 0)
        up = standing(uneven, "slope", (30.0, 0.0), 0, yaw=0.0)
        a = signals.read(physics.robot_for(flat), floor)
        b = signals.read(physics.robot_for(uneven), up, ground)
        rise = np.tan(np.radians(10.0))
        assert float(up.qpos[2] - floor.qpos[2]) == pytest.approx(30.0 * rise, abs=1e-3)
        forward = np.asarray(a.foot_pos[:, 0])
        np.testing.assert_allclose(b.foot_pos[:, 2], a.foot_pos[:, 2] - rise * forward, atol=1e-4)
        lower = float(a.base_pos[2]) - rise * forward.mean()
        assert float(b.base_pos[2]) == pytest.approx(lower, abs=1e-4)
        np.testing.assert_allclose(b.ground["slope"], [rise, 0.0], atol=1e-5)
        np.testing.assert_allclose(b.ground["foot_ground"], rise * forward, atol=1e-4)
        assert not b.torso_contact

    def test_a_torso_on_a_slope_has_fallen(self):
        config = PhysicsConfig(engine="mujoco", terrain=ALL)
        state = standing(config, "slope", (30.0, 0.0), 0, yaw=0.0)
        lying = state.replace(qpos=state.qpos.at[2].add(-0.9))
        ground, bot = ground_of("slope", yaw=0.0), physics.robot_for(config)
        assert signals.read(bot, lying, ground).torso_contact
        assert not signals.read(bot, lying).torso_contact  # 5 m above the flat floor


class TestEnvironment:
    def config(self, debug, **changes):
        terrain = dataclasses.replace(ALL, **changes)
        changed = dataclasses.replace(debug.physics, engine="mujoco", terrain=terrain)
        return dataclasses.replace(debug, physics=changed)

    def test_the_critic_sees_the_ground_and_the_actor_does_not(self, debug):
        blind = physics.robot_for(self.config(debug, critic_sees=False).physics)
        seeing, plain = physics.robot_for(self.config(debug).physics), robot.load()
        for bot, more in ((seeing, 4), (blind, 0)):
            assert observations.actor_width(bot) == observations.actor_width(plain)
            assert observations.critic_width(bot) == observations.critic_width(plain) + more

    @pytest.mark.slow(reason="compiles an environment step")
    def test_steps(self, debug):
        """Robots fall and start again; every new episode draws its ground."""
        config = self.config(debug, flat=0.0)
        cur = curriculum.init(config)
        keys = jax.random.split(jax.random.key(0), 8)
        states = jax.jit(jax.vmap(lambda key: env.reset(config, key, cur)))(keys)
        first = states.dynamics.ground
        step = jax.jit(
            jax.vmap(lambda state, key: env.step(config, state, jnp.zeros(16), key, cur))
        )
        fallen = np.zeros(8, bool)
        for i in range(250):
            states, out = step(states, jax.random.split(jax.random.key(i), 8))
            assert not np.any(out.broken)
            fallen |= np.asarray(out.terminated)
        assert fallen.any()
        changed = np.asarray(states.dynamics.ground.yaw != first.yaw)
        np.testing.assert_array_equal(changed, fallen)
        assert np.isfinite(states.privileged_history).all()


class TestConfig:
    @pytest.mark.parametrize("name", config_lib.PRESETS)
    def test_it_is_off(self, name):
        assert config_lib.preset(name).physics.uneven is None

    @pytest.mark.parametrize(
        "wrong", [{"rough": -0.1}, {"slope": 60.0}, {"flat": 1.0}, {"least": 2.0}]
    )
    def test_wrong_values(self, wrong):
        with pytest.raises(ConfigError, match=r"physics\.terrain"):
            TerrainConfig(**wrong)

    def test_high_fidelity_has_one_height_field(self):
        with pytest.raises(ConfigError, match="one height field"):
            HighFidelity(terrain=ALL)

    def test_storage(self):
        config = dataclasses.replace(config_lib.preset("debug"), physics=PhysicsConfig(terrain=ALL))
        assert config_lib.from_dict(config_lib.to_dict(config)) == config

    def test_another_robot_gets_smaller_steps(self):
        config = dataclasses.replace(
            config_lib.preset("debug"), physics=PhysicsConfig(robot=BIPED, terrain=ALL)
        )
        biped = robot.load(name=BIPED)
        share, scaled = biped.length_ratio, similar.scaled(config, biped)
        assert scaled.physics.terrain.stairs == pytest.approx(0.1 * share, rel=0.01)


class TestJudging:
    @pytest.mark.parametrize(
        "text", ["rough", "bumps:1", "rough:x", "slope:-3", "slope:nan", "stairs:9", "rough:0"]
    )
    def test_bad_ground(self, text):
        with pytest.raises(ConfigError, match="ground: "):
            perturbations.terrain(text)

    def test_it_is_a_condition_of_sim2sim(self):
        args = sim2sim.Args("x", ground=("rough:0.05", "slope:10"), perturb=("payload=5",))
        assert args.conditions == ("nominal", "rough:0.05", "slope:10", "payload=5")
        terrains = [sim2sim.setting(args, HighFidelity(), c).physics for c in args.conditions]
        assert [t.uneven for t in terrains] == [None, only("rough"), only("slope"), None]
        with pytest.raises(ConfigError, match="need --engine mujoco"):
            sim2sim.Args("x", engine="drake", ground=("slope:10",))

    @pytest.mark.parametrize("fidelity", ["train", "high"])
    def test_evaluate_tries_the_policy_on_it(self, fidelity, monkeypatch):
        """`evaluate --ground` gives the trials this ground at both fidelities."""
        settings, rows = [], [{"command": 1.0}]
        monkeypatch.setattr(
            measure, "measure", lambda policy, setting, *_: settings.append(setting) or rows
        )
        for name in (None, "slope:10"):
            args = evaluate.Args("x", ground=name, fidelity=fidelity)
            (row,) = evaluate.sweep(args, load_policy("xbot_l_run"))
            assert row.get("beyond") == (["ground"] if name else None)
        assert [s.physics.uneven for s in settings] == [None, only("slope")]
        assert all(s.physics.fidelity == fidelity for s in settings)
        with pytest.raises(ConfigError, match="ground: "):
            evaluate.Args("x", ground="bumps:1")

    def test_ground_beyond_the_training_is_marked(self):
        policy = load_policy("xbot_l_run")
        flat = trials.Setting(trials.engine(policy, "high"))
        rough = trials.Setting(trials.engine(policy, "high", perturbations.terrain("rough:0.05")))
        assert trained.beyond(policy, flat) == {}
        assert trained.beyond(policy, rough) == {"beyond": ["ground"]}
        physics_config = dataclasses.replace(policy.config.physics, terrain=ALL)
        config = dataclasses.replace(policy.config, physics=physics_config)
        assert trained.beyond(dataclasses.replace(policy, config=config), rough) == {}
        growing = dataclasses.replace(
            physics_config, terrain=dataclasses.replace(ALL, full_from=9.0)
        )
        half = dataclasses.replace(policy.config, physics=growing)  # v_max 4.5: half of the size
        assert trained.beyond(dataclasses.replace(policy, config=half), rough) == {
            "beyond": ["ground"]
        }

    @pytest.mark.slow(reason="compiles a trial")
    def test_a_trial_records_its_ground(self):
        policy = load_policy("xbot_l_run")
        terrain = perturbations.terrain("slope:10")
        setting = trials.Setting(trials.engine(policy, "high", terrain), seconds=3.0)
        trace = trials.join(list(trials.run(policy, setting, np.array([[1.0, 0.0, 0.0]] * 4))))
        np.testing.assert_allclose(trace.ground.slope, np.tan(np.radians(10.0)), rtol=1e-5)
        assert len(np.unique(trace.ground.yaw[0])) == 4
        up = np.cos(trace.ground.yaw[-1]) * trace.qpos[-1, :, 0]
        climbed = trace.qpos[-1, :, 2] - trace.qpos[100, :, 2]
        standing = trace.alive[-1]
        assert np.corrcoef(up[standing], climbed[standing])[0, 1] > 0.8


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", [(3.0, 1.0), FAR])
def test_the_drawn_ground_is_the_ground(kind, place):
    """The browser's mesh, at its place, has the function's heights at its points."""
    shapes = pytest.importorskip(
        "kslc_jax.viewer.shapes", reason="the extra 'viewer' is not installed"
    )
    bot, ground = robot.load("high", terrain=only(kind)), ground_of(kind)
    pos, quat, far = ground_lib.place(ground, *place, np)
    vertices, faces = shapes.ground(bot.mj_model, int(far))
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, np.asarray(quat, np.float64))
    world = pos + vertices @ turned.reshape(3, 3).T
    near = world[np.hypot(*(world[:, :2] - place).T) < 4.0]
    heights = ground_lib.height(ground, near[:, 0], near[:, 1], np)
    assert np.quantile(np.abs(near[:, 2] - heights), 0.99) < 1e-3
    assert faces.max() == len(vertices) - 1
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal[:, 2] > 0).all()


def test_the_drawn_ground_has_squares_of_two_colours():
    shapes = pytest.importorskip(
        "kslc_jax.viewer.shapes", reason="the extra 'viewer' is not installed"
    )
    corners = np.array([(0.1, 0.1), (0.6, 0.1), (0.6, 0.6), (-0.1, 0.1)])
    light, dark = (255, 255, 255), (10, 20, 30)
    mesh = shapes.checkered(np.c_[corners, np.zeros(4)], np.array([[0, 1, 2]]), (light, dark))
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], [light, dark, light, dark])
