"""What a CUDA graph does, on a CPU, for tests: operations are recorded with the memory they use, and done again.

As with a graph, recording them changes no number, and none of them may ask for a number, which would need waiting.
"""

import contextlib

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

ASKING = {
    getattr(torch.ops.aten, name)
    for name in ("_local_scalar_dense", "nonzero", "_unique2", "equal", "masked_select", "repeat_interleave")
}
INDEXING = {torch.ops.aten.index, torch.ops.aten.index_put, torch.ops.aten.index_put_}  # by a mask, they count


class Graph(TorchDispatchMode):
    """Takes the place of torch.cuda.CUDAGraph: a recording of all that is done inside of it, which `replay` repeats."""

    def __init__(self):
        super().__init__()
        self.done, self.replays = [], 0  # each operation with what it took and returned
        self.inner, self.constant = set(), set()  # places of tensors made here, and of those no input has a part in
        self.before = {}  # numbers that the recording overwrites, by place

    def __enter__(self):
        self.generator = torch.get_rng_state()
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        for written, numbers in self.before.values():
            written.copy_(numbers)
        torch.set_rng_state(self.generator)

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        given = tensors((args, kwargs))
        drawn = torch.Tag.nondeterministic_seeded in operation.tags
        constant = {place(x) for x in given} <= self.constant and not drawn
        masks = operation.overloadpacket in INDEXING and any(x.dtype == torch.bool for x in tensors(args[1]))
        if (masks or operation.overloadpacket in ASKING) and not constant:
            raise RuntimeError(f"{operation} asks the device for a number")
        names = [argument.name for argument in operation._schema.arguments]
        named = {**dict(zip(names, args, strict=False)), **kwargs}
        for argument in operation._schema.arguments:
            if argument.alias_info is not None and argument.alias_info.is_write:
                self.keep(named.get(argument.name))
        used = alias((args, kwargs))
        found = operation(*args, **kwargs)
        made = {place(x) for x in tensors(found)} - {place(x) for x in given}
        if operation is torch.ops.aten.lift_fresh.default:  # a tensor of numbers in the program
            made, constant = {place(found)}, True
        self.inner |= made
        if constant:
            self.constant |= made
        self.done.append((operation, used, alias(found)))
        return found

    def keep(self, written):
        """Remember the numbers that were there before the recording."""
        for each in tensors(written):
            if place(each) not in self.inner | self.before.keys():
                whole = each.detach().as_strided((each.untyped_storage().nbytes() // each.itemsize,), (1,), 0)
                self.before[place(each)] = whole, whole.clone()

    @torch.no_grad()
    @torch.autocast("cpu", enabled=False)  # the casts are among what was recorded
    def replay(self):
        self.replays += 1
        for operation, used, found in self.done:
            args, kwargs = alias(used)
            again = operation(*args, **kwargs)
            for old, new in zip(tensors(found), tensors(again), strict=True):
                if place(old) != place(new):
                    old.copy_(new)


def tensors(tree):
    """The tensors in nested lists, tuples and dicts."""
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def alias(tree):
    """The same tensors as other objects, for some operations change an object's shape."""
    return tree_map_only(torch.Tensor, torch.ops.aten.alias, tree)


def place(x):
    """Where in memory the numbers of a tensor are."""
    return x.untyped_storage().data_ptr()


class Stream:
    """Takes the place of torch.cuda.Stream."""

    def wait_stream(self, other):
        assert isinstance(other, Stream)


def install(monkeypatch):
    """Let scripts record on a CPU; return a list to which every graph that they make is added."""
    made = []
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: made.append(Graph()) or made[-1])
    monkeypatch.setattr(torch.cuda, "graph", lambda graph: graph)
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: contextlib.nullcontext())
    return made
