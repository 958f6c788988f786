"""Export a policy to a file for other programs: python -m kslc_jax.export POLICY policy.onnx

Writes the network `history [batch, K, W] -> action [batch, n]`, and beside it what a robot's
computer needs to run it. For policy.onnx these are policy.json (joint order, gains, limits, frame
layout, gait clock; the ONNX file has them as metadata, too), policy.xml (the robot's model, an MJCF
without meshes) and policy.npz (a golden trace, to test a program with). OUT ends in .onnx or
.stablehlo (read back by jax.export). The file is then compared with JAX over observations of the
policy at work. With --format orbax OUT is a folder that `kslc_jax.load_policy` reads: config and
actor-critic parameters, without the rest of a checkpoint. See docs/export.md.

POLICY is a run folder, a checkpoint folder, or the name of a shipped policy.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import tyro

from kslc_jax import __version__, cli, contract, files, processors
from kslc_jax.config import Config, ConfigError

if TYPE_CHECKING:
    from kslc_jax.networks import Params, Parity
    from kslc_jax.policy import Policy

Format = Literal["onnx", "stablehlo", "orbax"]
Network = Callable[[np.ndarray], np.ndarray]
"""Histories [B, K, W] -> actions [B, n]."""
Layers = list[tuple[np.ndarray, np.ndarray]]
"""Kernels [in, out] and biases [out]."""

INSTALL = "pip install 'kslc_jax[export]'"
TOLERANCE = 1e-5
"""Largest allowed difference from JAX in a component of the action. 1 means `action_scale` rad."""
SAMPLES = 1000
"""Number of observations in the comparison."""

_OPSET, _IR_VERSION = 17, 8
"""Versions of the ONNX format, old enough for the runtimes on robots (onnxruntime 1.12, 2022)."""


@dataclass(frozen=True)
class Args:
    """The policy and the file to write."""

    policy: tyro.conf.Positional[Path]
    """Run folder, checkpoint folder, or name of a shipped policy."""
    out: tyro.conf.Positional[Path]
    """File to write, .onnx or .stablehlo; with --format orbax, folder to write."""
    format: Format | None = None
    """Format of OUT. Needed if OUT has another suffix, and always for orbax."""

    def __post_init__(self):
        if self.chosen not in get_args(Format):
            raise ConfigError(
                f"out: '{self.out.name}' ends in neither .onnx nor .stablehlo; say it with --format"
            )
        if self.out in self.written[1:]:
            raise ConfigError(f"out: {self.out} has the name of a file that is written beside it")

    @property
    def chosen(self) -> str:
        """The given format, or the suffix of OUT."""
        return self.format or self.out.suffix[1:]

    @property
    def written(self) -> list[Path]:
        """The files or the folder that the command writes, OUT first."""
        return [self.out] if self.chosen == "orbax" else [self.out, *contract.paths(self.out)]


# ------------------------------------------------------------------------------------------- onnx


def dense_layers(config: Config, params: Params, network: Literal["actor", "estimator"]) -> Layers:
    """Kernels [in, out] and biases [out] of a network as a plain MLP.

    Its input is the flat history. If there is an estimator, the estimated velocity follows as
    further input of the actor. A symmetric network becomes a plain MLP, too: in the bases of
    `networks.parity` its even and odd layers are the blocks of a dense layer. The MLP needs twice
    the work, but every runtime has its operations.
    """
    import jax

    from kslc_jax import networks, observations, physics

    weights = jax.tree.map(lambda x: np.asarray(x, np.float64), params[network])
    layers = [weights[f"Dense_{i}"] for i in range(len(weights))]
    robot = physics.robot_for(config.physics)
    table = observations.actor_table(robot)
    gain = np.tile(networks.input_gain(config, table), config.env.frames)
    if network == "actor" and config.network.estimator:
        gain = np.append(gain, np.ones(networks.ESTIMATED))
    if not config.network.symmetric:
        plain = [(layer["kernel"], layer["bias"]) for layer in layers]
        return _with_gain(gain, plain)

    def pairs(size: int) -> Parity:
        return networks.parity(np.roll(np.arange(size), size // 2), np.ones(size))

    frame = networks.mirrored_frame(table, robot)
    inputs, outputs = [frame] * config.env.frames, networks.mirrored_velocity()
    if network == "actor":
        inputs += [outputs] if config.network.estimator else []
        outputs = networks.mirrored_joints(robot)
    bases = [_stacked(inputs), *map(pairs, getattr(config.network, network)), outputs]
    symmetric = [
        (
            a.even @ even["kernel"] @ b.even.T + a.odd @ odd["kernel"] @ b.odd.T,
            even["bias"] @ b.even.T,
        )
        for even, odd, a, b in zip(layers[::2], layers[1::2], bases[:-1], bases[1:], strict=True)
    ]
    return _with_gain(gain, symmetric)


def _with_gain(gain: np.ndarray, layers: Layers) -> Layers:
    """The layers with `gain` [in] on the inputs of the first one."""
    (kernel, bias), *others = layers
    return [(gain[:, None] * kernel, bias), *others]


def _stacked(parts: list[Parity]) -> Parity:
    """Bases for several vectors, one after the other."""
    from scipy.linalg import block_diag

    from kslc_jax import networks

    even, odd = ([getattr(part, name) for part in parts] for name in ("even", "odd"))
    return networks.Parity(block_diag(*even), block_diag(*odd))


def to_onnx(policy: Policy) -> bytes:
    """The network as ONNX, with `metadata` as JSON values.

    The graph is Flatten, then Gemm layers with Elu between them. An estimator comes first; Concat
    appends its output to the flat history.

    Raises:
      ConfigError: the package onnx is missing.
    """
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError as error:
        raise ConfigError(f"ONNX files need the package onnx: {INSTALL}") from error

    def floats(name: str, *shape: str | int):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    nodes, weights = [helper.make_node("Flatten", ["history"], ["flat"], axis=1)], []

    def add(network: Literal["actor", "estimator"], value: str, result: str) -> None:
        layers = dense_layers(policy.config, policy.params, network)
        for i, layer in enumerate(layers):
            names = [f"{network}_kernel_{i}", f"{network}_bias_{i}"]
            weights.extend(
                numpy_helper.from_array(x.astype(np.float32), name)
                for x, name in zip(layer, names, strict=True)
            )
            out = result if i == len(layers) - 1 else f"{network}_dense_{i}"
            nodes.append(helper.make_node("Gemm", [value, *names], [out]))
            if out != result:
                value = f"{network}_elu_{i}"
                nodes.append(helper.make_node("Elu", [out], [value]))

    seen = "flat"
    if policy.config.network.estimator:
        add("estimator", "flat", "velocity")
        nodes.append(helper.make_node("Concat", ["flat", "velocity"], ["seen"], axis=1))
        seen = "seen"
    add("actor", seen, "action")
    history = floats("history", "batch", *policy.init().history.shape)
    data = contract.metadata(policy)
    action = floats("action", "batch", len(data["joint_names"]))
    model = helper.make_model(
        helper.make_graph(nodes, "policy", [history], [action], weights),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="kslc_jax",
        producer_version=__version__,
    )
    helper.set_model_props(model, {k: json.dumps(v) for k, v in data.items()})
    checker.check_model(model, full_check=True)
    return model.SerializeToString()


def read_onnx(path: Path) -> Network:
    """The network of an ONNX file, run by onnxruntime; ImportError if that is missing."""
    import onnxruntime

    options, on = onnxruntime.SessionOptions(), ["CPUExecutionProvider"]
    options.intra_op_num_threads = processors.usable()  # it knows no quota
    session = onnxruntime.InferenceSession(str(path), options, providers=on)
    return lambda histories: np.asarray(session.run(["action"], {"history": histories})[0])


# -------------------------------------------------------------------------------------- stablehlo


def to_stablehlo(policy: Policy) -> bytes:
    """The network, serialised by `jax.export` for CPU, CUDA and TPU, for any batch size."""
    import jax
    import jax.export
    import jax.numpy as jnp

    (batch,) = jax.export.symbolic_shape("batch")
    shape = (batch, *policy.init().history.shape)
    export = jax.export.export(jax.jit(jax.vmap(policy.act_on)), platforms=("cpu", "cuda", "tpu"))
    with _without_folders():
        return bytes(export(jax.ShapeDtypeStruct(shape, jnp.float32)).serialize())


@contextlib.contextmanager
def _without_folders() -> Generator[None]:
    """JAX notes the source line of each operation; here without the folders of this machine."""
    import jax

    name = "jax_hlo_source_file_canonicalization_regex"
    before = getattr(jax.config, name)
    jax.config.update(name, ".*/")
    try:
        yield
    finally:
        jax.config.update(name, before)


def read_stablehlo(path: Path) -> Network:
    """The network of a StableHLO file, run by JAX."""
    import jax.export

    exported = jax.export.deserialize(bytearray(path.read_bytes()))
    return lambda histories: np.asarray(exported.call(histories))


# ------------------------------------------------------------------------------------------ orbax


def read_orbax(path: Path) -> Network:
    """The network of a policy folder."""
    import jax

    from kslc_jax.policy import load_policy

    act = jax.jit(jax.vmap(load_policy(path).act_on))
    return lambda histories: np.asarray(act(histories))


# ------------------------------------------------------------------------------------- comparison

WRITE = {"onnx": to_onnx, "stablehlo": to_stablehlo}
READ = {"onnx": read_onnx, "stablehlo": read_stablehlo, "orbax": read_orbax}


def recorded(policy: Policy, robots: int = 10, steps: int = 500) -> np.ndarray:
    """Recorded histories [SAMPLES, K, W] of the policy, under random commands of its own range."""
    import jax

    from kslc_jax import env
    from kslc_jax.evaluation import trials

    config = trials.trial_config(policy.config, trials.Setting(policy.config.physics), robots)

    def one(states, key):
        actions = jax.vmap(policy.act_on)(states.history)
        new, _ = jax.vmap(env.step, (None, 0, 0, 0, None))(
            config, states, actions, jax.random.split(key, robots), policy.curriculum
        )
        return new, states.history

    def run(key):
        key_reset, key_run = jax.random.split(key)
        states = jax.vmap(env.reset, (None, 0, None))(
            config, jax.random.split(key_reset, robots), policy.curriculum
        )
        return jax.lax.scan(one, states, jax.random.split(key_run, steps))[1]

    histories = np.asarray(jax.jit(run)(jax.random.key(0)))
    histories = histories.reshape(-1, *histories.shape[2:])
    return histories[:: len(histories) // SAMPLES][:SAMPLES]


def difference(policy: Policy, network: Network, histories: np.ndarray) -> float:
    """Largest absolute difference between the network's actions and the policy's."""
    import jax

    with jax.default_matmul_precision("highest"):
        wanted = np.asarray(jax.jit(jax.vmap(policy.act_on))(histories))
    return float(np.max(np.abs(network(histories) - wanted)))


def compare(policy: Policy, path: Path, form: str) -> str:
    """Compares the file with the policy; returns the result as a sentence.

    Raises:
      ConfigError: an action differs by more than `TOLERANCE`.
    """
    try:
        network = READ[form](path)
    except ImportError as error:
        return f"not compared with JAX: {error.name} is missing, {INSTALL}"
    histories = recorded(policy)
    error = difference(policy, network, histories)
    if not error <= TOLERANCE:
        raise ConfigError(f"{path} differs from JAX by {error:.1e}: do not use it")
    return f"equals JAX within {error:.1e} over {len(histories)} recorded observations"


# ----------------------------------------------------------------------------------- command line


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run(lambda: _export(cli.parse("export", Args, argv, __doc__)))


def _export(args: Args) -> None:
    """Writes the policy, and compares the file with the policy."""
    from kslc_jax.policy import load_policy

    if args.chosen == "orbax" and os.path.exists(args.out):
        raise ConfigError(f"cannot write {args.out}: it is there already; name a new folder")
    for path in args.written:
        files.require_writable(path)
    policy = load_policy(args.policy)
    _write(policy, args)
    print(f"wrote {args.out}, train step {policy.step}")
    print(compare(policy, args.out, args.chosen))


def _write(policy: Policy, args: Args) -> None:
    from kslc_jax.policy import save_policy

    if args.chosen == "orbax":
        save_policy(policy, args.out)
        return
    with files.saving(args.out) as part:
        part.write_bytes(WRITE[args.chosen](policy))
    contract.write(policy, args.out)


if __name__ == "__main__":
    sys.exit(main())
