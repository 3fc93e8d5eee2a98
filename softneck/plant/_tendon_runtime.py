"""One tendon: exact chord, elastic, pulls only, with Coulomb friction in its guide."""


def tendon_chord(
    x: tuple[float, float, float, float, float, float],
    f: tuple[float, float, float, float, float, float],
    e: tuple[float, float],
    geometry: tuple[float, float],
) -> tuple[float, float, float, float, float]:
    """Return (length, its rate, d length / d b1, d length / d b2, d length / d s).

    `x` is (b1, b2, s, rates), `f` the bend functions, `e` the tendon's direction, `geometry` is (link
    length, attachment radius) [m].
    """
    b1, b2, s, w1, w2, v = x
    S = f[2]
    dS = f[5]
    a = geometry[1]
    inner = geometry[0] - s - a * (b1 * e[0] + b2 * e[1])
    # Gradient of S (L0 - s - a b.e), where dS/db = (S'/beta) b.
    g1 = dS * b1 * inner - S * a * e[0]
    g2 = dS * b2 * inner - S * a * e[1]
    return S * inner, g1 * w1 + g2 * w2 - S * v, g1, g2, -S


def tendon_tension(
    stretch: float, rate: float, sliding: float, c: tuple[float, float, float, float]
) -> tuple[float, float]:
    """Return the tensions (at the winch, at the platform) [N]; both are zero when slack, never below.

    `stretch` [m] and `rate` [m/s] are of the elastic span, `sliding` is tanh(slide / friction speed) of the tendon's
    speed through the guide (positive as it lengthens), `c` is (stiffness, damping, friction coefficient, friction
    speed). Friction is Coulomb's, smoothed by that tanh, and grows with tension (capstan).
    """
    stiffness, damping, friction, _ = c
    if stretch <= 0.0:
        return 0.0, 0.0
    tension = stiffness * stretch + damping * rate
    # A damper may not push either: a tendon let go fast enough is slack before its stretch is gone.
    if tension <= 0.0:
        return 0.0, 0.0
    return tension, tension * (1.0 + friction * sliding)
