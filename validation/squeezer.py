"""Andrews' squeezer as one coordinate, the crank's angle, in numbers of 64 bits of mantissa: nothing of it is mbkit's.

The crank OF, the rod FE and the side EB of the triangle are a four-bar, and G and H are where circles about A and E
meet. So every place is a root of the crank's angle β, and with its derivatives by β the motion is

    J(β) β̈ + ½ J'(β) β̇² + V'(β) = M.

Geometry and masses: `published`, after the Test Set for IVP Solvers, problem andrews.
"""

from __future__ import annotations

import numpy as np

from validation.closed_forms import published
from validation.four_bar import extrapolated

_LONG = np.longdouble
#: Steps of the extrapolation up to the problem's end.
STEPS = 300


class Jet:
    """A function's value with its first and second derivative."""

    def __init__(self, f, df=0, ddf=0):
        self.f, self.df, self.ddf = f, df, ddf

    def __add__(self, other):
        other = _jet(other)
        return Jet(self.f + other.f, self.df + other.df, self.ddf + other.ddf)

    def __sub__(self, other):
        return self + -1 * _jet(other)

    def __mul__(self, other):
        a, b = self, _jet(other)
        return Jet(a.f * b.f, a.df * b.f + a.f * b.df, a.ddf * b.f + 2 * a.df * b.df + a.f * b.ddf)

    __radd__, __rmul__ = __add__, __mul__

    def inverse(self):
        return self.of(1 / self.f, -1 / self.f**2, 2 / self.f**3)

    def root(self):
        r = np.sqrt(self.f)
        return self.of(r, 1 / (2 * r), -1 / (4 * r * self.f))

    def of(self, g, dg, ddg):
        """Return a function of this one, by its value and derivatives."""
        return Jet(g, dg * self.df, ddg * self.df**2 + dg * self.ddf)


def _jet(x):
    return x if isinstance(x, Jet) else Jet(_LONG(x))


def _plus(p, q, factor=1):
    return [a + factor * b for a, b in zip(p, q, strict=True)]


def _meet(p, r, q, s, side):
    """Return the point at the distance r from p and s from q, to the left (1) or right (-1) of the way from p to q."""
    way = _plus(q, p, -1)
    square = way[0] * way[0] + way[1] * way[1]
    along = 0.5 * square.inverse() * (square + (r * r - s * s))
    across = side * (r * r * square.inverse() - along * along).root()
    return [p[0] + along * way[0] - across * way[1], p[1] + along * way[1] + across * way[0]]


def _constants():
    told = published()["andrews_squeezing_mechanism"]
    number = {k: _LONG(repr(x)) for k, x in told["geometry"].items()}
    return number, [_LONG(repr(x)) for x in told["m"]], [_LONG(repr(x)) for x in told["I_com"]]


_G, _M, _I = _constants()
_C0, _L0, _TORQUE = _LONG("4530"), _LONG("0.07785"), _LONG("0.033")


def _axes(u):
    """Return how a point of a body, by its coordinates, lies from the body's origin; u is the body's first axis."""
    return lambda x, y: [x * u[0] - y * u[1], x * u[1] + y * u[0]]


def shape(beta):
    """Return the first axis of each body, and the centre of mass of each, as jets of β, and the spring's end D."""
    g, c, s = _G, np.cos(beta), np.sin(beta)
    crank = [Jet(c, -s, -c), Jet(s, c, -s)]
    A, B = [_jet(g["xa"]), _jet(g["ya"])], [_jet(g["xb"]), _jet(g["yb"])]
    F = [g["rr"] * x for x in crank]
    E = _meet(B, g["ss"], F, g["d"], -1)
    G = _meet(A, g["zt"], E, g["e"], 1)
    H = _meet(A, g["u"], E, g["zf"], -1)
    rod = [(x - y) * (1 / g["d"]) for x, y in zip(F, E, strict=True)]
    # E = B + ss (sin γ, -cos γ), and so for the other angles that are measured from -y.
    third, fourth = ([-1 * (E[1] - o[1]) * (1 / r), (E[0] - o[0]) * (1 / r)] for o, r in ((B, g["ss"]), (G, g["e"])))
    fifth = [(x - y) * (1 / g["zt"]) for x, y in zip(G, A, strict=True)]
    sixth = [(x - y) * (1 / g["zf"]) for x, y in zip(E, H, strict=True)]
    last = [(x - y) * (1 / g["u"]) for x, y in zip(H, A, strict=True)]
    seventh = [-1 * last[1], last[0]]
    axes = [crank, rod, third, fourth, fifth, sixth, seventh]
    places = [
        _axes(crank)(g["ra"], 0),
        _plus(F, [g["da"] * x for x in rod], -1),
        _plus(B, _axes(third)(g["sb"], -g["sa"])),
        _plus(G, _axes(fourth)(0, g["ea"] - g["e"])),
        _plus(A, _axes(fifth)(g["ta"], g["tb"])),
        _plus(H, [(g["zf"] - g["fa"]) * x for x in sixth]),
        _plus(A, _axes(seventh)(-g["ub"], -g["ua"])),
    ]
    return axes, places, _plus(B, _axes(third)(g["sd"], -g["sc"]))


def _rates(y):
    axes, places, D = shape(y[0])
    inertia = slope = _LONG(0)
    for u, p, m, i in zip(axes, places, _M, _I, strict=True):
        inertia += m * sum(x.df**2 for x in p) + i * sum(x.df**2 for x in u)
        slope += 2 * m * sum(x.df * x.ddf for x in p) + 2 * i * sum(x.df * x.ddf for x in u)
    far = [D[0] - _G["xc"], D[1] - _G["yc"]]
    length = (far[0] * far[0] + far[1] * far[1]).root()
    pull = _C0 * (length.f - _L0) * length.df
    return np.array([y[1], (_TORQUE - pull - slope * y[1] ** 2 / 2) / inertia])


def truth(steps=STEPS):
    """Return the turn of each body from +x, up to whole turns, and its rate, (7,) each, at the problem's end."""
    told = published()["andrews_squeezing_mechanism"]
    y, h = np.array([_LONG(told["q0"][0]), _LONG(0)]), _LONG(repr(told["t_end"])) / steps
    for _ in range(steps):
        y = extrapolated(y, h, _rates)
    axes, *_ = shape(y[0])
    turn = [np.arctan2(u[1].f, u[0].f) for u in axes]
    return np.array(turn), np.array([(u[0].f * u[1].df - u[1].f * u[0].df) * y[1] for u in axes])
