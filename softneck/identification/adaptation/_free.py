"""Which numbers of each kind of model an adaptation moves, and what it moves with them.

Of a network those are the weights to and from its states: a change of the neck is a change of its gains, rests and
rates, while what was learnt of its shape stays. `nss` keeps its contraction, whatever these are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import FileFormatError, Matrix, SettingsError, Vector

from ..models._arrays import check_arrays
from ..models._model import Model
from ..structured._arrays import NUMBERS

# Kind -> the arrays that are moved; entries that are zero are structure and stay.
_MOVED = {
    "oe": ("a", "b", "A", "B", "offset"),
    "play": ("weights",),
    "nn": ("w3", "b3"),
    "nss": ("B", "h", "C", "c"),
    "greybox": ("neck",),
}
#: Kinds that can adapt.
ADAPTING = tuple(_MOVED)


def require_adapting(model: Model) -> None:
    """Raise SettingsError for a kind that cannot adapt."""
    if model.kind not in ADAPTING:
        raise SettingsError(
            f"a model of kind `{model.kind}` cannot adapt; {', '.join(ADAPTING)} can. Identify it again on new data."
        )


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """The numbers of one model as one vector.

    Attributes:
        model: whose they are.
        places: array and mask of the entries in it that are moved.
    """

    model: Model
    places: tuple[tuple[str, np.ndarray], ...]

    @classmethod
    def of(cls, model: Model) -> Free:
        """Find them."""
        if model.kind == "greybox":
            mask = np.arange(model.arrays["neck"].size) < len(NUMBERS)  # its tendons stand behind its numbers
            return cls(model, (("neck", mask),))
        found = [(name, model.arrays[name]) for name in _MOVED[model.kind] if name in model.arrays]
        return cls(model, tuple((name, array != 0.0) for name, array in found))

    def start(self) -> Vector:
        """Return where they are."""
        if self.model.kind == "greybox":
            values = self.model.arrays["neck"]
            return np.array([number.encode(float(value)) for number, value in zip(NUMBERS, values, strict=False)])
        return np.concatenate([self.model.arrays[name][mask] for name, mask in self.places])

    def sizes(self) -> Vector:
        """Return by how much each is usefully moved: its size, or that of its neighbours where it is small."""
        if self.model.kind == "greybox":
            return np.array([number.spread for number in NUMBERS])
        parts = [self.model.arrays[name][mask] for name, mask in self.places]
        return np.concatenate([np.maximum(np.abs(part), np.median(np.abs(part))) for part in parts if part.size])

    @property
    def linear(self) -> bool:
        """Whether the free run is linear in them, but for its limits: one step is all."""
        return self.model.kind == "play"

    def groups(self) -> list[list[tuple[int, int | None]]]:
        """Return the places (number, output) that can be moved at once: each moves its own output, None all of them."""
        count = len(self.model.robot.outputs.names)
        if self.model.kind not in ("play", "nn") and "a" not in self.model.arrays:
            return [[(place, None)] for place in range(self.start().size)]
        first, lines = 0, [[] for _ in range(count)]
        for _, mask in self.places:
            for axis, row in enumerate(mask):
                size = int(np.sum(row))
                lines[axis] += [(place, axis) for place in range(first, first + size)]
                first += size
        return [[line[i] for line in lines if i < len(line)] for i in range(max(map(len, lines)))]

    def at(self, x: Vector) -> Model:
        """Return the model with other numbers."""
        if self.model.kind == "greybox":
            numbers = [number.decode(float(np.clip(v, number.encode(number.low), number.encode(number.high))))
                       for number, v in zip(NUMBERS, x, strict=True)]  # fmt: skip
            neck = np.concatenate([numbers, self.model.arrays["neck"][len(NUMBERS) :]])
            # Its drives lag by the same number.
            drive = self.model.arrays["drive"].copy()
            drive[:, 0] = np.exp(-neck[0] * self.model.arrays["sensor"][1])
            return self._with({"neck": neck, "drive": drive})
        moved: dict[str, Matrix] = {}
        edges = np.cumsum([int(mask.sum()) for _, mask in self.places])
        for (name, mask), part in zip(self.places, np.split(x, edges[:-1]), strict=True):
            moved[name] = self.model.arrays[name].copy()
            moved[name][mask] = part
        return self._with(moved)

    def _with(self, moved: Mapping[str, Matrix]) -> Model:
        return replace(self.model, arrays={**self.model.arrays, **moved})

    def sound(self, x: Vector) -> bool:
        """Return whether the numbers make a model that a file may hold, and one that does not drift."""
        try:
            model = self.at(x)
            check_arrays(model.kind, model.arrays)
        except FileFormatError:
            return False
        if "a" in model.arrays:
            poles = [np.abs(np.roots([1.0, *row])).max(initial=0.0) for row in model.arrays["a"]]
        else:
            A = model.arrays.get("A", np.zeros((1, 1)))
            poles = np.abs(np.linalg.eigvals(A)) if model.kind == "oe" else [0.0]
        # As the fit of `oe` does: a pole slower than some 20 s at 20 ms is a drift.
        return bool(max(poles) < 0.999)
