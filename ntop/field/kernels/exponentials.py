"""Exponentials from small tables, to double precision; a march needs some sixty per ray.

Each is a Taylor polynomial about the nearest of a few nodes. What is no number stays none.
"""

import math

import numpy as np

from ntop.field.kernels import device

PER_UNIT = 8  # nodes of both tables per unit of their argument
EXP_LIMIT = 40.0  # exp(-40) is below the last bit of 1
SOFT_LIMIT = 37.0  # log(1 + exp(-37)) is below the last bit of 37

_NODES = np.arange(int(EXP_LIMIT * PER_UNIT) + 1) / PER_UNIT
EXP_TABLE = np.stack([np.exp(-_NODES), np.expm1(-_NODES)], 1)


def _softplus_terms() -> np.ndarray:
    """Taylor coefficients of log(1 + exp(-a)) about the nodes (node, 8).

    With p = 1 / (1 + exp(a)) its first derivative is -p, and dp/da = p^2 - p: each further
    derivative is a polynomial in p, by the chain rule.
    """
    a = np.arange(int(SOFT_LIMIT * PER_UNIT) + 1) / PER_UNIT
    p = np.exp(-a) / (1 + np.exp(-a))
    terms, derivative = [np.log1p(np.exp(-a))], np.polynomial.Polynomial([0.0, -1.0])
    for order in range(1, 8):
        terms.append(derivative(p) / math.factorial(order))
        derivative = derivative.deriv() * np.polynomial.Polynomial([0.0, -1.0, 1.0])
    return np.stack(terms, 1)


SOFT_TABLE = _softplus_terms()


@device
def expm1_of_minus(x):
    """exp(-x) - 1 for x >= 0, precise where x is small."""
    if not x < EXP_LIMIT:
        return -1.0 if x >= EXP_LIMIT else x
    n = int(x * PER_UNIT + 0.5)
    r = n * (1 / PER_UNIT) - x
    rise = r * (
        1 + r * (1 / 2 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r / 5040)))))
    )
    return EXP_TABLE[n, 0] * rise + EXP_TABLE[n, 1]


@device
def logistic(x):
    """1 / (1 + exp(-x)) without overflow."""
    e = 1 + expm1_of_minus(abs(x))
    return (1.0 if x >= 0 else e) / (1 + e)


@device
def softplus_of(x):
    """log(1 + exp(x)) without overflow."""
    a = abs(x)
    if not a < SOFT_LIMIT:
        return max(x, 0.0) if a >= SOFT_LIMIT else x
    n = int(a * PER_UNIT + 0.5)
    r = a - n * (1 / PER_UNIT)
    c = SOFT_TABLE[n]
    return max(x, 0.0) + (
        c[0]
        + r * (c[1] + r * (c[2] + r * (c[3] + r * (c[4] + r * (c[5] + r * (c[6] + r * c[7]))))))
    )
