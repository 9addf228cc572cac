"""A trained policy as a file for other programs; the ending says which kind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.engine.evaluate import policy_path, read_policy, run_spec
from experiments.engine.files import check_ending, write_atomic
from experiments.engine.policy_file import load_meta
from experiments.engine.runtime import need
from ppl_jax.experts import SavedPolicy

ENDINGS = (".npz", ".onnx")
_OPSET, _IR = 17, 8  # of 2022: runtimes since then read the file


def export(run: Path, out: Path) -> None:
    """Write a run's policy to a file.

    Args:
        run: Run folder.
        out: `.npz` (the format of `experiments.engine.policy_file`) or `.onnx` (a graph from
            `observation` [N, O] to `action` [N, A], float32, with the scaling of observations).

    Raises:
        UserError: If there is no policy, or the ending is another.
    """
    check_ending(out, ENDINGS)
    source = policy_path(run)
    policy = read_policy(source, run_spec(run))
    if out.suffix == ".onnx":
        content = to_onnx(policy, load_meta(source)).SerializeToString()
    else:
        content = source.read_bytes()
    write_atomic(out, lambda file: file.write(content))


def to_onnx(policy: SavedPolicy, meta: dict[str, Any]) -> Any:
    """An `onnx.ModelProto` of a policy.

    Args:
        policy: The policy; a stochastic one's mean.
        meta: Facts about it, kept as the model's metadata.

    Raises:
        UserError: If onnx is not installed.
    """
    onnx = need("onnx", "onnx", "an .onnx file")
    helper, numpy_helper = onnx.helper, need("onnx.numpy_helper", "onnx", "an .onnx file")
    constants: dict[str, np.ndarray] = {"obs_mean": policy.obs_mean, "obs_scale": policy.obs_scale}
    nodes = [
        helper.make_node("Sub", ["observation", "obs_mean"], ["centred"]),
        helper.make_node("Div", ["centred", "obs_scale"], ["layer0"]),
    ]
    last = len(policy.weights) - 1
    for i, (w, b) in enumerate(policy.weights):
        constants |= {f"w{i}": w, f"b{i}": b}
        nodes.append(helper.make_node("Gemm", [f"layer{i}", f"w{i}", f"b{i}"], [f"sum{i}"]))
        if i < last:
            between = {"relu": "Relu", "tanh": "Tanh"}[policy.activation]
            nodes.append(helper.make_node(between, [f"sum{i}"], [f"layer{i + 1}"]))
    if policy.output == "tanh":
        nodes.append(helper.make_node("Tanh", [f"sum{last}"], ["action"]))
    else:
        constants |= {"low": np.array(-1.0), "high": np.array(1.0)}
        nodes.append(helper.make_node("Clip", [f"sum{last}", "low", "high"], ["action"]))
    kind = onnx.TensorProto.FLOAT
    sizes = policy.weights[0][0].shape[0], policy.weights[-1][0].shape[1]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", kind, ["N", sizes[0]])],
        [helper.make_tensor_value_info("action", kind, ["N", sizes[1]])],
        [
            numpy_helper.from_array(np.asarray(value, np.float32), name)
            for name, value in constants.items()
        ],
    )
    model = helper.make_model(
        graph,
        producer_name="ppl-jax",
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR,
    )
    helper.set_model_props(model, {name: json.dumps(value) for name, value in meta.items()})
    onnx.checker.check_model(model)
    return model
