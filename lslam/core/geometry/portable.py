"""Products and elementary functions with the same bytes on every processor.

BLAS and LAPACK choose their kernels by the processor, and NumPy its vector functions: the last bits of `A @ B`, `np.linalg.solve`
and `np.sin` differ from machine to machine. IEEE 754 fixes `+ - * /` and square roots, so what consists of these alone does not.
Elementary functions are those of fdlibm (Ng 1993), within one unit in the last place.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# pi/2 in three parts; the product of the first two with a whole number below 2^20 is exact.
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_TWO_OVER_PI = 6.36619772367581382433e-01
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
_ARCTANGENT = (
    3.33333333333329318027e-01,
    -1.99999999998764832476e-01,
    1.42857142725034663711e-01,
    -1.11111104054623557880e-01,
    9.09088713343650656196e-02,
    -7.69187620504482999495e-02,
    6.66107313738753120669e-02,
    -5.83357013379057348645e-02,
    4.97687799461593236017e-02,
    -3.65315727442169155270e-02,
    1.62858201153657823623e-02,
)
# arctan of 0, 1/2, 1, 3/2 and infinity: leading digits and the rest.
_KNOT_HIGH = np.array(
    [0.0, 4.63647609000806093515e-01, 7.85398163397448278999e-01, 9.82793723247329054082e-01, 1.57079632679489655800e00]
)
_KNOT_LOW = np.array(
    [
        0.0,
        2.26987774529616870924e-17,
        3.06161699786838301793e-17,
        1.39033110312309984516e-17,
        6.12323399573676603587e-17,
    ]
)
_KNOT_EDGES = np.array([0.4375, 0.6875, 1.1875, 2.4375])
_HIGHS: list[float] = _KNOT_HIGH.tolist()
_LOWS: list[float] = _KNOT_LOW.tolist()
_KNOTS: list[float] = _KNOT_EDGES.tolist()
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXPONENTIAL = (
    1.66666666666666019037e-01,
    -2.77777777770155933842e-03,
    6.61375632143793436117e-05,
    -1.65339022054652515390e-06,
    4.13813679705723846039e-08,
)
_LOGARITHM = (
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
)
_FEW = 4  # numbers up to which plain floats are faster than arrays
_BLOCK = 1 << 13  # numbers whose intermediate results stay in a processor's cache


def product(A: Array, B: Array) -> Array:
    """A @ B of stacked matrices (..., i, k), or one row (k,), and (..., k, j), summed in order of k."""
    A, B = np.asarray(A), np.asarray(B)
    if A.ndim == 1:
        return product(A[None], B)[..., 0, :]
    if A.size <= 16 and B.size <= 16:
        # The same sums in fewer calls, for a few numbers.
        return np.asarray(np.add.reduce(A[..., :, :, None] * B[..., None, :, :], axis=-2))
    out: Array = A[..., :, :1] * B[..., :1, :]
    for k in range(1, A.shape[-1]):
        out += A[..., :, k : k + 1] * B[..., k : k + 1, :]
    return out


def rotate(R: Array, v: Array) -> Array:
    """R v of stacked matrices (..., i, k) and vectors (..., k)."""
    return product(R, v[..., None])[..., 0]


def dot(a: Array, b: Array) -> Array:
    """Inner products of stacked vectors (..., k), summed in order of k."""
    out = np.asarray(a[..., 0] * b[..., 0])
    for k in range(1, a.shape[-1]):
        out = out + a[..., k] * b[..., k]
    return out


def norm(v: Array) -> Array:
    """Lengths of stacked vectors (..., k)."""
    return np.asarray(np.sqrt(dot(v, v)))


def hypot(x: Any, y: Any) -> Any:
    """sqrt(x^2 + y^2) of numbers whose squares neither overflow nor vanish."""
    return np.sqrt(x * x + y * y)


def sin(x: Any) -> Any:
    """Sine of angles of any shape, rad, below a million; float32 in, float32 out."""
    return _of(x, lambda angle: _sine_cosine(angle)[0])


def cos(x: Any) -> Any:
    """Cosine of angles of any shape, rad, below a million; float32 in, float32 out."""
    return _of(x, lambda angle: _sine_cosine(angle)[1])


def tan(x: Any) -> Any:
    """Tangent of angles of any shape, rad, below a million."""
    return _of(x, lambda angle: np.divide(*_sine_cosine(angle)))


def sine_cosine(x: Any) -> tuple[Any, Any]:
    """Sine and cosine of angles, rad, computed together at half the cost of both."""
    angle = np.asarray(x, np.float64)
    if angle.size <= _FEW:
        both = np.array([sine_cosine_of(float(value)) for value in angle.ravel()]).reshape(-1, 2)
        s, c = both[:, 0].reshape(angle.shape), both[:, 1].reshape(angle.shape)
    else:
        s, c = _sine_cosine(angle)
    kind = _kind_of(x)
    return s.astype(kind)[()], c.astype(kind)[()]


def arctan2(y: Any, x: Any) -> Any:
    """Angles of the points (x, y), -pi..pi rad."""
    up, right = np.broadcast_arrays(np.asarray(y, np.float64), np.asarray(x, np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where((up == 0) & (right == 0), 0.0, np.abs(up) / np.abs(right))
    if slope.size <= _FEW:
        angle = np.array([_arctangent_of(float(value)) for value in slope.ravel()]).reshape(slope.shape)
    else:
        angle = _arctangent(slope)
    angle = np.where(np.signbit(right), np.pi - (angle - 1.2246467991473531772e-16), angle)
    kind = np.result_type(_kind_of(y), _kind_of(x))
    return np.copysign(angle, up).astype(kind)[()]


def arctan2_of(y: float, x: float) -> float:
    """`arctan2` of plain floats that are not both zero, with the same bits."""
    angle = _arctangent_of(math.inf if x == 0 else abs(y) / abs(x))
    if math.copysign(1.0, x) < 0:
        angle = math.pi - (angle - 1.2246467991473531772e-16)
    return math.copysign(angle, y)


def arcsin(x: Any) -> Any:
    """Angles, -pi/2..pi/2 rad, whose sine is x; NaN beyond -1..1."""
    wide = np.asarray(x, np.float64)
    return arctan2(wide, np.sqrt((1 - wide) * (1 + wide))).astype(_kind_of(x))[()]


def arccos(x: Any) -> Any:
    """Angles, 0..pi rad, whose cosine is x; NaN beyond -1..1."""
    wide = np.asarray(x, np.float64)
    return arctan2(np.sqrt((1 - wide) * (1 + wide)), wide).astype(_kind_of(x))[()]


def exp(x: Any) -> Any:
    """e^x of numbers of any shape, with the same bits on every processor; float32 in, float32 out."""
    return _of(x, _exponential)


def log(x: Any) -> Any:
    """Natural logarithm of positive numbers; float32 in, float32 out."""
    return _of(x, _logarithm)


def power(x: Any, exponent: float) -> Any:
    """x^exponent of numbers x >= 0; 0 of 0 where the exponent is positive."""
    wide = np.asarray(x, np.float64)
    raised = np.where(
        wide > 0, _exponential(exponent * _logarithm(np.where(wide > 0, wide, 1.0))), float(exponent == 0)
    )
    return raised.astype(_kind_of(x))[()]


def _kind_of(x: Any) -> Any:
    """Floating-point dtype of the result for an argument x: its own, or float64."""
    kind = getattr(x, "dtype", None)
    return kind if kind is not None and np.issubdtype(kind, np.floating) else np.dtype(np.float64)


def _of(x: Any, function: Any) -> Any:
    """Apply a function of float64 arrays to x of any shape; the result has the dtype of x."""
    return function(np.asarray(x, np.float64)).astype(_kind_of(x))[()]


def _sine_cosine(x: Array) -> tuple[Array, Array]:
    """Sine and cosine of an array, in blocks that fit the cache."""
    if x.size <= _BLOCK:
        return _sine_cosine_block(x)
    out = np.empty((2, x.size))
    flat = x.ravel()
    for begin in range(0, x.size, _BLOCK):
        out[:, begin : begin + _BLOCK] = _sine_cosine_block(flat[begin : begin + _BLOCK])
    return out[0].reshape(x.shape), out[1].reshape(x.shape)


def _sine_cosine_block(x: Array) -> tuple[Array, Array]:
    """Sine and cosine after reduction of the angles to pi/4 about multiples of pi/2."""
    turns = np.rint(np.where(np.isfinite(x), x, 0.0) * _TWO_OVER_PI)
    r, tail = _reduce(x, turns)
    s, c = _kernels(r, tail)
    quarter = turns.astype(np.int64) & 3
    is_odd = (quarter & 1) == 1
    sine, cosine = np.where(is_odd, c, s), np.where(is_odd, s, c)
    return np.where(quarter >= 2, -sine, sine), np.where((quarter == 1) | (quarter == 2), -cosine, cosine)


def sine_cosine_of(x: float) -> tuple[float, float]:
    """Sine and cosine of one angle, rad, by plain floats, with the same bits as `sine_cosine`."""
    if x - x != 0:
        return np.nan, np.nan
    turns = float(round(x * _TWO_OVER_PI))
    s, c = _kernels(*_reduce(x, turns))
    match int(turns) & 3:
        case 0:
            return s, c
        case 1:
            return c, -s
        case 2:
            return -s, -c
        case _:
            return -c, s


def _reduce(x: Any, turns: Any) -> tuple[Any, Any]:
    """Remainder of angles x, rad, after so many quarter `turns`, as a sum of two numbers for precision."""
    left = x - turns * _HALF_PI[0]
    step = turns * _HALF_PI[1]
    r = left - step
    return r, ((left - r) - step) - turns * _HALF_PI[2]


def _kernels(r: Any, tail: Any) -> tuple[Any, Any]:
    """Sine and cosine of r + tail, at most pi/4 in magnitude, by polynomials."""
    z = r * r
    v = z * r
    p = _SINE[1] + z * (_SINE[2] + z * (_SINE[3] + z * (_SINE[4] + z * _SINE[5])))
    s = r - ((z * (0.5 * tail - v * p) - tail) - v * _SINE[0])
    q = z * (_COSINE[0] + z * (_COSINE[1] + z * (_COSINE[2] + z * (_COSINE[3] + z * (_COSINE[4] + z * _COSINE[5])))))
    half = 0.5 * z
    w = 1.0 - half
    return s, w + (((1.0 - w) - half) + (z * q - r * tail))


def _arctangent(x: Array) -> Array:
    """Arctangent, rad, of an array x >= 0, infinity included."""
    knot = np.searchsorted(_KNOT_EDGES, x, side="right")
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.select(
            [knot == 0, knot == 1, knot == 2, knot == 3],
            [x, (2 * x - 1) / (2 + x), (x - 1) / (x + 1), (x - 1.5) / (1 + 1.5 * x)],
            -1 / x,
        )
        z = t * t
        return np.asarray(_KNOT_HIGH[knot] - ((t * _horner(z, _ARCTANGENT) - _KNOT_LOW[knot]) - t))


def _arctangent_of(x: float) -> float:
    """Arctangent of one number x >= 0 by plain floats, with the same bits as `_arctangent`."""
    knot = bisect_right(_KNOTS, x)
    match knot:
        case 0:
            t = x
        case 1:
            t = (2 * x - 1) / (2 + x)
        case 2:
            t = (x - 1) / (x + 1)
        case 3:
            t = (x - 1.5) / (1 + 1.5 * x)
        case _:
            t = -1 / x
    p = float(_horner(t * t, _ARCTANGENT))
    return _HIGHS[knot] - ((t * p - _LOWS[knot]) - t)


def _horner(z: Any, coefficients: tuple[float, ...]) -> Any:
    """The polynomial z (c0 + z (c1 + ...)) by Horner's scheme."""
    p = 0.0 * z
    for coefficient in reversed(coefficients):
        p = z * (coefficient + p)
    return p


def _exponential(x: Array) -> Array:
    """exp(x) of an array, by reduction to a power of 2 and a rational approximation."""
    x = np.clip(x, -750.0, 710.0)
    halvings = np.rint(x / _LN2_HIGH)
    high, low = x - halvings * _LN2_HIGH, halvings * _LN2_LOW
    r = high - low
    z = r * r
    c = r - _horner(z, _EXPONENTIAL)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.ldexp(1 - ((low - (r * c) / (2 - c)) - high), np.nan_to_num(halvings).astype(np.int64)))


def _logarithm(x: Array) -> Array:
    """Natural logarithm of an array of positive numbers."""
    mantissa, exponent = np.frexp(x)
    is_low = mantissa < np.sqrt(0.5)
    f = np.where(is_low, 2 * mantissa, mantissa) - 1
    k = exponent - is_low
    s = f / (2 + f)
    z = s * s
    p = _horner(z, _LOGARITHM)
    half = 0.5 * f * f
    return np.asarray(k * _LN2_HIGH - ((half - (s * (half + p) + k * _LN2_LOW)) - f))
