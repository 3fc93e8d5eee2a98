"""What a choice of kinds says: why one is taken, what to be wary of, why none could be."""

from __future__ import annotations

from collections.abc import Sequence

from ._kind_trial import KindTrial

# Fits closer than this are alike [points]: seeds of noise and training move them by as much.
ALIKE = 0.5
# Below this [%] no kind has understood the recording.
_POOR = 70.0


def reasons(ranking: Sequence[KindTrial]) -> str:
    """Return why kinds failed, each reason once."""
    said: dict[str, list[str]] = {}
    for one in ranking:
        said.setdefault(one.failure or "its free run diverged", []).append(one.kind)
    if len(said) == 1:
        return next(iter(said))
    return "; ".join(f"{', '.join(kinds)}: {why}" for why, kinds in said.items())


def word(kind: str, tried: list[KindTrial]) -> str:
    """Return what is tried, and the best so far."""
    best = max(tried, key=lambda one: one.fit, default=None)
    return kind if best is None or best.fit == float("-inf") else f"{kind} (best so far {best.kind}, {best.fit:.1f} %)"


def why(chosen: KindTrial, alike: list[KindTrial]) -> str:
    """Return why a kind is taken before those that are alike."""
    said = f"{chosen.kind} runs free with {chosen.fit:.1f} % at its worst ({chosen.worst})"
    if not alike:
        return f"{said}, better than all others at theirs."
    others = ", ".join(f"{one.kind} {one.fit:.1f} % with {one.numbers} numbers" for one in alike)
    return (
        f"{said}; {others} are not worse by more than {ALIKE:g} points, and of such kinds the one of the fewest "
        f"numbers is taken ({chosen.numbers})."
    )


def guarded_why(best: KindTrial, chosen: KindTrial) -> str:
    """Return what the guarded form of the best is, where it was taken."""
    if chosen is best or chosen.model is None:
        return ""
    settings = chosen.model.settings
    return (
        f" Its guarded form is taken: {settings['members']} models of {best.kind} that fade to `{settings['base']}` "
        f"where they part or nothing was seen; {chosen.hold_out_fit:.1f} % on the rows held out, {best.kind} alone "
        f"{best.hold_out_fit:.1f} %."
    )


def remarks(ranking: tuple[KindTrial, ...], other_excitation: bool) -> tuple[str, ...]:
    """Return what to be wary of in a ranking."""
    remarks = []
    if not other_excitation:
        remarks.append(
            "The rows held out are of the excitation that was trained on: this ranking may not hold for other "
            "motions. Give a second recording with another signal; the last one is held out."
        )
    if ranking[0].fit < _POOR:
        remarks.append(
            f"No kind reaches {_POOR:g} % in free run. Look for a drifting sensor, a wrong sample time or sign, motors "
            "that were not logged, or an excitation that hardly moves the robot."
        )
    failed = [one.kind for one in ranking if one.fit == float("-inf")]
    if failed:
        remarks.append(f"Not identified or diverged: {', '.join(failed)}.")
    return tuple(remarks)
