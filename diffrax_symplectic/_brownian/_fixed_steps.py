import sys

import diffrax


def require_fixed_steps(path_name: str) -> None:
    """Raises a `ValueError` if the solve being traced may change its step size.

    Increments whose law depends on the step (weak, truncated) are not the increments of
    one path: they cannot be refined, and to accept or reject a step by looking at them
    biases their law. Diffrax protects `UnsafeBrownianPath` from this by name and tells
    a path nothing about the step size controller. The solve that asks for increments is
    however the innermost call of Diffrax's `loop` on the Python stack while it is
    traced, and that holds both the controller and the solver.
    """
    frame = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__")
        if module == "diffrax._integrate" and frame.f_code.co_name == "loop":
            controller = frame.f_locals.get("stepsize_controller")
            solver = frame.f_locals.get("solver")
            if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
                raise ValueError(
                    f"`{path_name}` cannot be used with the adaptive step size "
                    f"controller `{type(controller).__name__}`: its increments belong "
                    "to one step size and cannot be refined. Pass "
                    "`stepsize_controller=diffrax.ConstantStepSize()` (or "
                    "`diffrax.StepTo`), or use `diffrax.VirtualBrownianTree` as path."
                )
            if isinstance(solver, diffrax.HalfSolver):
                raise ValueError(
                    f"`{path_name}` cannot be used with `diffrax.HalfSolver`: the "
                    "increments of the two half steps do not add up to the one of the "
                    "whole step. Pass the wrapped solver itself, or use "
                    "`diffrax.VirtualBrownianTree` as path."
                )
            return
        frame = frame.f_back


def refuse_half_solver(solver_name: str) -> None:
    """Raises a `ValueError` if asked by a `diffrax.HalfSolver` around this solver.

    Diffrax takes `HalfSolver(solver)` for an implicit solver if `solver` is one, and
    then fails with an `AttributeError`, since it has no `root_finder`.
    """
    # Called by a property of the solver, which is read by the same property of its
    # wrapper; Equinox looks attributes up in frames of its own.
    frame, callers = sys._getframe(1), []
    while frame is not None and len(callers) < 4:
        callers.append(frame.f_locals.get("self"))
        frame = frame.f_back
    if any(isinstance(caller, diffrax.HalfSolver) for caller in callers):
        raise ValueError(
            f"`diffrax.HalfSolver` cannot wrap the implicit solver `{solver_name}`. "
            f"Pass `{solver_name}()` itself, with a fixed step size: symplectic steps "
            "lose what they are for if their size follows the state."
        )
