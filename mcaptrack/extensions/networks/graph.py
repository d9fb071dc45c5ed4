"""Read an ONNX file without running it, refuse what reaches out of it, and change it for pictures of another size.

Only the parts of the format (https://onnx.ai/onnx/repo-docs/IR.html) that are read or changed here, or lead to tensors
and nodes, are declared; the protobuf runtime keeps all others as they are.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Final

import numpy as np

#: The declared fields of each message: name, number, type; "*" marks a repeated one.
_FIELDS: Final[Mapping[str, str]] = {
    "Model": "graph 7 Graph, metadata_props 14 Pair*, training_info 20 Training*, functions 25 Function*",
    "Training": "initialization 1 Graph, algorithm 2 Graph",
    "Function": "node 7 Node*, attribute_proto 11 Attribute*",
    "Graph": "node 1 Node*, initializer 5 Tensor*, input 11 Value*, output 12 Value*, value_info 13 Value*, "
    "sparse_initializer 15 Sparse*",
    "Node": "input 1 string*, output 2 string*, op_type 4 string, attribute 5 Attribute*",
    "Attribute": "name 1 string, t 5 Tensor, g 6 Graph, ints 8 int64*, tensors 10 Tensor*, graphs 11 Graph*, "
    "sparse_tensor 22 Sparse, sparse_tensors 23 Sparse*",
    "Sparse": "values 1 Tensor, indices 2 Tensor",
    "Tensor": "dims 1 int64*, data_type 2 int32, int64_data 7 int64*, name 8 string, raw_data 9 bytes, "
    "external_data 13 Pair*, data_location 14 int32",
    "Value": "name 1 string, type 2 Type",
    "Type": "tensor_type 1 TensorType",
    "TensorType": "elem_type 1 int32, shape 2 Shape",
    "Shape": "dim 1 Dim*",
    "Dim": "dim_value 1 int64, dim_param 2 string",
    "Pair": "key 1 string, value 2 string",
}
_INT64: Final = 7
#: Operators of ONNX Runtime, in some of its builds, that read a file or run code that the file of the network names.
_REACHING: Final = frozenset({"EPContext", "ATen", "PyOp", "PythonOp", "PythonOpGrad", "TritonOp"})
#: The steps, in pixels, of the grids that detectors place their boxes on.
_STRIDES: Final = (4, 8, 16, 32, 64)
#: Longer descriptions of classes are not read.
_MAX_NAMES: Final = 100_000

Size = tuple[int, int]


class NotOnnxError(ValueError):
    """The bytes are no ONNX file, or only a part of one."""


@cache
def _classes() -> dict[str, Any]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="onnx_subset.proto", package="onnx_subset", syntax="proto2")
    for name, declared in _FIELDS.items():
        message = file.message_type.add(name=name)
        for declaration in declared.split(", "):
            field, number, kind = declaration.split()
            label = kinds.LABEL_REPEATED if kind.endswith("*") else kinds.LABEL_OPTIONAL
            kind = kind.rstrip("*")
            added = message.field.add(name=field, number=int(number), label=label)
            if kind in _FIELDS:
                added.type, added.type_name = kinds.TYPE_MESSAGE, f".onnx_subset.{kind}"
            else:
                added.type = getattr(kinds, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    descriptors = {name: pool.FindMessageTypeByName(f"onnx_subset.{name}") for name in _FIELDS}
    return {name: message_factory.GetMessageClass(message) for name, message in descriptors.items()}


def parse(data: bytes) -> Any:
    """Parse an ONNX file. Raises NotOnnxError if it isn't one."""
    from google.protobuf.message import DecodeError

    model = _classes()["Model"]()
    try:
        model.ParseFromString(data)
    except (DecodeError, RecursionError):
        raise NotOnnxError from None
    if not model.graph.node:
        raise NotOnnxError
    return model


