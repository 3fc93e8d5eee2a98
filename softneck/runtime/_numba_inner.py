"""numba pipelines that optimise a runtime once: inner functions are only linked into the functions that call them.

numba alone optimises every function and makes machine code of it, although it does so again in each function that calls
it: most of the time to compile a kind. Inner functions, which Python never calls, are left as they are lowered. Their
text is optimised with the function that Python calls.
"""

from __future__ import annotations

from collections.abc import Iterator
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
    from numba import _dynfunc  # pyright: ignore[reportAttributeAccessIssue]
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import CompilerBase, DefaultPassBuilder, _LowerResult
    from numba.core.compiler_machinery import register_pass
    from numba.core.environment import lookup_environment
    from numba.core.typed_passes import NativeLowering

    class LinkedLibrary(JITCodeLibrary):
        def finalize(self) -> None:
            for library in dict.fromkeys(self._linking_libraries):
                self._reload_init.update(library._reload_init)
                self._final_module.link_in(library._get_module_for_linking(), preserve=True)
            self._final_module.verify()
            self._finalized = True

    @register_pass(mutates_CFG=True, analysis_only=False)
    class InnerLowering(NativeLowering):
        _name = "inner_lowering"

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

        def run_pass(self, state: Any) -> Literal[True]:
            super().run_pass(state)
            # The inner functions got their place in memory now: tell them their environments.
            for variable in state.library._final_module.global_variables:
                env = lookup_environment(variable.name) if variable.name.startswith("_ZN08NumbaEnv") else None
                if env is not None:
                    state.library.codegen.set_env(variable.name, env)
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
