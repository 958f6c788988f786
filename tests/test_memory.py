"""The memory estimate of a training against numbers worked out by hand."""

import dataclasses
import functools

import jax
import pytest

from kslc_jax import rollout, train_step
from kslc_jax.config import Config, ConfigError, preset
from kslc_jax.training import memory

PAPER = preset("paper")


def update(config: Config, devices: int = 1) -> float:
    return memory._update(config, *memory.shapes(config), devices)


@pytest.fixture
def on_a_gpu(monkeypatch):
    """JAX says that its default device is a GPU. So a minibatch is not taken in pieces."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


SAMPLE = 4 * (16 + 16 + 5) + 1
"""Bytes of one sample: action, mean; index, log_prob, value, advantage, target; valid."""


def test_update_of_the_debug_preset(debug):
    """16 environments x 8 steps, 3 and 3 frames, minibatches of 64, 112 hidden units, symmetric."""
    frames = 16 * ((8 + 2) * 59 + (8 + 2) * 97 + 8 * 3)  # and the estimated velocities
    minibatch = 64 * (2 * 3 * (59 + 97) + 3 * 112)
    assert update(debug) == pytest.approx(4 * (frames + minibatch) + 128 * SAMPLE)
    assert update(debug) == pytest.approx(446_080)


def update_of_paper(at_once: int) -> tuple[int, int]:
    """Bytes of frames and samples, and of `at_once` samples of a minibatch: 4096 environments x 60
    steps, 15 and 3 frames, 2048 hidden units."""
    frames = 4 * 4096 * ((60 + 14) * 59 + (60 + 2) * 89)
    samples = 245_760 * SAMPLE
    return frames + samples, 4 * at_once * (15 * 59 + 3 * 89 + 3 * 2048)


def test_update_of_the_paper_preset_on_a_cpu():
    """Each minibatch of 61440 samples is taken in 40 pieces."""
    assert update(PAPER) == pytest.approx(sum(update_of_paper(1536)))


def test_update_of_the_paper_preset_on_gpus(on_a_gpu):
    all_devices, minibatch = update_of_paper(61_440)
    assert update(PAPER) == pytest.approx(all_devices + minibatch)
    assert update(PAPER, 4) == pytest.approx(all_devices + minibatch / 4)


def test_rollout():
    """The rollout needs memory for the trajectory and for the control step of the environments."""
    physics = dataclasses.replace(PAPER.physics, engine="mjx")
    mjx = dataclasses.replace(PAPER, physics=physics)
    mujoco = dataclasses.replace(PAPER, physics=dataclasses.replace(PAPER.physics, engine="mujoco"))
    terms = len(dataclasses.fields(PAPER.rewards.weights))
    # action, mean, log_prob, value, age, frames; reward, terms, two speeds, episode_steps, 9 flags
    trajectory = 4096 * 60 * (4 * (16 + 16 + 3 + 59 + 89 + 1 + terms + 2 + 1) + 9)
    _, shape, _ = memory.shapes(PAPER)
    assert memory._rollout(mujoco, shape, 1e6, 1) == trajectory + 3e6
    assert memory._rollout(mjx, shape, 1e6, 1) == trajectory + 3e6 + 4096 * 25 * 1024
    assert memory._rollout(mjx, shape, 1e6, 4) == trajectory / 4 + 3e6 + 1024 * 25 * 1024


def test_shapes_are_those_of_the_program(debug):
    """The estimate leaves the physics out of the rollout; the shapes do not depend on it."""
    state = jax.eval_shape(lambda: train_step.init(debug, 0))
    args = state.learner.params, state.env, state.curriculum, state.key
    _, trajectory = jax.eval_shape(functools.partial(rollout.collect, debug), *args)
    assert memory.shapes(debug)[1] == trajectory


def test_the_paper_preset_fits_a_gpu_of_15_gb(on_a_gpu):
    need = memory.estimate(PAPER)
    assert 1.5e9 < need < 3e9
    assert memory.estimate(PAPER, devices=4) < 0.5 * need


def test_what_cannot_fit_is_refused(monkeypatch, on_a_gpu):
    class Device:
        device_kind = "a small GPU"

        def memory_stats(self):
            return {"bytes_limit": 2 * 2**30}

    monkeypatch.setattr(jax, "local_devices", lambda: [Device()])
    memory.check(PAPER)
    large = dataclasses.replace(PAPER, env=dataclasses.replace(PAPER.env, num_envs=8192))
    with pytest.raises(
        ConfigError, match=r"needs about 3\.8 GiB, a small GPU has 2.*env\.num_envs"
    ):
        memory.check(large)


def test_words():
    assert memory.shown(0.51 * 2**20) == "0.5 MiB"
    assert memory.shown(233 * 2**20) == "233 MiB"
    assert memory.shown(1.91 * 2**30) == "1.9 GiB"
    assert memory.measured(object()) is None