def reach(model: Any) -> str:
    """Return why a network needs more than its file, as words that follow its name; "" if it doesn't.

    Whatever holds a tensor or a node is looked at: the graph, branches and bodies of loops, functions, attributes,
    sparse tensors, the graphs of a training. The protobuf runtime has refused messages in more than 100 others.
    """
    kinds = _classes()
    for message in _messages(model):
        if isinstance(message, kinds["Tensor"]) and (message.data_location or message.external_data):
            return (
                "keeps weights in other files (external data), which are not read; save it as one file with "
                "onnx.save(onnx.load(path), path)"
            )
        if isinstance(message, kinds["Node"]) and message.op_type in _REACHING:
            return f"has a node {message.op_type}, which reads files or runs other code; export it without"
    return ""


def class_names(model: Any) -> dict[int, str]:
    """The names of classes by index, as exporters write them into the metadata; empty if there are none."""
    text = next((pair.value for pair in model.metadata_props if pair.key == "names"), "")
    if not text or len(text) > _MAX_NAMES:
        return {}
    try:
        names = ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return {}
    pairs = names.items() if isinstance(names, dict) else enumerate(names) if isinstance(names, (list, tuple)) else ()
    by_index = {index: name for index, name in pairs if type(index) is int and index >= 0 and isinstance(name, str)}
    return by_index if len(by_index) == len(names) else {}


def input_size(model: Any, name: str) -> tuple[int | None, int | None]:
    """Width and height of the pictures that an input takes; None where the graph leaves it open."""
    for value in model.graph.input:
        if value.name == name:
            dims = value.type.tensor_type.shape.dim
            height, width = ((dim.dim_value if dim.dim_value > 0 else None) for dim in dims[2:4])
            return width, height
    return None, None


def resized(data: bytes, name: str, old: Size, new: Size) -> bytes:
    """The same network for pictures of another size, as bytes.

    The shape of the input is replaced, and with it the constants of Reshape and Resize that follow from it: numbers of
    grid cells, and sizes of grids. Whether the result runs has to be tried.
    """
    model = parse(data)
    for value in model.graph.input:
        if value.name == name:
            dims = value.type.tensor_type.shape.dim
            dims[2].dim_value, dims[3].dim_value = new[1], new[0]
    for value in model.graph.output:
        value.type.tensor_type.ClearField("shape")
    del model.graph.value_info[:]
    cells = {old[0] // s * (old[1] // s): new[0] // s * (new[1] // s) for s in _STRIDES}
    grids = {(old[1] // s, old[0] // s): (new[1] // s, new[0] // s) for s in _STRIDES}
    for s in (3, 4):  # all cells of three or four grids, joined
        steps = _STRIDES[1 : s + 1]
        cells[sum(old[0] // t * (old[1] // t) for t in steps)] = sum(new[0] // t * (new[1] // t) for t in steps)
    constants = _constants(model)
    for node in model.graph.node:
        if node.op_type == "Reshape" and len(node.input) > 1 and node.input[1] in constants:
            _replace(constants[node.input[1]], lambda shape: [cells.get(size, size) for size in shape])
        elif node.op_type == "Resize" and len(node.input) > 3 and node.input[3] in constants:
            _replace(constants[node.input[3]], lambda shape: [*shape[:2], *grids.get(tuple(shape[2:]), shape[2:])])
    out: bytes = model.SerializeToString()
    return out


def _messages(root: Any) -> Iterator[Any]:
    """All messages in a message, itself included."""
    waiting = [root]
    while waiting:
        message = waiting.pop()
        yield message
        for field, value in message.ListFields():
            if field.message_type is not None:
                waiting.extend([value] if hasattr(value, "ListFields") else value)


def _constants(model: Any) -> dict[str, Any]:
    """Tensors by the name that nodes refer to them by."""
    out = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type == "Constant" and node.output:
            out.update((node.output[0], attribute.t) for attribute in node.attribute if attribute.HasField("t"))
    return out


def _replace(tensor: Any, change: Any) -> None:
    """Change the whole numbers of a tensor."""
    if tensor.data_type != _INT64:
        return
    raw = tensor.raw_data
    if raw and len(raw) % 8:
        return
    values = np.frombuffer(raw, "<i8").tolist() if raw else list(tensor.int64_data)
    tensor.ClearField("int64_data")
    tensor.raw_data = np.array(change(values), "<i8").tobytes()
