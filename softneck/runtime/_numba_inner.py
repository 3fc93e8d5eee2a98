"""numba pipelines that optimise a runtime once: inner functions are only linked into the functions that call them.

numba alone optimises every function and makes machine code of it, although it does so again in each function that calls
it: most of the time to compile a kind. Inner functions, which Python never calls, are left as they are lowered. Their
text is optimised with the function that Python calls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal

# It is tested with this version, as others may differ inside: with them, runtimes are compiled in numba's own way.
_TESTED = (0, 68)


@cache
def pipelines() -> tuple[Any, Any] | None:
    """Return the `pipeline_class` of functions that Python calls and of inner ones; None with another numba."""
    import numba

    if numba.version_info[:2] != _TESTED:
        return None
    from llvmlite.binding import Linkage
    from numba import _dynfunc  # pyright: ignore[reportAttributeAccessIssue]
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import CompilerBase, DefaultPassBuilder, _LowerResult
    from numba.core.compiler_machinery import register_pass
    from numba.core.environment import lookup_environment
    from numba.core.typed_passes import NativeLowering

    lower_class = borrowing_lower()

    class LinkedLibrary(JITCodeLibrary):
        def finalize(self) -> None:
            for library in dict.fromkeys(self._linking_libraries):
                self._reload_init.update(library._reload_init)
                self._final_module.link_in(library._get_module_for_linking(), preserve=True)
            self._final_module.verify()
            self._finalized = True

    class OuterLibrary(JITCodeLibrary):
        def _optimize_final_module(self) -> None:
            # Nobody else calls what is linked in, so LLVM may put a function that is called once in its caller: with up
            # to 40 arrays as arguments, a call took longer than the equations.
            for function in self._final_module.functions:
                if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
                    function.linkage = "internal"
            super()._optimize_final_module()

    @register_pass(mutates_CFG=True, analysis_only=False)
    class InnerLowering(NativeLowering):
        _name = "inner_lowering"

        @property
        def lowering_class(self) -> Any:
            return lower_class

        def run_pass(self, state: Any) -> Literal[True]:
            state.library = LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
            state.library.enable_object_caching()
            state.flags.no_compile = True
            super().run_pass(state)
            fndesc, call_helper, _, env = state["cr"]
            # A function without code, which numba asks for: Python never calls it.
            name = fndesc.qualname.rpartition(".")[2]
            nothing = _dynfunc.make_function(fndesc.lookup_module(), name, "", 0, env, (state.library,))
            state.targetctx.insert_user_function(nothing, fndesc, [state.library])
            state.reload_init.extend(state.library._reload_init)
            state["cr"] = _LowerResult(fndesc, call_helper, cfunc=nothing, env=env)
            return True

    @register_pass(mutates_CFG=True, analysis_only=False)
    class OuterLowering(NativeLowering):
        _name = "outer_lowering"

        @property
        def lowering_class(self) -> Any:
            return lower_class

        def run_pass(self, state: Any) -> Literal[True]:
            library: Any = OuterLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
            library.enable_object_caching()
            state.library = library
            super().run_pass(state)
            # The inner functions got their place in memory now: tell them their environments.
            for variable in library._final_module.global_variables:
                env = lookup_environment(variable.name) if variable.name.startswith("_ZN08NumbaEnv") else None
                if env is not None:
                    library.codegen.set_env(variable.name, env)
            return True

    def compiler(lowering: Any) -> Any:
        class Compiler(CompilerBase):
            def define_pipelines(self) -> list[Any]:
                made = DefaultPassBuilder.define_nopython_pipeline(self.state)
                made.passes = [(lowering if step is NativeLowering else step, text) for step, text in made.passes]
                made.finalize()
                return [made]

            def _compile_core(self) -> Any:
                with _known_calls():
                    return super()._compile_core()

        return Compiler

    return compiler(OuterLowering), compiler(InnerLowering)


def borrowing_lower() -> Any:
    """Return numba's lowering, which counts no references to arguments, items of tuples and views of arrays of them.

    The caller holds these as long as a function runs. To count them at each call of an inner function, for each of 17
    arrays of a controller, took as long as its equations.
    """
    from numba.core import ir, types
    from numba.core.lowering import Lower

    class BorrowingLower(Lower):
        _borrowed: frozenset[str] = frozenset()
        _uncounted = False

        def lower(self) -> None:
            self._borrowed = _borrowed_variables(self.func_ir, self.typeof)
            super().lower()

        def lower_assign(self, ty: Any, inst: Any) -> Any:
            value, borrowed = inst.value, inst.target.name in self._borrowed
            if not borrowed or not isinstance(value, ir.Expr):
                with self._counting(not borrowed):
                    return super().lower_assign(ty, inst)
            whole: Any = self.typeof(value.value.name)
            if (
                isinstance(whole, types.Tuple | types.UniTuple)
                and isinstance(value.index, int)
                and whole.types[value.index] == ty
            ):
                return self.builder.extract_value(self.loadvar(value.value.name), value.index % len(whole))
            made = super().lower_assign(ty, inst)
            self.decref(ty, made)  # takes back what was counted a line before: LLVM removes both
            return made

        def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
            with self._counting(name not in self._borrowed):
                super().storevar(value, name, argidx)

        def delvar(self, name: str) -> None:
            with self._counting(name not in self._borrowed):
                super().delvar(name)

        def incref(self, typ: Any, val: Any) -> None:
            if not self._uncounted:
                super().incref(typ, val)

        def decref(self, typ: Any, val: Any) -> None:
            if not self._uncounted:
                super().decref(typ, val)

        @contextmanager
        def _counting(self, counted: bool) -> Iterator[None]:
            self._uncounted = not counted
            try:
                yield
            finally:
                self._uncounted = False

    return BorrowingLower


def _borrowed_variables(function: Any, type_of: Callable[[str], Any]) -> frozenset[str]:
    """Return the variables of numba's `function` that are always an argument, a part of one, or a view of a part."""
    from numba.core import ir, types

    def source(value: Any, target: str) -> str | None:
        if isinstance(value, ir.Var):
            return value.name
        if not isinstance(value, ir.Expr) or value.op not in ("static_getitem", "getitem"):
            return None
        whole, fixed = type_of(value.value.name), value.op == "static_getitem"
        if isinstance(whole, types.BaseTuple):
            return value.value.name if fixed else None
        if not isinstance(whole, types.Array) or not isinstance(type_of(target), types.Array):
            return None
        index = value.index_var if fixed else value.index
        places: Any = None if index is None else type_of(index.name)
        places = places.types if isinstance(places, types.Tuple | types.UniTuple) else [places]
        # An array of places makes a copy, which nobody else holds.
        view = all(isinstance(place, types.Integer | types.SliceType) for place in places)
        return value.value.name if view else None

    assigned: dict[str, list[Any]] = {}
    for block in function.blocks.values():
        for one in block.find_insts(ir.Assign):
            assigned.setdefault(one.target.name, []).append(one.value)
    once = {name: values[0] for name, values in assigned.items() if len(values) == 1}
    found: set[str] = set()
    while more := {
        name for name, value in once.items()
        if name not in found and (isinstance(value, ir.Arg) or source(value, name) in found)
    }:  # fmt: skip
        found |= more
    return frozenset(found)


@contextmanager
def _known_calls() -> Iterator[None]:
    """Let numba look up the types of a call that it has resolved before, instead of trying all overloads again.

    A sixth of the time to compile: for a product of two floats it tries those of texts and sets too, each time. For
    functions that are compiled elsewhere in the process nothing changes; numba compiles one at a time.
    """
    from numba.core.types import Function

    if "get_call_type" in vars(Function):
        yield  # an inner function
        return
    Function.get_call_type = _known_call_type  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        del Function.get_call_type


def _known_call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
    from numba.core.targetconfig import ConfigStack
    from numba.core.types.functions import BaseFunction

    if kws:
        return BaseFunction.get_call_type(function, context, args, kws)
    flags = ConfigStack.top_or_none()
    # With another overload it is another function.
    key = (function, context, tuple(args), repr(None if flags is None else flags._values))
    if key not in _CALLS:
        _CALLS[key] = BaseFunction.get_call_type(function, context, args, kws)
    return _CALLS[key]


# (function, context, types of the arguments, flags) -> signature.
_CALLS: dict[Any, Any] = {}
