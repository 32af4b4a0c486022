"""Operations of JAX that kernels of a GPU compute, which can be given rules for derivatives and maps."""

import contextlib
import contextvars
import inspect
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import mlir

MOST_NUMBERS = 2**31 - 2**24
"""Most numbers in an array: 32 bits count them, and those to which the last programs would go on."""
MOST_TASKS = 2**16 - 1
"""Most tasks that are computed together: CUDA's bound on an axis of programs."""
PROGRAMS = 1056
"""Programs that keep an H200 busy: eight for each multiprocessor."""
_PORTABLE = contextvars.ContextVar("portable", default=False)


@contextlib.contextmanager
def portable() -> Iterator[None]:
    """Lets programs that are lowered inside it use no kernels of a GPU, so that they can be saved and run elsewhere."""
    token = _PORTABLE.set(True)
    try:
        yield
    finally:
        _PORTABLE.reset(token)


def operation(by_kernel: Callable[..., jax.Array], plainly: Callable[..., jax.Array]) -> Primitive:
    """Makes an operation of JAX.

    Args:
        by_kernel: computes it on a CUDA device: an array from arrays, and from static settings, which are its keywords.
            With the keyword `interpret` it runs on any device.
        plainly: computes the same on any device; it has the same keywords, but for `interpret`.

    Returns:
        The operation, without rules for derivatives and maps.
    """
    primitive = Primitive(by_kernel.__name__)
    found = inspect.signature(by_kernel).parameters.values()
    settings = [each.name for each in found if each.kind == each.KEYWORD_ONLY]
    kernel = jax.jit(by_kernel, static_argnames=settings)  # which traces it once for each shape

    def anywhere(*args: jax.Array, interpret: bool, **settings: Any) -> jax.Array:
        return by_kernel(*args, interpret=True, **settings) if interpret else plainly(*args, **settings)

    def shaped(*args: Any, **settings: Any) -> Any:
        result = kernel.eval_shape(*(jax.ShapeDtypeStruct(arg.shape, arg.dtype) for arg in args), **settings)
        return jax.core.ShapedArray(result.shape, result.dtype)

    by_cuda, by_others = (
        mlir.lower_fun(function, multiple_results=False)
        for function in (kernel, jax.jit(anywhere, static_argnames=settings))
    )

    def lower(*args: Any, **settings: Any) -> Any:
        return (by_others if _PORTABLE.get() else by_cuda)(*args, **settings)

    primitive.def_impl(jax.jit(primitive.bind, static_argnames=settings))
    primitive.def_abstract_eval(shaped)
    mlir.register_lowering(primitive, by_others)
    mlir.register_lowering(primitive, lower, platform="cuda")
    return primitive


def check_numbers(name: str, *shapes: tuple[int, ...]) -> None:
    """Raises a ValueError if one of an operation's arrays has more numbers than 32 bits count."""
    for numbers in map(math.prod, shapes):
        if numbers > MOST_NUMBERS:
            raise ValueError(f"{name}: got an array of {numbers} numbers, expected at most {MOST_NUMBERS}")
