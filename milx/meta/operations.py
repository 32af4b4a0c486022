"""Operations of JAX that kernels of a GPU compute, which can be given rules for derivatives and maps."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import mlir

MOST_NUMBERS = 2**31 - 2**16
"""Most numbers in an array, so that 32 bits count them, and those that the last programs have beyond its end."""


def operation(function: Callable[..., jax.Array]) -> Primitive:
    """Makes an operation of a function of arrays and static settings, which are its keywords."""
    primitive = Primitive(function.__name__)
    settings = [each.name for each in inspect.signature(function).parameters.values() if each.kind == each.KEYWORD_ONLY]
    jitted = jax.jit(function, static_argnames=settings)  # which traces it once for each shape

    def shaped(*args: Any, **settings: Any) -> Any:
        found = jitted.eval_shape(*(jax.ShapeDtypeStruct(arg.shape, arg.dtype) for arg in args), **settings)
        return jax.core.ShapedArray(found.shape, found.dtype)

    primitive.def_impl(jitted)
    primitive.def_abstract_eval(shaped)
    mlir.register_lowering(primitive, mlir.lower_fun(jitted, multiple_results=False))
    return primitive
