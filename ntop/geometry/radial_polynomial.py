"""Odd polynomials r(x) = x (1 + k1 x^2 + k2 x^4 + ...) on tensors, and their inverse.

Serves the angle of a Kannala-Brandt lens and the radial distortion of a pinhole. The inverse is
asked for on the monotone range only (`ntop.geometry.monotone`).
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

MAX_ITERATIONS = 12  # 3-6 are enough; tests count them on ordinary and on nearly folded lenses
CONVERGED = 2.0**-52  # of the radius, in float64

Coefficients = tuple[float, ...]


def ratio(squared: Float[Tensor, "*batch"], coefficients: Coefficients) -> Float[Tensor, "*batch"]:
    """r(x) / x = 1 + k1 x^2 + k2 x^4 + ..., from x^2."""
    total = torch.zeros_like(squared)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * squared
    return 1 + total


def slope(squared: Float[Tensor, "*batch"], coefficients: Coefficients) -> Float[Tensor, "*batch"]:
    """dr/dx, from x^2."""
    return ratio(squared, tuple((2 * i + 3) * k for i, k in enumerate(coefficients)))


def inverse(
    radius: Float[Tensor, "*batch"], coefficients: Coefficients, *, limit: float
) -> Float[Tensor, "*batch"]:
    """The x in [0, limit] with r(x) = radius; radii beyond r(limit) give `limit`.

    The gradient is 1 / r'(x), by the implicit function theorem, never through the iteration.

    Args:
        radius: >= 0 and finite.
        coefficients: k1, k2, ...
        limit: End of the range asked for; r grows on [0, limit].
    """
    return _Inverse.apply(radius, coefficients, limit)


class _Inverse(torch.autograd.Function):
    """Solves without recording, differentiates by the theorem."""

    @staticmethod
    def forward(
        radius: Float[Tensor, "*batch"], coefficients: Coefficients, limit: float
    ) -> Float[Tensor, "*batch"]:
        solution, _ = solve(radius.double(), coefficients, limit=limit)
        return solution.to(radius.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        _, ctx.coefficients, ctx.limit = inputs
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (solution,) = ctx.saved_tensors
        inside = solution < ctx.limit  # clipped radii move nothing
        rate = slope(solution * solution, ctx.coefficients)
        rate = torch.where(inside, rate, torch.ones_like(rate))
        return torch.where(inside, gradient / rate, torch.zeros_like(gradient)), None, None


def solve(
    radius: Float[Tensor, "*batch"], coefficients: Coefficients, *, limit: float
) -> tuple[Float[Tensor, "*batch"], int]:
    """The inverse and the number of iterations, in float64: bracketed Newton of second order.

    A step goes to the root of the local parabola, which also settles next to a fold, where the
    slope vanishes and plain Newton only halves its error. A step that leaves the bracket becomes a
    bisection.
    """
    low, high = torch.zeros_like(radius), torch.full_like(radius, limit)
    at = torch.minimum(radius, high)
    beyond = radius >= high * ratio(high * high, coefficients)
    at = torch.where(beyond, high, at)
    for iterations in range(MAX_ITERATIONS):
        squared = at * at
        miss = radius - at * ratio(squared, coefficients)
        low, high = torch.where(miss >= 0, at, low), torch.where(miss <= 0, at, high)
        if bool(((miss.abs() <= CONVERGED * radius) | beyond).all()):
            return at, iterations
        rate = slope(squared, coefficients)
        bend = _bend(at, coefficients)
        root = (rate * rate + 2 * bend * miss).clamp(min=0).sqrt()
        step = at + 2 * miss / (rate + root).clamp(min=1e-300)
        at = torch.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        at = torch.where(beyond, torch.full_like(at, limit), at)
    return at, MAX_ITERATIONS


def _bend(at: Float[Tensor, "*batch"], coefficients: Coefficients) -> Float[Tensor, "*batch"]:
    """Second derivative of r."""
    total = torch.zeros_like(at)
    for i, k in reversed(tuple(enumerate(coefficients))):
        total = total * at * at + (2 * i + 3) * (2 * i + 2) * k
    return total * at
