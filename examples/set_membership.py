"""Set membership in pictures: cones, bounds far from the data, the gamma curve, a drifting plant.

Run `python examples/set_membership.py [FOLDER]`; the pictures go to `build/set_membership` (those of the docs are
`docs/_static`).
"""

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

# The same file from the same numbers, so that a change of a picture shows a change of the method.
mpl.rcParams["svg.hashsalt"] = "softneck"


def truth(x: np.ndarray) -> np.ndarray:
    """A curve with slopes up to 1.5."""
    return np.sin(1.5 * x)


def bounds(X: np.ndarray, y: np.ndarray, gamma: float, epsilon: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """f_l and f_u at `x` (Eq. 19, 20): what the cones of all samples leave."""
    cone = epsilon + gamma * np.abs(x[:, None] - X)
    return (y - cone).max(axis=1), (y + cone).min(axis=1)


def least_gamma(points: np.ndarray, values: np.ndarray, slack: np.ndarray) -> np.ndarray:
    """The least gamma that the data allow for each slack, over all pairs of `points` (N, n)."""
    distance = np.linalg.norm(points[:, None] - points, axis=2) + np.diag(np.full(len(points), np.inf))
    rise = np.abs(values[:, None] - values)
    return np.array([np.max((rise - s) / distance, initial=0.0) for s in slack])


def save(figure: Figure, path: Path) -> None:
    """Write one picture, without the date."""
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def cones_figure(path: Path) -> None:
    """Five samples, their cones, and what they leave."""
    X, x = np.array([0.4, 1.3, 2.2, 3.4, 4.1]), np.linspace(0, 4.5, 451)
    y, gamma, epsilon = truth(X) + np.array([0.05, -0.08, 0.02, 0.09, -0.04]), 1.5, 0.1
    low, high = bounds(X, y, gamma, epsilon, x)
    figure, ax = plt.subplots(layout="constrained", figsize=(7, 3.6))
    for w, value in zip(X, y, strict=True):
        for sign in (1, -1):
            ax.plot(x, value + sign * (epsilon + gamma * np.abs(x - w)), color="0.8", linewidth=0.8)
    ax.fill_between(x, low, high, color="tab:blue", alpha=0.15, label="between f_l and f_u")
    ax.plot(x, 0.5 * (low + high), color="tab:blue", label="estimate, their middle")
    ax.plot(x, truth(x), "k--", linewidth=1, label="the unknown function")
    ax.errorbar(X, y, epsilon, fmt="ko", capsize=3, label="samples, +- epsilon")
    ax.set(xlabel="regressor", ylabel="output", ylim=(-2.2, 2.4))
    ax.legend(loc="upper right", ncols=2, fontsize="small")
    save(figure, path)


def bounds_figure(path: Path) -> None:
    """Bounds where the data are dense, sparse and absent, and where they are wider than at 99 % of the samples."""
    rng = np.random.default_rng(1)
    X = np.concatenate([rng.uniform(0, 2, 120), rng.uniform(2, 3, 8), rng.uniform(4, 4.5, 30)])
    y = truth(X) + rng.uniform(-0.05, 0.05, X.size)
    epsilon, x = 0.1, np.linspace(-0.7, 5.2, 600)
    gamma = least_gamma(X[:, None], y, np.array([epsilon]))[0]
    low, high = bounds(X, y, gamma, epsilon, x)
    others = [np.arange(X.size) != k for k in range(X.size)]
    own = [bounds(X[rest], y[rest], gamma, epsilon, X[[k]]) for k, rest in enumerate(others)]
    usual = np.quantile([f_u - f_l for f_l, f_u in own], 0.99)
    figure, ax = plt.subplots(layout="constrained", figsize=(7, 3.6))
    ax.fill_between(x, low, high, color="tab:blue", alpha=0.2, label="between f_l and f_u")
    ax.fill_between(
        x, -2.2, 2.2, where=high - low > usual, color="tab:red", alpha=0.12, linewidth=0, label="outside what was seen"
    )
    ax.plot(x, 0.5 * (low + high), color="tab:blue", label="estimate")
    ax.plot(x, truth(x), "k--", linewidth=1, label="the unknown function")
    ax.plot(X, y, "k.", markersize=3)
    ax.set(xlabel="regressor", ylabel="output", ylim=(-2.2, 2.2))
    ax.legend(loc="lower left", fontsize="small")
    save(figure, path)


def gamma_figure(path: Path) -> None:
    """gamma*(epsilon) by both rules."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (2, 2000))
    sigma = 0.01
    values = np.sin(points[0]) + 0.5 * points[1] + sigma * rng.standard_normal(2000)
    figure, ax = plt.subplots(layout="constrained", figsize=(7, 3.6))
    epsilon = np.geomspace(3e-4, 0.5, 32) * np.ptp(values)
    for times, name in ((1.0, "the paper's: s = epsilon"), (2.0, "Milanese and Novara's: s = 2 epsilon")):
        ax.loglog(epsilon, least_gamma(points.T, values, times * epsilon), label=name)
    ax.axvline(sigma, color="0.6", linewidth=0.8)
    ax.text(sigma, ax.get_ylim()[1], " sigma of the noise", va="top", color="0.4")
    ax.axhline(np.sqrt(1.25), color="0.6", linewidth=0.8)
    ax.text(2e-3, np.sqrt(1.25), "slope of the function", va="top", color="0.4")
    ax.set(xlabel="epsilon", ylabel="least gamma")
    ax.legend(loc="upper right", fontsize="small")
    save(figure, path)


def main(folder: Path) -> None:
    """Draw all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in (
        ("cones", cones_figure),
        ("bounds", bounds_figure),
        ("gamma", gamma_figure),
    ):
        draw(folder / f"set_membership_{name}.svg")
    print(f"set_membership_cones.svg, _bounds and _gamma are in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "build/set_membership"))
